"""Capture with cameras on the wire: by itself, and through the daemon that holds them; and the daemon's verdict."""

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import httpx
import pytest

from binpick import rig as rig_file
from binpick.data import Image, Light
from binpick.rigcheck import board as boards
from binpick.rigcheck.coverage import Coverage
from binpick.sim.gige import GigePair
from binpick_calib import capture, cli, moments
from binpick_calib.capture import Step

pytestmark = [pytest.mark.gige]

CELL = """
cameras: {{backend: aravis, max_skew_us: 500000, left: {{address: {left}}}, right: {{address: {right}}}}}
bins: [{{inner_size_m: [0.3, 0.2, 0.1], pose: {{frame: camera, position_m: [0.04, 0, 0.6], rotvec_rad: [3.14159265, 0, 0]}}}}]
recipes: [{{frame: camera, exposure_us: 2000}}]
rig: rig.json
control: rest
timeout_ms: 30000
publish: {{rest: {{port: {port}}}, modbus: null}}
"""
EACH = 3
"""Shots that show the board at one place, before it moves on."""


class Show:
    """Cameras that are shown the board at one place after the other; both see the same moment."""

    def __init__(self, shown: Any) -> None:
        self.pairs = shown.pairs
        self.lights: list[Light] = []

    def image(self, index: int, light: Light, shot: int) -> Image:
        self.lights.append(light)
        picture: Image = self.pairs[min(shot // EACH, len(self.pairs) - 1)][index]
        return picture


@pytest.fixture
def cell(shown_board: Any, gige_addresses: tuple[str, str], free_port: int, tmp_path: Path) -> Path:
    """A cell file of the cameras and a rig file that fits them."""
    path = tmp_path / "cell.yaml"
    path.write_text(CELL.format(left=gige_addresses[0], right=gige_addresses[1], port=free_port))
    steps = [[[float(i == j) for j in range(4)] for i in range(4)], shown_board.T_right_left.tolist()]
    cameras = [{"name": name, "K": shown_board.K.tolist(), "distortion": (0.0,) * 5, "T_cam_rig": T}
               for name, T in zip(("left", "right"), steps, strict=True)]
    (tmp_path / "rig.json").write_bytes(rig_file.dump(rig_file.Rig.model_validate(
        {"image_size_px": shown_board.size, "cameras": cameras})))
    return path


@pytest.fixture
def show(shown_board: Any, gige_addresses: tuple[str, str]) -> Iterator[Show]:
    shown = Show(shown_board)
    with GigePair(shown.image, gige_addresses, shown_board.size):
        yield shown


def run(monkeypatch: pytest.MonkeyPatch, *args: str) -> int:
    monkeypatch.setattr("sys.argv", ["binpick-calib", *args])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    return int(stopped.value.code or 0)


def test_cameras_are_shown_a_board_and_a_rig_comes_of_it(shown_board: Any, show: Show, cell: Path, tmp_path: Path,
                                                         monkeypatch: pytest.MonkeyPatch,
                                                         capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(moments, "PAUSE_S", 0.01)
    out = tmp_path / "views"
    assert run(monkeypatch, "capture", "--cell", str(cell), "--board", shown_board.spec, "--out", str(out)) == 0
    told = capsys.readouterr()
    assert "Looking at the cameras of " in told.err
    assert "not taken: the board moves: " in told.err
    assert ": enough." in told.out
    assert not any(light.projector for light in show.lights)
    files = ("--left", f"{out}/left_*.png", "--right", f"{out}/right_*.png", "--out", str(tmp_path / "solved.json"))
    assert run(monkeypatch, "solve", *files, "--board", shown_board.spec, "--json") == 0
    solved = json.loads(capsys.readouterr().out)
    assert solved["rms_px"] < 0.06
    assert solved["row_error_px"] < 0.03
    assert solved["focal_px"]["left"] == pytest.approx([620, 622], rel=0.001)


@pytest.mark.slow
def test_a_daemon_that_holds_the_cameras_takes_the_views(shown_board: Any, show: Show, cell: Path, free_port: int,
                                                         tmp_path: Path) -> None:
    board, out, steps = boards.parse(shown_board.spec), tmp_path / "views", list[Step]()
    out.mkdir()
    url = f"http://127.0.0.1:{free_port}"
    daemon = subprocess.Popen([sys.executable, "-m", "binpick", "run", "--cell", str(cell)], cwd=tmp_path)
    try:
        coming = islice(moments.of_daemon(_ready(url), str(board)), 8)
        covered = capture.capture(coming, board, out, Coverage(), steps.append)
        kept = httpx.get(f"{url}/v1/calibration/samples").json()["samples"]
    finally:
        daemon.terminate()
        daemon.wait(20)
    said = [step.said for step in steps]
    assert len(covered.views) >= 2, said
    assert "the board has just come into view" in said
    assert sorted(path.name for path in out.glob("left_*")) == [f"left_{n:03d}.png" for n in range(1, len(covered.views) + 1)]
    # those that were not taken are deleted there again
    assert len(kept) == len(covered.views)


def _ready(url: str) -> httpx.Client:
    until = time.monotonic() + 120
    while time.monotonic() < until:
        client = moments.daemon(url)
        if client is not None:
            if client.get("/v1/health/ready").status_code == 200:
                return client
            client.close()
        time.sleep(0.2)
    raise TimeoutError("the daemon did not become ready")


@pytest.mark.slow
def test_a_daemon_verifies_by_a_board(shown_board: Any, show: Show, cell: Path, free_port: int, tmp_path: Path,
                                      monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    url, rig = f"http://127.0.0.1:{free_port}", str(tmp_path / "rig.json")
    daemon = subprocess.Popen([sys.executable, "-m", "binpick", "run", "--cell", str(cell)], cwd=tmp_path)
    try:
        _ready(url).close()
        code = run(monkeypatch, "verify", "--rig", rig, "--url", url, "--board", shown_board.spec, "--json")
        told = json.loads(capsys.readouterr().out)
    finally:
        daemon.terminate()
        daemon.wait(20)
    assert code == 0, told
    assert told["level"] == "ok"
    assert told["gauge"] == shown_board.spec
    assert abs(told["row_px"]) < 0.05
    assert abs(told["scale_permille"]) < 1
