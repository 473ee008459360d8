"""`binpick-calib handeye` and `bin`: robots' tables read, rig files and bins written, and what is wrong said in one line."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

import printed
from binpick import geometry, poses, rig
from binpick.cycle import CycleInput
from binpick.errors import InputError
from binpick.geometry import Transform
from binpick.poses import PoseFormat
from binpick.rig import Rig
from binpick_calib import bin as bins
from binpick_calib import cli, robot

SIZE = (640, 480)
K = np.array([[620.0, 0, 322], [0, 622, 238], [0, 0, 1]])
T_RIGHT_LEFT = geometry.translation(-0.12, 0.0, 0.0)
SQUARE_M, COLUMNS, ROWS = 0.025, 9, 6
TILTS_DEG = [(0, 0, 5), (25, 0, 0), (-25, 5, 40), (0, 25, -30), (5, -25, 0), (20, 20, 80), (-20, 20, 0), (15, -25, 60)]
Q = Rotation.from_euler("ZYX", [30, -20, 110], degrees=True)


def placed(rotvec_deg: list[float], position_m: list[float]) -> Transform:
    return geometry.make(Rotation.from_rotvec(rotvec_deg, degrees=True).as_matrix(), np.array(position_m, dtype=float))


T_FLANGE_RIG = placed([0, 0, 90], [0.06, -0.03, 0.05])
T_BASE_BOARD = placed([180, 0, 30], [0.5, 0.1, 0.02])


def run(monkeypatch: pytest.MonkeyPatch, *args: object) -> int:
    monkeypatch.setattr("sys.argv", ["binpick-calib", *map(str, args)])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    return int(stopped.value.code or 0)


def write(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


ABC, WPR = Q.as_euler("ZYX", degrees=True), Q.as_euler("ZYX", degrees=True)[::-1]
ROTVEC, XYZW = Q.as_rotvec(), Q.as_quat()


def told(numbers: np.ndarray, separator: str = ",") -> str:
    return separator.join(f"{number:.6f}" for number in numbers)


@pytest.mark.parametrize(("lines", "options"), [
    (["name,x_mm,y_mm,z_mm,a,b,c", f"7,500,-120.5,310,{told(ABC)}"], {}),
    (["# robot 3", "image, X [mm], Y [mm], Z [mm], W (deg), P (deg), R (deg)", f"shot_07.png,500,-120.5,310,{told(WPR)}"], {}),
    (["x,y,z,rx,ry,rz", f"0.5,-0.1205,0.31,{told(ROTVEC)}"], {"unit": "m"}),
    (["nr;x_m;y_m;z_m;qx;qy;qz;qw", f"7;0,5;-0,1205;0,31;{told(XYZW, ';').replace('.', ',')}"], {}),
    (["name x_mm y_mm z_mm q1 q2 q3 q4", f"7 500 -120.5 310 {told(np.roll(XYZW, 1), ' ')}"], {}),
    ([f"500\t-120.5\t310\t{told(WPR, chr(9))}"], {"unit": "mm", "told": PoseFormat.fanuc_wpr_deg})])
def test_poses_of_any_brand(tmp_path: Path, lines: list[str], options: dict[str, object]) -> None:
    table = robot.read(write(tmp_path / "poses.csv", *lines), **options)
    T = table.T_base_flange(table.rows[0])
    assert T[:3, 3] == pytest.approx([0.5, -0.1205, 0.31])
    assert T[:3, :3] == pytest.approx(Q.as_matrix(), abs=1e-5)


def test_poses_as_yaml(tmp_path: Path) -> None:
    path = write(tmp_path / "poses.yaml", f"- {{name: 7, position_mm: [500, -120.5, 310], kuka_abc_deg: [{told(ABC, ', ')}]}}")
    table = robot.read(path)
    assert table.rows[0].name == "7"
    assert table.T_base_flange(table.rows[0])[:3, :3] == pytest.approx(Q.as_matrix(), abs=1e-5)


@pytest.mark.parametrize(("lines", "said"), [
    (["1,2,3,4,5,6"], "poses.csv:1: without a head such as"),
    (["x_mm,y_mm,a,b,c", "1,2,3,4,5"], "poses.csv:1: there is no column z"),
    (["x_mm,y_mm,z_mm,u,v,w", "1,2,3,4,5,6"], "no columns tell the orientation"),
    (["x,y,z,a,b,c", "1,2,3,4,5,6"], "positions in mm or m"),
    (["x_m,y_m,z_m,a,b,c", "0.1,0.2,0.3,4,5"], "poses.csv:2: 5 columns, the head has 6"),
    (["x_m,y_m,z_m,a,b,c", "0.1,0.2,0.3,4,5,six"], "poses.csv:2: 'six' is not a number"),
    (["x_m,y_m,z_m,a,b,c", "500,20,300,4,5,6"], "poses.csv:2: the flange would be 583 m from its base: is the unit right"),
    (["x_m,y_m,z_m,qx,qy,qz,qw", ".5,.2,.3,0,0,0,2"], "a quaternion of length 2.000"),
    (["x_m,y_m,z_m,rx_deg,ry_deg,rz_deg", ".5,.2,.3,0,0,2"], "say which angles they are by --pose-format"),
    ([""], "nothing in it")])
def test_what_is_wrong_with_a_table(tmp_path: Path, lines: list[str], said: str) -> None:
    with pytest.raises(InputError, match=said.replace("(", r"\(")):
        robot.read(write(tmp_path / "poses.csv", *lines))


def draw(T_camera_board: Transform) -> np.ndarray:
    return printed.seen(printed.chessboard(COLUMNS, ROWS), SQUARE_M, K, T_camera_board, SIZE, 4, 3)


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight stands of a robot with the cameras on its hand: images, a rig file, and the poses as KUKA writes them."""
    folder = tmp_path_factory.mktemp("cell")
    middle = np.array([(COLUMNS - 1) * SQUARE_M / 2, (ROWS - 1) * SQUARE_M / 2, 0.0])
    lines = ["name,x_mm,y_mm,z_mm,a,b,c"]
    for number, tilt in enumerate(TILTS_DEG, start=1):
        R = Rotation.from_euler("xyz", tilt, degrees=True).as_matrix()
        where = np.array([0.06 + 0.03 * (number % 3 - 1), 0.04 * (number % 2) - 0.02, 0.45 + 0.02 * number])
        T = geometry.make(R, where - R @ middle)
        cv2.imwrite(str(folder / f"left{number:02d}.png"), draw(T))
        cv2.imwrite(str(folder / f"right{number:02d}.png"), draw(T_RIGHT_LEFT @ T))
        T_base_flange = T_BASE_BOARD @ geometry.inverse(T) @ geometry.inverse(T_FLANGE_RIG)
        abc = poses.encode(geometry.quaternion(T_base_flange), PoseFormat.kuka_abc_deg)
        lines.append(f"{number},{told(1000 * T_base_flange[:3, 3])},{told(abc)}")
    write(folder / "poses.csv", *lines)
    cameras = [{"name": name, "K": K.tolist(), "distortion": (0.0,) * 5, "T_cam_rig": T.tolist()}
               for name, T in (("left", np.eye(4)), ("right", T_RIGHT_LEFT))]
    quality = {"rms_px": 0.1, "row_error_px": 0.1}
    (folder / "rig.json").write_bytes(rig.dump(Rig.model_validate(
        {"image_size_px": SIZE, "cameras": cameras, "quality": quality, "T_base_rig": np.eye(4).tolist()})))
    return folder


def arguments(cell: Path, out: Path, **change: object) -> list[object]:
    options: dict[str, object] = {
        "poses": cell / "poses.csv", "left": cell / "left*.png", "right": cell / "right*.png", "rig": cell / "rig.json",
        "board": f"chessboard:{COLUMNS}x{ROWS}:{SQUARE_M}", "mounting": "flange", "out": out} | change
    return ["handeye", *(part for name, value in options.items() for part in (f"--{name}", value))]


def test_a_rig_file_that_knows_the_robot(cell: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                         capsys: pytest.CaptureFixture[str]) -> None:
    lines = (cell / "poses.csv").read_text().splitlines()
    lines[4] = lines[4].replace(",", ",9", 1)        # a digit too many: the third pose but one stands metres away
    table = write(tmp_path / "poses.csv", *lines, "99,100,100,100,0,0,0")
    assert run(monkeypatch, *arguments(cell, tmp_path / "rig.json", poses=table), "--json") == 0
    known = json.loads(capsys.readouterr().out)
    assert known["rms_m"] < 0.0003
    assert set(known["unused"]) == {"4", "pose 99"}
    read, _ = rig.load(tmp_path / "rig.json")
    assert read.T_base_rig is None
    assert np.array(read.T_flange_rig) == pytest.approx(T_FLANGE_RIG, abs=0.0005)
    assert read.quality is not None
    assert read.quality.hand_eye_rms_m == pytest.approx(known["rms_m"])
    assert run(monkeypatch, *arguments(cell, tmp_path / "one.json", right="")) == 0
    shown = capsys.readouterr().out
    assert "T_flange_rig" in shown
    assert np.array(rig.load(tmp_path / "one.json")[0].T_flange_rig) == pytest.approx(T_FLANGE_RIG, abs=0.001)


@pytest.mark.parametrize(("change", "said"), [
    ({"mounting": "base"}, "With the rig mounted the other way, on flange or base, they agree to 0.0 mm"),
    ({"pose-format": "fanuc_wpr_deg"}, "Read as kuka_abc_deg the poses agree to 0.0 mm"),
    ({"pose-format": "euler"}, "--pose-format euler: it is one of quaternion_xyzw"),
    ({"board": "apriltag:36h11:0.05"}, "seen in 0 samples, 5 are needed"),
    ({"poses": "few.csv"}, "few.csv: 2 poses without names do not belong to 8 images")])
def test_nothing_is_written_when_it_does_not_fit(cell: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                                 capsys: pytest.CaptureFixture[str], change: dict[str, str], said: str) -> None:
    if "poses" in change:
        change = {"poses": str(write(tmp_path / "few.csv", "x_m,y_m,z_m,a,b,c", ".1,.2,.3,4,5,6", ".1,.2,.3,4,5,6"))}
    assert run(monkeypatch, *arguments(cell, tmp_path / "rig.json", **change)) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert said in lines[0]
    assert not (tmp_path / "rig.json").exists()


INNER_M = (0.6, 0.4, 0.18)
T_BASE_BIN = placed([0, 0, 25], [0.7, -0.2, 0.05]) @ placed([1.5, -1, 0], [0, 0, 0])


def touch(path: Path, corners: list[tuple[int, int]], floor_m: tuple[float, float, float] = (0.1, 0.05, 0.0),
          T_base_bin: Transform = T_BASE_BIN) -> Path:
    """Some inner corners by their signs, 0.5 mm off, and the floor."""
    rng, lines = np.random.default_rng(0), ["name,x_mm,y_mm,z_mm"]
    rim = [("rim", (x * INNER_M[0] / 2, y * INNER_M[1] / 2, INNER_M[2])) for x, y in corners]
    for kind, point in [*rim, ("floor", floor_m)]:
        lines.append(f"{kind},{told(1000 * geometry.transform(T_base_bin, np.array(point)) + rng.normal(0, 0.3, 3))}")
    return write(path, *lines)


@pytest.mark.parametrize("corners", [[(-1, -1), (1, -1), (1, 1)], [(1, 1), (-1, 1), (-1, -1)],
                                     [(1, -1), (-1, -1), (-1, 1), (1, 1)]])
def test_a_bin_touched_with_the_robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
                                      corners: list[tuple[int, int]]) -> None:
    points = touch(tmp_path / "touched.csv", corners)
    assert run(monkeypatch, "bin", "--points", points, "--size", "0.6x0.4x0.18") == 0
    found = yaml.safe_load(capsys.readouterr().out)["bin"]
    assert found["inner_size_m"] == list(INNER_M)
    assert found["pose"]["frame"] == "base"
    T = geometry.from_quaternion(np.array(found["pose"]["position_m"]), np.array(found["pose"]["quaternion_xyzw"]))
    assert T[:3, 3] == pytest.approx(T_BASE_BIN[:3, 3], abs=0.001)
    assert T[:3, :3] == pytest.approx(T_BASE_BIN[:3, :3], abs=0.004)


@pytest.mark.parametrize(("lines", "said"), [
    (["rim,0,0,200", "rim,300,0,200", "rim,600,1,200", "floor,100,100,20"], "lie on one line"),
    (["rim,0,0,20", "rim,600,0,20", "rim,600,400,20", "floor,100,100,200"], "the floor lies 180 mm above the rim"),
    (["rim,0,0,200", "rim,600,0,200", "rim,600,400,200", "floor,100,100,50"], "150.0 mm below the rim, the bin's inner height"),
    (["rim,0,0,0", "rim,600000,0,0", "rim,600000,400000,0", "floor,9,9,-180000"], "check both, and the unit of the points"),
    (["rim,0,0,200", "rim,500,0,200", "rim,500,400,200", "floor,100,100,20"], "they are 400, 500, 640 mm apart"),
    (["rim,0,0,200", "rim,600,0,200", "floor,100,100,20"], "2 points of the rim and 1 of the floor"),
    (["wall,0,0,200"], "touched.csv:2: 'wall': name each point rim"),
    (["rim,0,0"], "touched.csv:2: 3 columns, the head has 4")])
def test_what_is_wrong_with_touched_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
                                           lines: list[str], said: str) -> None:
    points = write(tmp_path / "touched.csv", "name,x_mm,y_mm,z_mm", *lines)
    assert run(monkeypatch, "bin", "--points", points, "--size", "0.6x0.4x0.18") == 2
    assert said in capsys.readouterr().err


def test_a_bin_seen(photograph: Callable[..., CycleInput], expecting: Callable[..., CycleInput], tmp_path: Path,
                    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    inputs = photograph()
    T_camera_bin = inputs.job.bin.T_parent_bin
    model = expecting(inputs, placed([0, 0, 4], [0.012, -0.009, 0.003])).job.bin
    for name in ("left", "right"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), getattr(inputs.pair, name).image)
    (tmp_path / "rig.json").write_bytes(rig.dump(inputs.rig))
    (tmp_path / "cell.yaml").write_text(bins.text(model))
    seen = ["bin", "--locate", "--left", tmp_path / "left.png", "--right", tmp_path / "right.png",
            "--rig", tmp_path / "rig.json", "--cell", tmp_path / "cell.yaml"]
    assert run(monkeypatch, *seen, "--out", tmp_path / "bin.yaml") == 0
    found = yaml.safe_load((tmp_path / "bin.yaml").read_text())["bin"]["pose"]
    assert found["frame"] == "camera"
    T = geometry.from_quaternion(np.array(found["position_m"]), np.array(found["quaternion_xyzw"]))
    assert T[:3, 3] == pytest.approx(T_camera_bin[:3, 3], abs=0.002)
    assert T[:3, :3] == pytest.approx(T_camera_bin[:3, :3], abs=0.007)
    larger = expecting(inputs, np.eye(4), (1.2, 1.0, 1.0)).job.bin
    (tmp_path / "cell.yaml").write_text(bins.text(larger))
    capsys.readouterr()
    assert run(monkeypatch, *seen) == 1
    assert "106 bin_mismatch" in capsys.readouterr().err
    assert run(monkeypatch, *seen[:-2]) == 2
    assert "--locate needs" in capsys.readouterr().err
