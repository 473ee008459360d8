"""Cameras that die under a real daemon: the code in time, each named, nobody else delayed, and back again by itself."""

import contextlib
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import httpx
import numpy as np
import psutil
import pytest

from binpick import rig as rig_file
from binpick.data import Image, Light
from binpick.rig import Rig
from binpick.sim.gige import GigePair

pytestmark = [pytest.mark.gige, pytest.mark.slow]

SIZE = (640, 400)
EXPOSURE_S = 0.5
EYE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
K = ((600.0, 0.0, 320.0), (0.0, 600.0, 200.0), (0.0, 0.0, 1.0))
NOISE = np.random.default_rng(1).integers(0, 256, SIZE[::-1], dtype=np.uint8)
ENABLE, TRIG, RES_ACK = 1, 2, 4
READY, ACK, NACK, BUSY, VALID, ERROR = 1, 2, 4, 8, 32, 64
BOTH_CONNECTED, BOTH_IN_ERROR, RIGHT_IN_ERROR = 0b0101, 0b1010, 0b1001
"""Register 14: two bits a camera, left first."""
TIMEOUT, CAMERAS, BUSY_CODE = -3, -4, -12
BACK_S = 15.0
HELD_MS = 10_000
"""A heartbeat timeout that outlasts the start of the next daemon."""


@dataclass(frozen=True)
class Cell:
    """A running daemon, and how it is reached."""

    process: subprocess.Popen[bytes]
    log: Path
    client: httpx.Client
    modbus_port: int
    clock: Callable[[], float]

    def get(self, path: str) -> httpx.Response:
        return self.client.get(path)

    def health(self) -> dict[str, object]:
        answer: dict[str, object] = self.get("/v1/health").json()
        return answer

    def ready(self) -> bool:
        return self.get("/v1/health/ready").status_code == 200

    def cycle(self, timeout_ms: int = 0) -> httpx.Response:
        return self.client.post("/v1/cycles?wait=true", json={"timeout_ms": timeout_ms}, timeout=20)

    def wait(self, until: Callable[[], bool], what: str, limit_s: float = BACK_S) -> float:
        """Seconds until it is so."""
        start = self.clock()
        while not until():
            if self.clock() - start > limit_s:
                pytest.fail(f"not {what} within {limit_s:.0f} s; {self.health()}\n{self.log.read_text()}")
            time.sleep(0.02)
        return self.clock() - start


class Registers:
    """A controller's view of the Modbus server: literal requests, one at a time."""

    def __init__(self, port: int) -> None:
        self.commands = 0
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=5)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def __enter__(self) -> "Registers":
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def read(self, address: int, count: int) -> tuple[int, ...]:
        answer = self._ask(struct.pack(">BHH", 4, address, count))
        return struct.unpack(f">{count}H", answer[2:])

    def status(self) -> int:
        return self.read(10, 1)[0]

    def write(self, address: int, *words: int) -> None:
        self._ask(struct.pack(f">BHHB{len(words)}H", 16, address, len(words), 2 * len(words), *words))

    def begin(self) -> None:
        """A cycle, until it is accepted."""
        self.commands += 1
        self.write(1, 1, self.commands)
        self.write(0, ENABLE | TRIG)
        self.until(ACK)

    def acknowledge(self) -> None:
        """Ends the handshake of a result or of a failure."""
        self.write(0, ENABLE | TRIG | RES_ACK)
        self.until(VALID, level=False)
        self.write(0, ENABLE)

    def end(self) -> None:
        """Of a cycle that ends well, until the next may begin."""
        self.until(VALID)
        self.acknowledge()
        self.until(READY)

    def until(self, bits: int, limit_s: float = BACK_S, level: bool = True) -> float:
        """Seconds until one of the bits is set (or, with level False, none is)."""
        start = time.monotonic()
        while bool(self.status() & bits) is not level:
            if time.monotonic() - start > limit_s:
                pytest.fail(f"status bits {bits:#x} not {level} within {limit_s:.0f} s: {self.read(10, 6)}")
            time.sleep(0.005)
        return time.monotonic() - start

    def _ask(self, body: bytes) -> bytes:
        self._socket.sendall(struct.pack(">HHHB", 1, 0, len(body) + 1, 1) + body)
        header = self._receive(7)
        answer = self._receive(struct.unpack(">HHHB", header)[2] - 1)
        assert answer[0] == body[0], answer
        return answer

    def _receive(self, count: int) -> bytes:
        received = b""
        while len(received) < count:
            chunk = self._socket.recv(count - len(received))
            assert chunk, "the Modbus server hung up"
            received += chunk
        return received


def noise(_index: int, _light: Light, _shot: int) -> Image:
    return NOISE


def signed(word: int) -> int:
    return word - 0x10000 if word & 0x8000 else word


def free_ports() -> tuple[int, int]:
    with socket.socket() as one, socket.socket() as other:
        for probe in (one, other):
            probe.bind(("127.0.0.1", 0))
        return one.getsockname()[1], other.getsockname()[1]


@pytest.fixture
def gige(gige_addresses: tuple[str, str]) -> Iterator[GigePair]:
    with GigePair(noise, gige_addresses, SIZE) as pair:
        yield pair


def cell_file(folder: Path, gige: GigePair, ports: tuple[int, int], control: str, heartbeat_ms: int) -> Path:
    rig = Rig.model_validate({"image_size_px": SIZE, "cameras": [
        {"name": name, "K": K, "distortion": (0, 0, 0, 0), "T_cam_rig": T}
        for name, T in (("left", EYE), ("right", ((1.0, 0.0, 0.0, -0.15), *EYE[1:])))]})
    (folder / "rig.json").write_bytes(rig_file.dump(rig))
    left, right = gige.identities
    path = folder / "cell.yaml"
    path.write_text(f"""
bin: {{inner_size_m: [0.6, 0.4, 0.18], pose: {{position_m: [0, 0, 1.0], rotvec_rad: [3.1415926, 0, 0]}}}}
recipes: [{{frame: camera, exposure_us: {1e6 * EXPOSURE_S:.0f}}}]
cameras:
  {{left: {{address: {left.address}}}, right: {{address: {right.address}}}, backend: aravis, max_skew_us: 500000,
    heartbeat_ms: {heartbeat_ms}}}
control: {control}
timeout_ms: 10000
publish: {{rest: {{port: {ports[0]}}}, modbus: {{host: 127.0.0.1, port: {ports[1]}}}}}
""")
    return path


@contextlib.contextmanager
def daemon(folder: Path, gige: GigePair, control: str, clock: Callable[[], float], heartbeat_ms: int = 3000) -> Iterator[Cell]:
    """`binpick run` once it serves; killed if the test leaves it alive."""
    ports = free_ports()
    environment = {key: value for key, value in os.environ.items() if key != "PYTEST_CURRENT_TEST"}
    path = cell_file(folder, gige, ports, control, heartbeat_ms)
    command = [sys.executable, "-m", "binpick", "run", "--cell", str(path)]
    log = folder / f"{ports[0]}.log"
    with log.open("wb") as said:
        process = subprocess.Popen(command, stdout=said, stderr=subprocess.STDOUT, start_new_session=True, env=environment)
    try:
        until = time.monotonic() + 30
        while "binpick is up" not in log.read_text():
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < until, log.read_text()
            time.sleep(0.05)
        # one for all requests: to make a client takes longer than what the daemon may take to refuse a cycle
        with httpx.Client(base_url=f"http://127.0.0.1:{ports[0]}", timeout=5) as client:
            yield Cell(process, log, client, ports[1], clock)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def ends_well(cell: Cell) -> float:
    """SIGTERM: exit code 0 within 3 s and nothing left; how long it took."""
    children = psutil.Process(cell.process.pid).children(recursive=True)
    sent = cell.clock()
    cell.process.send_signal(signal.SIGTERM)
    assert cell.process.wait(10) == 0, cell.log.read_text()
    took = cell.clock() - sent
    assert took < 3
    assert [child for child in children if child.is_running()] == []
    assert "Traceback" not in cell.log.read_text(), cell.log.read_text()
    return took


def camera_reasons(cell: Cell) -> list[str]:
    reasons = cell.health()["reasons"]
    assert isinstance(reasons, list)
    return [reason for reason in reasons if reason.startswith("camera ")]


def expose(begin: Callable[[], None], end: Callable[[], None]) -> None:
    """Begins a cycle and waits into its exposure; again, when the machine stood still until that may have been over."""
    while True:
        begin()
        begun = time.monotonic()
        time.sleep(EXPOSURE_S / 5)
        if time.monotonic() - begun < EXPOSURE_S / 2:
            return
        end()


@contextlib.contextmanager
def started(cell: Cell) -> Iterator[Future[httpx.Response]]:
    """A cycle over REST whose exposure has begun."""
    answers: list[Future[httpx.Response]] = []

    def begin() -> None:
        answers.append(pool.submit(cell.cycle))
        cell.wait(lambda: answers[-1].done() or '"current":0' not in event(cell), "acquiring", 2)

    with ThreadPoolExecutor(1, thread_name_prefix="controller") as pool:
        expose(begin, lambda: cell.wait(lambda: answers[-1].done() and cell.ready(), "ready for another"))
        assert not answers[-1].done()
        yield answers[-1]


def event(cell: Cell) -> str:
    """The state that a client of the events is told first."""
    with cell.client.stream("GET", "/v1/events") as response:
        return next(line for line in response.iter_lines() if line.startswith("data:"))


def kill(gige: GigePair, *indices: int) -> None:
    """At once, not one after the other."""
    killers = [threading.Thread(target=gige.kill, args=(index,)) for index in indices]
    for killer in killers:
        killer.start()
    for killer in killers:
        killer.join()


def test_both_killed_in_mid_exposure_over_rest_and_back(tmp_path: Path, gige: GigePair, clock: Callable[[], float]) -> None:
    with daemon(tmp_path, gige, "rest", clock) as cell:
        cell.wait(cell.ready, "ready")
        with started(cell) as answer:
            asked = clock()
            refused = cell.cycle()
            assert (refused.status_code, refused.json()["code"]) == (409, BUSY_CODE)
            assert clock() - asked < 0.3
        assert answer.result().status_code == 200, answer.result().text      # unharmed by the one that was refused
        assert cell.cycle(timeout_ms=int(500 * EXPOSURE_S)).json()["code"] == TIMEOUT
        assert camera_reasons(cell) == []                                    # a short limit is no fault of theirs
        cell.wait(cell.ready, "ready")
        with started(cell) as answer:
            dead = clock()
            kill(gige, 0, 1)
            problem = answer.result().json()
            assert clock() - dead < 2
        assert (answer.result().status_code, problem["code"]) == (503, CAMERAS)
        assert re.search("left.*check.*right.*check", problem["detail"]), problem
        assert cell.get("/v1/health/ready").status_code == 503
        assert cell.get("/v1/health/live").status_code == 200
        names = [re.match(r"camera (\w+) is down: .*: check ", reason) for reason in camera_reasons(cell)]
        assert [name and name[1] for name in names] == ["left", "right"], cell.health()
        assert cell.cycle().json()["code"] == -11
        for index in (0, 1):
            gige.restart(index)
        cell.wait(cell.ready, "ready again")
        assert cell.health()["reasons"] == []
        assert cell.cycle().status_code == 200
        gige.change(0, plugged=False)
        assert cell.wait(lambda: not cell.ready(), "noticed though idle") < 3
        assert camera_reasons(cell)[0].startswith("camera left is down: "), cell.health()
        gige.change(0, plugged=True)
        assert cell.wait(cell.ready, "ready once more") < 10
        assert cell.cycle().status_code == 200
        ends_well(cell)


def test_a_host_that_stands_still_for_half_a_second_loses_nothing(tmp_path: Path, gige: GigePair,
                                                                  clock: Callable[[], float]) -> None:
    with daemon(tmp_path, gige, "rest", clock) as cell, ThreadPoolExecutor(1, thread_name_prefix="controller") as pool:
        cell.wait(cell.ready, "ready")
        for after_s in (0.01, EXPOSURE_S / 2, EXPOSURE_S):
            answer = pool.submit(cell.cycle)
            time.sleep(after_s)
            cell.process.send_signal(signal.SIGSTOP)
            time.sleep(0.5)
            cell.process.send_signal(signal.SIGCONT)
            assert answer.result().status_code == 200, answer.result().text
        assert cell.health()["reasons"] == []
        ends_well(cell)


def test_both_killed_in_mid_exposure_over_modbus_and_back(tmp_path: Path, gige: GigePair, clock: Callable[[], float]) -> None:
    with daemon(tmp_path, gige, "modbus", clock) as cell, Registers(cell.modbus_port) as plc:
        plc.write(0, ENABLE)
        plc.until(READY)
        assert plc.read(14, 1)[0] == BOTH_CONNECTED
        expose(plc.begin, plc.end)
        running = plc.commands
        plc.write(2, running + 1)            # another command while the first is busy
        assert plc.status() & (NACK | BUSY) == NACK | BUSY
        assert signed(plc.read(15, 1)[0]) == BUSY_CODE
        plc.until(VALID)
        assert (signed(plc.read(105, 1)[0]) >= 0, plc.read(102, 1)[0]) == (True, running)     # the first, unharmed
        plc.commands += 1
        plc.end()

        expose(plc.begin, plc.end)
        dead = clock()
        kill(gige, 0, 1)
        plc.until(ERROR)
        assert clock() - dead < 2
        status, *_, states, latched = plc.read(10, 6)
        assert status & (READY | VALID | BUSY) == 0
        assert (signed(latched), signed(plc.read(105, 1)[0])) == (CAMERAS, CAMERAS)
        assert states == BOTH_IN_ERROR
        plc.acknowledge()
        time.sleep(0.3)
        assert plc.status() & READY == 0
        assert len(camera_reasons(cell)) == 2

        for index in (0, 1):
            gige.restart(index)
        plc.until(READY)
        plc.begin()
        plc.until(VALID | ERROR)
        assert plc.status() & ERROR == 0, plc.read(100, 20)
        ends_well(cell)


def latencies_ms(plc: Registers, stop: threading.Event, reads: Callable[[float], None], clock: Callable[[], float]) -> None:
    while not stop.wait(0.002):
        asked = clock()
        plc.read(100, 125)
        reads(1000 * (clock() - asked))


def test_one_killed_is_named_alone_and_its_stuck_thread_delays_nobody(tmp_path: Path, gige: GigePair,
                                                                      clock: Callable[[], float]) -> None:
    reads: list[float] = []
    stop = threading.Event()
    with daemon(tmp_path, gige, "rest", clock) as cell, Registers(cell.modbus_port) as plc:
        cell.wait(cell.ready, "ready")
        assert cell.cycle().status_code == 200
        kill(gige, 1)
        reader = threading.Thread(target=latencies_ms, args=(plc, stop, reads.append, clock), name="controller")
        reader.start()
        try:
            failed = clock()
            assert cell.cycle().json()["code"] == CAMERAS       # its trigger leaves a thread in the driver for 2.5 s
            assert clock() - failed < 2
            while clock() - failed < 6:         # and its farewell another 2.5 s, beside attempts to reopen
                asked = clock()
                [reason] = camera_reasons(cell)
                assert reason.startswith("camera right is down: ")
                assert "left" not in reason
                assert clock() - asked < 1
                time.sleep(0.05)
        finally:
            stop.set()
            reader.join()
        assert plc.read(14, 1)[0] == RIGHT_IN_ERROR
        assert len(reads) > 300
        assert max(reads) < 500, f"{len(reads)} reads; p50, p99, max {np.percentile(reads, [50, 99, 100])} ms"
        gige.restart(1)
        cell.wait(cell.ready, "ready again")
        gige.restart(0)                       # without power for a moment: it has forgotten who controls it
        lost = cell.cycle().json()
        assert (lost["code"], lost["detail"].startswith("camera left obeys this daemon no longer")) == (CAMERAS, True), lost
        cell.wait(cell.ready, "ready again")
        assert cell.cycle().status_code == 200, cell.log.read_text()       # though the right one was still exposing
        kill(gige, 0, 1)
        assert cell.cycle().json()["code"] == CAMERAS
        ends_well(cell)                       # with both threads in the driver


def test_a_killed_daemons_cameras_are_taken_over_when_they_let_go(tmp_path: Path, gige: GigePair,
                                                                  clock: Callable[[], float]) -> None:
    with daemon(tmp_path, gige, "rest", clock, HELD_MS) as first:
        first.wait(first.ready, "ready")
        with started(first):
            os.killpg(first.process.pid, signal.SIGKILL)
            killed, gone = time.monotonic(), clock()
            first.process.wait()
    with daemon(tmp_path, gige, "rest", clock) as second:
        second.wait(lambda: len(camera_reasons(second)) == 2, "refused by both cameras")
        assert time.monotonic() - killed < HELD_MS / 1000
        assert all("controlled by another program" in reason for reason in camera_reasons(second))
        second.wait(second.ready, "ready")
        assert time.monotonic() - killed > HELD_MS / 1000
        assert clock() - gone < HELD_MS / 1000 + 5
        assert second.cycle().status_code == 200
        assert second.health()["reasons"] == []
        ends_well(second)
