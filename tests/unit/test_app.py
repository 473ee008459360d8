"""The composition root in this process: what it refuses before it serves, and that nothing of it stays behind."""

import os
import signal
import socket
import threading
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest

import staged
from binpick import app, settings
from binpick.cli.check import findings
from binpick.errors import InputError, PortInUse
from binpick.rig import dump
from ports import free

RIG = staged.rig((320, 200), 300.0)


@pytest.fixture
def ports() -> tuple[int, int]:
    one, other = free(2)
    return one, other


@pytest.fixture
def cell_file(tmp_path: Path, ports: tuple[int, int]) -> Path:
    """A cell on two black images."""
    (tmp_path / "rig.json").write_bytes(dump(RIG))
    for name in ("left", "right"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros((200, 320), np.uint8))
    (tmp_path / "cell.yaml").write_text(f"""
bin: {{inner_size_m: [0.6, 0.4, 0.18], pose: {{position_m: [0, 0, 1.0], rotvec_rad: [3.1415926, 0, 0]}}}}
recipes: [{{frame: camera}}]
cameras: {{backend: files, left: left.png, right: right.png}}
control: rest
publish: {{rest: {{port: {ports[0]}}}, modbus: {{host: 127.0.0.1, port: {ports[1]}}}}}
""")
    return tmp_path / "cell.yaml"


def serve(cell: settings.Cell) -> None:
    app.run(cell, RIG, app.cameras(cell))


def test_a_port_in_use_is_refused_by_name(cell_file: Path, ports: tuple[int, int]) -> None:
    for port in ports:
        with socket.create_server(("127.0.0.1", port)), pytest.raises(PortInUse, match=f"127.0.0.1:{port}"):
            serve(settings.load(cell_file))


def test_an_address_that_is_not_ours_is_refused() -> None:
    with pytest.raises(InputError, match=r"publish\.rest: cannot listen on 192\.0\.2\.1:8080: this machine has"):
        app.listen("192.0.2.1", 8080, "publish.rest")


def test_simulated_cameras_are_never_served_on_port_502(cell_file: Path) -> None:
    text = cell_file.read_text()
    cell_file.write_text(text[:text.rindex("port: ")] + "port: 502}}\n")
    with pytest.raises(InputError, match="camera left is simulated"):
        serve(settings.load(cell_file))
    seen = {finding.what: finding for finding in findings(cell_file)}
    assert "camera left is simulated" in seen["cameras"].fault


def test_a_daemon_serves_until_a_signal_and_leaves_nothing_behind(
        cell_file: Path, ports: tuple[int, int], capfd: pytest.CaptureFixture[str]) -> None:
    answers: list[httpx.Response] = []

    def client() -> None:
        base = f"http://127.0.0.1:{ports[0]}/v1"
        transport = httpx.HTTPTransport(retries=20)
        with httpx.Client(transport=transport, timeout=20) as http:
            while http.get(f"{base}/health/ready").status_code != 200:
                pass
            answers.append(http.post(f"{base}/cycles?wait=true"))
        os.kill(os.getpid(), signal.SIGTERM)

    thread = threading.Thread(target=client)
    thread.start()
    serve(settings.load(cell_file))
    thread.join()
    assert answers[0].json()["return_code"]["name"] == "no_depth"
    assert capfd.readouterr().out == (
        f"binpick is up: page http://127.0.0.1:{ports[0]}/ui, REST http://127.0.0.1:{ports[0]}/v1, "
        f"Modbus/TCP 127.0.0.1:{ports[1]}\n")


def test_check_finds_nothing_on_a_sound_cell(cell_file: Path) -> None:
    found = list(findings(cell_file))
    assert [finding.what for finding in found] == [
        "cell file", "publish.rest", "publish.modbus", "rig", "tool 1", "recipe 1", "cameras", "a pair of images"]
    assert "TCP is 0, 0, 250 mm, quaternion xyzw 0, 0, 0, 1" in found[4].seen
    assert "presses 2 mm" in found[4].seen
    assert [finding.fault for finding in found if finding.fault] == []


def test_check_goes_on_after_what_is_wrong(cell_file: Path, ports: tuple[int, int]) -> None:
    (cell_file.parent / "left.png").write_bytes(b"no picture")
    with socket.create_server(("127.0.0.1", ports[1])):
        found = {finding.what: finding for finding in findings(cell_file)}
    assert [what for what, finding in found.items() if finding.fault] == ["publish.modbus", "cameras"]
    assert "left.png" in found["cameras"].fault
    assert found["cameras"].exit_code == 2


def test_check_names_images_of_another_size_and_a_frame_without_hand_eye(cell_file: Path) -> None:
    for name in ("left", "right"):
        cv2.imwrite(str(cell_file.parent / f"{name}.png"), np.zeros((100, 160), np.uint8))
    cell_file.write_text(cell_file.read_text().replace("frame: camera", "frame: base"))
    found = {finding.what: finding for finding in findings(cell_file)}
    assert "160x100" in found["a pair of images"].fault
    assert "hand-eye" in found["recipe 1"].fault


def test_check_stops_where_nothing_more_can_be_seen(cell_file: Path) -> None:
    (cell_file.parent / "rig.json").unlink()
    assert [finding.what for finding in findings(cell_file)][-1] == "rig"
    cell_file.write_text("bin: 3")
    found = list(findings(cell_file))
    assert [(finding.what, finding.exit_code) for finding in found] == [("cell file", 2)]
