"""Every test: no leaked threads, free ports, a time limit, a clock that does not blame it for the machine; a board to show."""

import faulthandler
import mmap
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import ports
import printed

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
    [port] = ports.free(1)
    return port


@pytest.fixture
def gige_addresses() -> tuple[str, str]:
    """Two loopback addresses where nothing listened a moment ago."""
    from binpick.lab.rig import free

    left, right = free()
    return left, right


@dataclass(frozen=True)
class ShownBoard:
    """A rig, and what it sees while somebody shows it a board at one place after the other, until that is enough."""

    spec: str
    size: tuple[int, int]
    K: np.ndarray
    T_right_left: np.ndarray
    pairs: list[tuple[np.ndarray, np.ndarray]]


SHOWN_AT = [(x, y, z, tilt) for (x, y, z), tilt in zip(
    [(0.04, 0.0, 0.55), (-0.05, -0.09, 0.52), (0.14, -0.09, 0.54), (-0.06, 0.10, 0.5), (0.15, 0.10, 0.5), (0.04, -0.10, 0.48),
     (0.04, 0.10, 0.48), (-0.05, 0.0, 0.5), (0.14, 0.0, 0.5), (0.04, 0.0, 0.40), (0.04, 0.02, 0.7), (0.0, 0.0, 0.6),
     (0.08, 0.02, 0.58), (0.02, -0.03, 0.52), (0.06, 0.03, 0.62)],
    [(0, 0), (25, 0), (-25, 0), (0, 25), (0, -25), (28, 5), (-28, 5), (5, 28), (5, -28), (0, 0), (5, 5), (20, 20), (-20, 20),
     (20, -20), (-20, -20)], strict=True)]
"""Middle of the board, metres, and its turns about x and y, degrees."""


@pytest.fixture(scope="session")
def shown_board() -> ShownBoard:
    columns, rows, square_m, size = 9, 6, 0.025, (640, 480)
    K = np.array([[620.0, 0, 322], [0, 622, 238], [0, 0, 1]])
    T_right_left = np.eye(4)
    T_right_left[:3, :3] = Rotation.from_euler("xyz", [0.4, -1, 0.8], degrees=True).as_matrix()
    T_right_left[:3, 3] = [-0.08, 0.001, 0.002]
    board = printed.chessboard(columns, rows)

    def draw(T_camera_board: np.ndarray) -> np.ndarray:
        return printed.seen(board, square_m, K, T_camera_board, size, 2, 1.5)

    pairs = []
    for x, y, z, tilt in SHOWN_AT:
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("xy", tilt, degrees=True).as_matrix()
        T[:3, 3] = [x, y, z] - T[:3, :3] @ [square_m * (columns - 1) / 2, square_m * (rows - 1) / 2, 0]
        pairs.append((draw(T), draw(T_right_left @ T)))
    return ShownBoard(f"chessboard:{columns}x{rows}:{square_m}", size, K, T_right_left, pairs)
