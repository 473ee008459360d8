"""What a user can get wrong from the command line: one line that says what to do, the right exit code, no traceback."""

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from binpick import demo
from binpick.sim.gige import GigePair


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """A sound cell file, rig file and pair of (black) images to spoil."""
    demo.files(demo.Plan(cameras=("127.0.33.2", "127.0.33.3")), tmp_path)
    for name in ("left.png", "right.png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((1216, 1936), np.uint8))
    return tmp_path


def binpick(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "binpick", *map(str, arguments)], capture_output=True, text=True, timeout=50)


def pick(folder: Path) -> subprocess.CompletedProcess[str]:
    return binpick("pick", "--left", folder / "left.png", "--right", folder / "right.png", "--rig", folder / "rig.json",
                   "--cell", folder / "cell.yaml", "--out", folder / "out")


def missing_image(folder: Path) -> None:
    (folder / "left.png").unlink()


def unreadable_image(folder: Path) -> None:
    (folder / "left.png").write_text("no image")


def small_images(folder: Path) -> None:
    for name in ("left.png", "right.png"):
        cv2.imwrite(str(folder / name), np.zeros((608, 968), np.uint8))


def foreign_rig(folder: Path) -> None:
    (folder / "rig.json").write_text(json.dumps({"format": "other-rig", "version": 1}))


def edited_rig(folder: Path) -> None:
    rig = json.loads((folder / "rig.json").read_text())
    rig["cameras"][0]["K"][0][0] += 1
    (folder / "rig.json").write_text(json.dumps(rig))


def missing_rig(folder: Path) -> None:
    (folder / "rig.json").unlink()


def unknown_key(folder: Path) -> None:
    with (folder / "cell.yaml").open("a") as file:
        file.write("exposure: 3\n")


def value_out_of_range(folder: Path) -> None:
    with (folder / "cell.yaml").open("a") as file:
        file.write("timeout_ms: 5\n")


def out_is_a_file(folder: Path) -> None:
    (folder / "out").write_text("")


@pytest.mark.parametrize(("spoil", "names"), [
    (missing_image, ["left.png", "No such file"]),
    (unreadable_image, ["left.png"]),
    (small_images, ["968x608", "1936x1216"]),
    (foreign_rig, ["rig.json", "binpick-rig"]),
    (edited_rig, ["rig.json", "sha256"]),
    (missing_rig, ["rig.json", "binpick-calib"]),
    (unknown_key, ["cell.yaml:", "exposure: unknown key"]),
    (value_out_of_range, ["cell.yaml:", "timeout_ms", "100"]),
    (out_is_a_file, ["out", "cannot be written"]),
], ids=lambda value: getattr(value, "__name__", ""))
def test_pick_says_in_one_line_what_is_wrong(files: Path, spoil, names) -> None:
    spoil(files)
    done = pick(files)
    assert done.returncode == 2, done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("binpick:")]
    assert len(lines) == 1
    assert "Traceback" not in done.stderr
    for name in names:
        assert name in lines[0]


def test_black_images_have_no_depth_and_exit_code_1(files: Path) -> None:
    done = pick(files)
    assert done.returncode == 1
    result = json.loads((files / "out" / "result.json").read_text())
    assert result["return_code"]["value"] == 105
    assert result["grasps"] == []


@pytest.mark.gige
def test_check_names_an_address_without_a_camera(files: Path) -> None:
    done = binpick("check", "--cell", files / "cell.yaml")
    assert done.returncode == 3
    assert "127.0.33.2" in done.stdout
    assert "no camera answers" in " ".join(done.stdout.split())


@pytest.mark.gige
def test_check_names_a_camera_held_by_another_program(files: Path) -> None:
    image = np.zeros((1216, 1936), np.uint8)
    with GigePair(lambda _index, _light, _shot: image, ("127.0.33.2", "127.0.33.3")):
        command = [sys.executable, "-W", "ignore", "-c", HOLD, "127.0.33.2"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stdin=subprocess.PIPE) as first:
            assert first.stdout is not None
            assert first.stdout.readline() == b"held\n"
            done = binpick("check", "--cell", files / "cell.yaml")
            first.kill()
    assert done.returncode == 3
    assert "another program" in " ".join(done.stdout.split())


HOLD = """
import sys
import gi
gi.require_version("Aravis", "0.8")
from gi.repository import Aravis
camera = Aravis.Camera.new(sys.argv[1])
camera.set_integer("GevHeartbeatTimeout", 3000)
print("held", flush=True)
sys.stdin.read()
"""
