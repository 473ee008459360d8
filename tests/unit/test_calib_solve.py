"""The calibration tool: recovers a planted rig from drawn boards, and OpenCV's own pairs; says what is wrong with bad input."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import printed
from binpick import geometry, rig
from binpick.errors import InputError
from binpick.rigcheck import board as boards
from binpick.rigcheck import sight
from binpick.rigcheck.detection import Detection
from binpick_calib import cli, views

SAMPLES = Path(__file__).parents[2] / "../shared/data/opencv_samples"
TITANIA = Path(__file__).parents[2] / "../shared/data/i3dr_titania/checker_sample"
needs_samples = pytest.mark.skipif(not SAMPLES.is_dir(), reason="OpenCV's stereo samples do not lie in ../shared/data")
needs_titania = pytest.mark.skipif(not TITANIA.is_dir(), reason="the industrial stereo sample does not lie in ../shared/data")
BOARD = boards.Board(9, 6, 0.025)
SIZE = (640, 480)
K = np.array([[620.0, 0, 322], [0, 622, 238], [0, 0, 1]])
T_RIGHT_LEFT = geometry.make(Rotation.from_euler("xyz", [0.4, -3, 0.8], degrees=True).as_matrix(),
                             np.array([-0.12, 0.001, 0.002]))
TILTS_DEG = [(0, 0, 5), (25, 0, 0), (-25, 5, 10), (0, 25, -10), (5, -25, 0), (20, 20, 80), (-20, 20, 0), (15, -25, 185)]


def draw(T_camera_board: geometry.Transform) -> np.ndarray:
    """Through a lens that blurs by 0.75 px; bare steps would move the corners by 0.06 px."""
    return printed.seen(printed.chessboard(BOARD.columns, BOARD.rows), BOARD.square_m, K, T_camera_board, SIZE, 4, 3)


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight views of the planted rig, as files."""
    folder = tmp_path_factory.mktemp("shots")
    for number, tilt in enumerate(TILTS_DEG, start=1):
        R = Rotation.from_euler("xyz", tilt, degrees=True).as_matrix()
        middle = np.array([0.06 + 0.04 * (number % 3 - 1), 0.05 * (number % 2) - 0.025, 0.44 + 0.02 * number])
        T_left_board = geometry.make(R, middle - R @ BOARD.points_m.mean(0).astype(float))
        cv2.imwrite(str(folder / f"Left{number:02d}.png"), draw(T_left_board))
        cv2.imwrite(str(folder / f"RIGHT_{number}.PNG"), draw(T_RIGHT_LEFT @ T_left_board))
    return folder


def run(monkeypatch: pytest.MonkeyPatch, *args: str) -> int:
    """The exit code of `binpick-calib solve`."""
    monkeypatch.setattr("sys.argv", ["binpick-calib", "solve", *args])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    return int(stopped.value.code or 0)


def arguments(folder: Path, out: Path, left: str = "left*.png", right: str = "right*.png",
              board: str = "chessboard:9x6:0.025") -> list[str]:
    return ["--left", str(folder / left), "--right", str(folder / right), "--board", board, "--out", str(out)]


def test_recovers_the_planted_rig(shots: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                  capsys: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(shots / "left99.png"), np.zeros((480, 640), np.uint8))
    out = tmp_path / "rig.json"
    assert run(monkeypatch, *arguments(shots, out), "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["views"] == 8
    assert told["unused"] == {"left99.png": "no partner with number 99"}
    # corners in drawn images are found to 0.03 px; eight views then hold f to 0.1 % and the baseline to 0.1 mm
    assert told["rms_px"] < 0.04
    assert told["row_error_px"] < 0.03
    assert told["focal_px"]["left"] == pytest.approx([620, 622], rel=0.001)
    assert told["baseline_m"] == pytest.approx(np.linalg.norm(T_RIGHT_LEFT[:3, 3]), abs=0.0001)
    read, warnings = rig.load(out)
    assert warnings == []
    assert read.image_size_px == SIZE
    assert read.board == "chessboard:9x6:0.025"
    assert read.quality is not None
    assert set(read.quality.per_view_px) == {str(n) for n in range(1, 9)}
    T = read.cameras[1].T_camera_rig
    assert T[:3, 3] == pytest.approx(T_RIGHT_LEFT[:3, 3], abs=0.0002)
    turn = Rotation.from_matrix(T[:3, :3].T @ T_RIGHT_LEFT[:3, :3]).magnitude()
    assert np.degrees(turn) < 0.05


@needs_samples
def test_opencv_pairs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(monkeypatch, *arguments(SAMPLES, tmp_path / "rig.json", "left*.jpg", "right*.jpg"), "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["views"] == 13
    assert told["rms_px"] <= 0.22
    assert told["row_error_px"] <= 0.13
    assert told["baseline_squares"] == pytest.approx(3.33, abs=0.02)
    assert told["unused"] == {"left.jpg": "no number in its name", "right.jpg": "no number in its name"}
    quality = rig.load(tmp_path / "rig.json")[0].quality
    assert quality is not None
    assert len(quality.per_view_px) == 13
    assert (quality.rms_px, quality.row_error_px) == (told["rms_px"], told["row_error_px"])


@needs_titania
def test_a_verged_industrial_pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    # 10x6 corners look the same upside down
    assert run(monkeypatch, *arguments(TITANIA, tmp_path / "rig.json", "*_l.png", "*_r.png", "chessboard:10x6:0.025"),
               "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["views"] == 13
    assert told["rms_px"] <= 0.07
    assert told["unused"] == {}


@needs_samples
def test_a_spoiled_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """One partner swapped, one board shifted, one view blurred, four views mirrored, at once, by files."""
    images = {path.name: cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for side in ("left", "right")
              for path in SAMPLES.glob(f"{side}??.jpg")}
    spoiled = images | {"right04.jpg": images["right08.jpg"], "left06.jpg": cv2.GaussianBlur(images["left06.jpg"], None, 2),
                        "right12.jpg": cv2.warpAffine(images["right12.jpg"], np.array([[1.0, 0, 3], [0, 1, 0]]), None)}
    spoiled |= {f"{side}{view}.jpg": np.ascontiguousarray(images[f"{side}{view}.jpg"][:, ::-1])
                for side in ("left", "right") for view in ("01", "02", "03", "13")}
    for name, image in spoiled.items():
        cv2.imwrite(str(tmp_path / name.replace("jpg", "png")), image)
    assert run(monkeypatch, *arguments(tmp_path, tmp_path / "rig.json"), "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert {files: why.split(":")[0] for files, why in told["unused"].items()} == {
        "left06.png": "blurred", "left04.png, right04.png": "wrong partner",
        "left12.png, right12.png": "the board moved between the two images",
        **{f"left{view}.png, right{view}.png": "both images of this view are mirrored" for view in ("01", "02", "03", "13")}}
    assert told["baseline_squares"] == pytest.approx(3.327, rel=0.02)
    assert told["focal_px"]["left"] == pytest.approx([533.6, 533.6], rel=0.02)


def test_people_read_a_table(shots: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                             capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "left.png").touch()
    assert run(monkeypatch, *arguments(shots, tmp_path / "rig.json", left="[Ll]eft0*.png")) == 0
    shown = capsys.readouterr().out
    assert "focal length left" in shown
    assert f"Written: {tmp_path / 'rig.json'}" in "".join(shown.splitlines())


def test_a_turned_image_numbers_the_same_printed_corner(shots: Path) -> None:
    image = cv2.imread(str(shots / "Left02.png"), cv2.IMREAD_GRAYSCALE)
    upright, turned = sight.find(image, BOARD), sight.find(np.ascontiguousarray(image[::-1, ::-1]), BOARD)
    assert isinstance(upright, Detection)
    assert isinstance(turned, Detection)
    assert turned.corners_px == pytest.approx(np.array(SIZE) - 1 - upright.corners_px, abs=0.05)


@pytest.mark.parametrize(("spec", "said"), [
    ("chess:9x6:0.025", "chessboard:9x6:0.025"), ("chessboard:9x6", "write it as"), ("chessboard:6x6:0.025", "not the same"),
    ("chessboard:2x6:0.025", "3 to 50"), ("chessboard:9x6:25", "in metres"), ("chessboard:9x6:-1", "write it as")])
def test_bad_board(spec: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        boards.parse(spec)


def test_partners_are_found_by_number_not_by_order(tmp_path: Path) -> None:
    for name in ("cam0_2.png", "cam0_10.png", "CAM0_3.PNG", "notes.txt", "002_b1.png", "10_b1.png", "4_b1.png", "x_b.png"):
        (tmp_path / name).touch()
    with pytest.raises(InputError, match="carry the same number"):
        views.match(str(tmp_path / "cam*.png"), str(tmp_path / "*_b1.png"))
    for old in tmp_path.glob("*_b1.png"):
        old.rename(tmp_path / old.name.replace("b1", "b"))
    pairs, alone = views.match(str(tmp_path / "cam*.png"), str(tmp_path / "*_b.png"))
    assert [(p.number, *(path.name for path in p.files)) for p in pairs] == [
        (2, "cam0_2.png", "002_b.png"), (10, "cam0_10.png", "10_b.png")]
    assert alone == {"CAM0_3.PNG": "no partner with number 3", "4_b.png": "no partner with number 4",
                     "x_b.png": "no number in its name"}


def test_the_camera_may_be_numbered_too(tmp_path: Path) -> None:
    for number in (1, 2):
        for camera in (0, 1):
            (tmp_path / f"{number:04d}_cam{camera}.png").touch()
    pairs, _ = views.match(str(tmp_path / "*cam0.png"), str(tmp_path / "*cam1.png"))
    assert [tuple(path.name for path in p.files) for p in pairs] == [
        ("0001_cam0.png", "0001_cam1.png"), ("0002_cam0.png", "0002_cam1.png")]


@pytest.mark.parametrize(("change", "said"), [
    ({"left": "nothing*.png"}, "no file is called so"),
    ({"right": "board.png"}, "no left and right image carry the same number"),
    ({"right": "left*.png"}, "both find"),
    ({"board": "chessboard:8x5:0.025"}, "found in 0 pairs, 5 are needed; no board with 8x5 inner corners seen: Left01.png"),
    ({"right": "small*.png"}, "320x240 px, but the images before it are 640x480"),
    ({"right": "broken*.png"}, "cannot be read as an image: broken1.png"),
])
def test_bad_input_is_one_line_and_exit_code_2(shots: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                               capsys: pytest.CaptureFixture[str], change: dict[str, str], said: str) -> None:
    for number in (1, 2):
        cv2.imwrite(str(shots / f"small{number}.png"), np.zeros((240, 320), np.uint8))
        (shots / f"broken{number}.png").write_bytes(b"no image")
    (shots / "board.png").touch()
    assert run(monkeypatch, *arguments(shots, tmp_path / "rig.json", **change)) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("binpick-calib: ")
    assert said in lines[0]
    assert not (tmp_path / "rig.json").exists()


def test_unwritable_out(shots: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                        capsys: pytest.CaptureFixture[str]) -> None:
    for out, said in ((tmp_path / "missing" / "rig.json", "there is no folder"), (tmp_path, "Is a directory")):
        assert run(monkeypatch, *arguments(shots, out)) == 2
        assert said in capsys.readouterr().err
