"""Every test: no leaked threads, free ports, a time limit, and a clock that does not blame it for the machine."""

import faulthandler
import mmap
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

LIMIT_S = 60
SLOW_LIMIT_S = 300
faulthandler.enable()


@pytest.fixture(autouse=True)
def time_limit(request: pytest.FixtureRequest) -> Iterator[None]:
    """A test that hangs fails with a traceback instead of stopping the run."""
    limit = SLOW_LIMIT_S if request.node.get_closest_marker("slow") else LIMIT_S

    def expire(_signum: int, _frame: object) -> None:
        faulthandler.dump_traceback()
        raise TimeoutError(f"test took longer than {limit} s")

    previous = signal.signal(signal.SIGALRM, expire)
    signal.alarm(limit)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, previous)


@pytest.fixture(autouse=True)
def no_leaked_threads(time_limit: None) -> Iterator[None]:
    """Every thread of ours that a test starts is gone when it ends."""
    before = set(threading.enumerate())
    yield
    deadline = time.monotonic() + 3
    while leaked := [t for t in threading.enumerate() if t not in before and t.name.startswith("binpick")]:
        if time.monotonic() > deadline:
            pytest.fail(f"leaked threads: {[t.name for t in leaked]}")
        time.sleep(0.01)


@pytest.fixture(scope="session")
def clock() -> Iterator[Callable[[], float]]:
    """`time.monotonic` for a test's limits, but that it stands still while the machine holds everybody up."""
    memory = os.memfd_create("sleeper")
    os.ftruncate(memory, 16)
    board = mmap.mmap(memory, 16)
    sleeper = subprocess.Popen([sys.executable, str(Path(__file__).with_name("sleeper.py")), str(memory)], pass_fds=[memory])

    def now_s() -> float:
        assert sleeper.poll() is None
        said, now = b"", 0.0
        while said != board[:]:              # of one moment
            said, now = board[:], time.monotonic()
        held_s, late_from = struct.unpack("dd", said)
        return now - held_s - max(0.0, now - late_from)

    while not any(board[:]):
        time.sleep(0.001)
    yield now_s
    sleeper.kill()
    sleeper.wait()
    board.close()
    os.close(memory)


@pytest.fixture
def free_port() -> int:
    """A TCP port of 127.0.0.1 that was free a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def gige_addresses() -> tuple[str, str]:
    """Two loopback addresses where nothing listened a moment ago."""
    from binpick.lab.rig import free

    left, right = free()
    return left, right
