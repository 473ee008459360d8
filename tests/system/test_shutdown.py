"""SIGINT and SIGTERM end the daemon with exit code 0 within 3 s in every state, with an SSE client and a page open."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import httpx
import numpy as np
import psutil
import pytest
from websockets.sync.client import ClientConnection, connect

import ports
from binpick import pipeline, recording
from binpick import rig as rig_file
from binpick.rig import Rig

CELL = Path(__file__).parents[1] / "slow_cell.py"
LIMIT_S = 3.0
EYE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
K = ((300.0, 0.0, 160.0), (0.0, 300.0, 100.0), (0.0, 0.0, 1.0))
STATES = ["starting", "ready", "acquiring", "computing", "valid"]
MODES = {"starting": "stuck-open", "acquiring": "stuck-capture"}


@dataclass
class Daemon:
    process: subprocess.Popen[str]
    base: str
    clock: Callable[[], float]

    def wait_for(self, phase: str) -> None:
        """Reads events until the cell is in that phase ("valid": holds a result)."""
        with httpx.stream("GET", f"{self.base}/v1/events", timeout=30) as response:
            for line in response.iter_lines():
                if line.startswith("data:"):
                    state = json.loads(line.removeprefix("data:"))
                    if state.get("phase") == phase or (phase == "valid" and state.get("valid")):
                        return
        pytest.fail(f"the daemon ended before it was {phase}")


@contextmanager
def daemon(*command: str, rest_port: int, clock: Callable[[], float]) -> Iterator[Daemon]:
    """The daemon once it serves; killed with all its children if the test leaves it alive."""
    # NiceGUI stops in another way when it believes to be under test
    environment = {key: value for key, value in os.environ.items() if key != "PYTEST_CURRENT_TEST"}
    process = subprocess.Popen([sys.executable, *command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                               start_new_session=True, env=environment)
    try:
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("binpick is up"):
                break
        else:
            pytest.fail(f"the daemon ended with {process.wait()}")
        yield Daemon(process, f"http://127.0.0.1:{rest_port}", clock)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def ends_well(running: Daemon, number: int) -> None:
    children = psutil.Process(running.process.pid).children(recursive=True)
    sent = running.clock()
    running.process.send_signal(number)
    assert running.process.wait(LIMIT_S + 7) == 0
    assert running.clock() - sent < LIMIT_S
    assert running.process.stdout is not None
    assert "Traceback" not in running.process.stdout.read()
    assert [child for child in children if child.is_running()] == []


@contextmanager
def listening(running: Daemon) -> Iterator[httpx.Response]:
    with httpx.stream("GET", f"{running.base}/v1/events", timeout=30) as response:
        assert response.status_code == 200
        yield response


@contextmanager
def page(running: Daemon) -> Iterator[ClientConnection]:
    """The page as a browser holds it open: its HTML, then NiceGUI's socket with the handshake in the query."""
    html = httpx.get(f"{running.base}/ui/", timeout=30).text
    client_id = re.search(r"'client_id': '([^']+)'", html)
    assert client_id is not None
    query = (f"EIO=4&transport=websocket&implicit_handshake=true&client_id={client_id[1]}&document_id=d&tab_id=t&old_tab_id="
             "&next_message_id=0")
    with connect(f"{running.base.replace('http', 'ws')}/ui/_nicegui_ws/socket.io/?{query}", open_timeout=30) as socket_io:
        assert str(socket_io.recv(30)).startswith("0{")
        socket_io.send("40")
        assert str(socket_io.recv(30)).startswith("40{")
        yield socket_io


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("state", STATES)
def test_a_signal_ends_the_daemon_in_every_state(state: str, number: int, clock: Callable[[], float]) -> None:
    rest_port, modbus_port = ports.free(2)
    command = (str(CELL), str(rest_port), str(modbus_port), MODES.get(state, "quick"))
    with (daemon(*command, rest_port=rest_port, clock=clock) as running, socket.create_connection(("127.0.0.1", modbus_port)),
          listening(running) as events, page(running)):
        if state != "starting":
            running.wait_for("ready")
        if state in ("acquiring", "computing", "valid"):
            assert httpx.post(f"{running.base}/v1/cycles", timeout=10).status_code == 202
        running.wait_for(state)
        ends_well(running, number)
        assert '"phase":"stopping"' in events.read().decode()


def test_a_waiting_client_is_told_and_a_second_signal_exits_at_once(clock: Callable[[], float]) -> None:
    rest_port, modbus_port = ports.free(2)
    command = (str(CELL), str(rest_port), str(modbus_port), "stuck-capture")
    with daemon(*command, rest_port=rest_port, clock=clock) as running:
        running.wait_for("ready")
        waiting = subprocess.Popen([sys.executable, "-c", "import httpx, sys; print(httpx.post(sys.argv[1], timeout=30).text)",
                                    f"{running.base}/v1/cycles?wait=true"], stdout=subprocess.PIPE, text=True)
        running.wait_for("acquiring")
        running.process.send_signal(signal.SIGINT)
        problem = json.loads(waiting.communicate(timeout=10)[0])
        assert problem["code"] in (-11, -26)
        sent = clock()
        running.process.send_signal(signal.SIGINT)
        assert running.process.wait(5) == 128 + signal.SIGINT
        assert clock() - sent < 1


def cell_folder(tmp_path: Path, rest_port: int, modbus_port: int) -> Path:
    """A cell on two black images."""
    size = (320, 200)
    rig = Rig.model_validate({"image_size_px": size, "cameras": [
        {"name": name, "K": K, "distortion": (0, 0, 0, 0), "T_cam_rig": T}
        for name, T in (("left", EYE), ("right", ((1.0, 0.0, 0.0, -0.15), *EYE[1:])))]})
    (tmp_path / "rig.json").write_bytes(rig_file.dump(rig))
    for name in ("left", "right"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros(size[::-1], np.uint8))
    (tmp_path / "cell.yaml").write_text(f"""
bin: {{inner_size_m: [0.6, 0.4, 0.18], pose: {{position_m: [0, 0, 1.0], rotvec_rad: [3.1415926, 0, 0]}}}}
recipes: [{{frame: camera}}]
cameras: {{backend: files, left: left.png, right: right.png}}
control: rest
recording: {{directory: {tmp_path / "kept"}}}
publish: {{rest: {{port: {rest_port}}}, modbus: {{host: 127.0.0.1, port: {modbus_port}}}}}
""")
    return tmp_path / "cell.yaml"


def test_the_command_serves_a_cell_from_files_records_its_cycle_and_stops(tmp_path: Path, clock: Callable[[], float]) -> None:
    rest_port, modbus_port = ports.free(2)
    cell = cell_folder(tmp_path, rest_port, modbus_port)
    with daemon("-m", "binpick", "run", "--cell", str(cell), rest_port=rest_port, clock=clock) as running:
        running.wait_for("ready")
        health = httpx.get(f"{running.base}/v1/health").json()
        assert health.pop("rig").startswith("version 1, sha256 ")
        assert any("yaw" in blind for blind in health.pop("unseen"))
        assert health == {"status": "ok", "live": True, "ready": True, "reasons": []}
        answer = httpx.post(f"{running.base}/v1/cycles?wait=true", timeout=30)
        assert answer.json()["return_code"]["value"] == 105
        ends_well(running, signal.SIGTERM)
    kept = list((tmp_path / "kept").iterdir())
    assert [path.name[-7:] for path in kept] == ["-000001"]
    inputs, stored = recording.load(kept[0])
    assert stored.return_code.value == 105
    assert pipeline.run(inputs).result.timeless_bytes() == stored.timeless_bytes()


def test_a_cell_that_cannot_be_served_is_one_line_and_exit_2(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "binpick", "run", "--cell", str(cell_folder(tmp_path, 8080, 502))]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=50, check=False)
    assert (ended.returncode, ended.stderr.count("\n")) == (2, 1)
    assert ended.stderr.startswith("binpick: camera left is simulated")
