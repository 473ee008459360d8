"""`binpick-calib verify`: a verdict on images of a board, a sphere or a flat; the trend is kept and shown."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from binpick import geometry
from binpick.rig import Rig, dump
from binpick.rigcheck import board as boards
from binpick_calib import cli, trend

ENSENSO = Path(__file__).parents[2] / "../shared/data/ensenso_simulated/SIMULATED_fit_primitive"
BOARD = boards.parse("charuco:9x6:0.03")
SIZE = (960, 720)
FOCAL_PX, BASELINE_M = 900.0, 0.1
K = np.array([[FOCAL_PX, 0, 480], [0, FOCAL_PX, 360], [0, 0, 1]])
RADIUS_M, TABLE_M = 0.06, 0.6
CENTRE = np.array([0.04, -0.03, TABLE_M - RADIUS_M])


def rig_of(baseline_m: float = BASELINE_M) -> Rig:
    T = geometry.translation(-baseline_m, 0.0, 0.0)
    cameras = [{"name": name, "K": K.tolist(), "distortion": (0.0,) * 5, "T_cam_rig": step.tolist()}
               for name, step in (("left", np.eye(4)), ("right", T))]
    return Rig.model_validate({"image_size_px": SIZE, "cameras": cameras})


def printed(T_camera_board: geometry.Transform) -> np.ndarray:
    """A camera's view of the ChArUco board, twice oversampled."""
    side = 50
    sheet = BOARD.charuco.generateImage(((BOARD.columns + 1) * side, (BOARD.rows + 1) * side), None, 0)
    metres = BOARD.square_m / side
    # the board's frame begins at the first inner corner, the sheet a square before
    T_board_sheet = np.array([[metres, 0, (0.5 - side) * metres], [0, metres, (0.5 - side) * metres], [0, 0, 1]])
    H = np.array([[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1]]) @ K @ T_camera_board[:3, [0, 1, 3]] @ T_board_sheet
    large = cv2.warpPerspective(sheet // 2 + 60, H, (SIZE[0] * 2, SIZE[1] * 2), flags=cv2.INTER_AREA, borderValue=188)
    return cv2.resize(cv2.GaussianBlur(large, None, 1.5), SIZE, interpolation=cv2.INTER_AREA)


def shown(folder: Path, pitch_px: float = 0.0, x: float = 0.0) -> tuple[str, ...]:
    """Files of a pair whose right camera has pitched."""
    R = Rotation.from_euler("xyz", [15, -10, 5], degrees=True).as_matrix()
    T = geometry.make(R, np.array([x + 0.03, 0.0, 0.75]) - R @ BOARD.points_m.mean(0).astype(float))
    turned = geometry.make(Rotation.from_rotvec([-pitch_px / FOCAL_PX, 0, 0]).as_matrix(), np.zeros(3))
    left, right = folder / f"l{x}{pitch_px}.png", folder / f"r{x}{pitch_px}.png"
    cv2.imwrite(str(left), printed(T))
    cv2.imwrite(str(right), printed(turned @ geometry.translation(-BASELINE_M, 0.0, 0.0) @ T))
    return "--left", str(left), "--right", str(right)


def dotted(folder: Path, sphere: bool) -> tuple[str, ...]:
    """Files of a pair that looks at a table with a sphere on it, under a pattern of dots that falls along z."""
    noise = np.random.default_rng(5)
    pattern = cv2.GaussianBlur((noise.random((1200, 1600)) < 0.2).astype(np.float32), None, 0.8)
    pattern = np.clip(60 + 350 * pattern, 0, 250).astype(np.float32)
    files = []
    u, v = np.meshgrid(np.arange(SIZE[0]) - K[0, 2], np.arange(SIZE[1]) - K[1, 2])
    rays = np.stack([u / FOCAL_PX, v / FOCAL_PX, np.ones(u.shape)], axis=-1)
    for name, shift in (("left", 0.0), ("right", BASELINE_M)):
        centre = CENTRE - [shift, 0, 0]
        a, b = (rays**2).sum(2), rays @ centre
        inside = b**2 - a * (centre @ centre - RADIUS_M**2)
        z = np.where((inside > 0) & sphere, (b - np.sqrt(np.clip(inside, 0, None))) / a, TABLE_M)
        hit = rays * z[..., None] + [shift, 0, 0]
        per_m = 1 / 0.0012      # a dot of the pattern: 1.8 px
        across, down = (hit[..., :2] * per_m + [600, 500]).astype(np.float32).transpose(2, 0, 1)
        image = cv2.remap(pattern, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        image = np.clip(image + noise.normal(0, 2, image.shape), 0, 255).astype(np.uint8)
        files += [f"--{name}", str(folder / f"{name}.png")]
        cv2.imwrite(files[-1], image)
    return tuple(files)


def run(monkeypatch: pytest.MonkeyPatch, rig: Path, *args: str) -> int:
    monkeypatch.setattr("sys.argv", ["binpick-calib", "verify", "--rig", str(rig), *args])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    return int(stopped.value.code or 0)


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """A rig file."""
    path = tmp_path / "rig.json"
    path.write_bytes(dump(rig_of()))
    return path


def test_the_verdict_follows_the_rig(rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                     capsys: pytest.CaptureFixture[str]) -> None:
    board = ("--board", "charuco:9x6:0.03")
    assert run(monkeypatch, rig, *shown(tmp_path), *board) == 0
    assert capsys.readouterr().out.startswith("ok: Rows off by 0.0")
    assert run(monkeypatch, rig, *shown(tmp_path, 0.4), *board) == 0
    assert capsys.readouterr().out.startswith("warn: Partners lie 0.")
    assert run(monkeypatch, rig, *shown(tmp_path, 1.2), *board) == 1
    told = capsys.readouterr().out
    assert told.startswith("fault: Partners lie 1.")
    assert "Trend of this rig file" in told
    assert told.count("charuco") == 3
    rig.write_bytes(dump(rig_of(1.005 * BASELINE_M)))
    assert run(monkeypatch, rig, *shown(tmp_path), *board, "--json") == 1
    verdict = json.loads(capsys.readouterr().out)
    assert verdict["scale_permille"] == pytest.approx(5, abs=0.5)
    assert verdict["sentence"].startswith("The scale is off")
    assert [entry["level"] for entry in trend.read(rig)] == ["ok", "warn", "fault", "fault"]


def test_a_board_that_stays_tells_a_rig_that_moved(rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                                   capsys: pytest.CaptureFixture[str]) -> None:
    board = ("--board", "charuco:9x6:0.03", "--stays")
    assert run(monkeypatch, rig, *shown(tmp_path), *board, "--json") == 0
    assert json.loads(capsys.readouterr().out)["offset_m"] is None
    with trend.file(rig).open("a") as lines:
        lines.write('{"half a line')
    assert run(monkeypatch, rig, *shown(tmp_path, x=0.008), *board, "--json") == 1
    told = json.loads(capsys.readouterr().out)
    assert told["offset_m"] == pytest.approx(0.008, abs=0.0005)
    assert told["sentence"].endswith("Bring the rig back, or calibrate where it stands.")


def test_sphere_and_flat(rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                         capsys: pytest.CaptureFixture[str]) -> None:
    files = dotted(tmp_path, sphere=True)
    assert run(monkeypatch, rig, *files, "--sphere", str(RADIUS_M), "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert abs(told["scale_permille"]) < 15
    assert abs(told["scale_permille"]) < 3 * told["sigma_permille"]
    assert told["planarity_m"] < 0.0005
    assert told["distance_m"] == pytest.approx(np.linalg.norm(CENTRE), abs=0.001)
    assert run(monkeypatch, rig, *files, "--flat", "--json") == 0
    flat = json.loads(capsys.readouterr().out)
    assert flat["bend_m"] < 0.0005
    assert flat["level"] == "ok"


@pytest.mark.parametrize(("args", "said"), [
    (("--left", "a.png", "--right", "b.png"), "say what is in view"),
    (("--board", "charuco:9x6:0.03"), "say where the images come from"),
    (("--flat", "--url", "http://127.0.0.1:9"), "give --board"),
    (("--board", "charuco:9x6:0.03", "--url", "http://127.0.0.1:9"), "no daemon answers there"),
    (("--left", "a.png", "--right", "b.png", "--flat"), "not an image")])
def test_bad_options(args: tuple[str, ...], said: str, rig: Path, monkeypatch: pytest.MonkeyPatch,
                     capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(rig.parent)
    assert run(monkeypatch, rig, *args) == 2
    assert said in capsys.readouterr().err


def test_a_board_that_is_not_there(rig: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(rig.parent)
    cv2.imwrite("grey.png", np.full(SIZE[::-1], 90, np.uint8))
    assert run(monkeypatch, rig, "--left", "grey.png", "--right", "grey.png", "--board", "charuco:9x6:0.03") == 2
    assert "the board is not seen by: left, right (no board with 9x6" in capsys.readouterr().err
    assert trend.read(rig) == []


@pytest.mark.skipif(not ENSENSO.is_dir(), reason="the vendor's rendering of a sphere is not here")
def test_a_vendors_sphere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    known = json.loads(next(ENSENSO.glob("*_calib.json")).read_text())["Calibration"]
    turns = [np.array(known["Stereo"][side]["Rotation"]).T for side in ("Left", "Right")]
    T = geometry.make(turns[1].T @ turns[0], -turns[1].T @ np.array([0.1, 0, 0]))
    cameras = []
    for side, step in (("Left", np.eye(4)), ("Right", T)):
        own = known["Monocular"][side]
        terms = [own["Distortion"][name] for name in ("K1", "K2", "T1", "T2", "K3")]
        cameras.append({"name": side.lower(), "K": np.array(own["Camera"]).T.tolist(), "distortion": terms,
                        "T_cam_rig": step.tolist()})
    rig = tmp_path / "rig.json"
    rig.write_bytes(dump(Rig.model_validate({"image_size_px": (1280, 1024), "cameras": cameras})))
    files = [str(next(ENSENSO.glob(f"*_{side}.png"))) for side in ("left", "right")]
    assert run(monkeypatch, rig, "--left", files[0], "--right", files[1], "--sphere", "0.05", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    # a pixel of disparity is 6.5 mm there, and the cap that faces the cameras 20 mm high
    assert abs(told["scale_permille"]) < 25
    assert abs(told["scale_permille"]) < 3 * told["sigma_permille"]
    assert told["planarity_m"] < 0.0004
