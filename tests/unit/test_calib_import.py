"""Loose parameters become a rig: by their names in the usual files; faults are one line and exit code 2."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from binpick import rig
from binpick_calib import cli

K = np.array([[536.06, 0, 342.0], [0, 536.0, 235.0], [0, 0, 1]])
D = np.array([[-0.28, 0.09, 0.001, 0, 0.02]])
R = cv2.Rodrigues(np.array([0.007, 0.004, -0.004]))[0]
T = np.array([[-3.3442], [0.0417], [0.0528]])


def run(monkeypatch: pytest.MonkeyPatch, *args: str) -> int:
    monkeypatch.setattr("sys.argv", ["binpick-calib", "import", *args])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    return int(stopped.value.code or 0)


def write_yml(path: Path, **arrays: np.ndarray) -> str:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, array in arrays.items():
        storage.write(name, array)
    storage.release()
    return str(path)


def files_of(folder: Path, kind: str) -> list[str]:
    """The same rig, in one of the ways people keep it."""
    if kind == "opencv sample":
        return [write_yml(folder / "intrinsics.yml", M1=K, D1=D, M2=K, D2=D),
                write_yml(folder / "extrinsics.yml", R=R, T=T, R1=np.eye(3), P1=np.eye(3, 4), Q=np.eye(4))]
    if kind == "a file for each camera":
        return [write_yml(folder / "left_camera.yml", camera_matrix=K, distortion_coefficients=D),
                write_yml(folder / "right_camera.yml", camera_matrix=K, distortion_coefficients=D),
                write_yml(folder / "stereo.yml", R=R, T=T)]
    if kind == "npz":
        np.savez(folder / "all.npz", mtx_left=K, mtx_right=K, dist_left=D, dist_right=D, R=cv2.Rodrigues(R)[0], T=T)
        return [str(folder / "all.npz")]
    names = {"L": ("cameraMatrixL", "distL"), "R": ("cameraMatrixR", "distR")} if kind == "npy" else {
        "L": ("K0", "D0"), "R": ("K1", "D1")}
    arrays = {names["L"][0]: K, names["L"][1]: D, names["R"][0]: K, names["R"][1]: D, "R": R, "T": T}
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array)
    return [str(folder / f"{name}.npy") for name in arrays]


@pytest.mark.parametrize("kind", ["opencv sample", "a file for each camera", "npz", "npy", "numbers from 0"])
def test_import(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "rig.json"
    assert run(monkeypatch, *files_of(tmp_path, kind), "--image-size", "640x480", "--unit-m", "0.025", "--out", str(out)) == 0
    assert "baseline 83.62 mm" in capsys.readouterr().out
    read, warnings = rig.load(out)
    assert warnings == []
    assert read.quality is None
    for camera in read.cameras:
        assert camera.K_px == pytest.approx(K)
        assert camera.distortion_coefficients == pytest.approx(D[0])
    assert read.cameras[1].T_camera_rig[:3, :3] == pytest.approx(R)
    assert read.cameras[1].T_camera_rig[:3, 3] == pytest.approx(T[:, 0] * 0.025)


@pytest.mark.parametrize(("change", "said"), [
    ({"T": -T}, "left and right are exchanged"),
    ({"T": T[::-1]}, "a baseline along the optical axis"),
    ({"R": R * 1.1}, "R is not a rotation"),
    ({"M1": np.diag([1.0, 0.8, 1.0]) @ K}, "left: fx/fy is 1.2"),
    ({"D2": np.array([[-0.28, 0.09, 0.001, 0, 25.0]])}, "right: k3 = 25 moves the corner of the image"),
    ({"D2": np.zeros((2, 3))}, "D right has 6 numbers"),
    ({"T": T * 1000}, "check the unit"),
    ({"M2": None}, "not found in the files: K right"),
])
def test_what_cannot_be_is_refused(change: dict[str, np.ndarray | None], said: str, tmp_path: Path,
                                   monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    arrays = {"M1": K, "D1": D, "M2": K, "D2": D, "R": R, "T": T} | change
    path = write_yml(tmp_path / "all.yml", **{name: array for name, array in arrays.items() if array is not None})
    out = tmp_path / "rig.json"
    assert run(monkeypatch, path, "--image-size", "640x480", "--unit-m", "0.025", "--out", str(out)) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert said in lines[0]
    assert not out.exists()


@pytest.mark.parametrize("content", [None, "no parameters", "%YAML:1.0\n---\nM1: [ 1, 2"])
def test_unreadable_files(content: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                          capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "broken.yml"
    if content is not None:
        path.write_text(content)
    assert run(monkeypatch, str(path), "--image-size", "640x480", "--unit-m", "1", "--out", str(tmp_path / "rig.json")) == 2
    assert str(path) in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["npy", "npz", "yml"])
def test_a_file_that_is_not_there(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                  capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / f"M1.{kind}"
    assert run(monkeypatch, str(path), "--image-size", "640x480", "--unit-m", "1", "--out", str(tmp_path / "rig.json")) == 2
    assert f"{path}: there is no such file" in capsys.readouterr().err
