"""Middlebury's files are read as their makers mean them; both matchers are judged on them."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from binpick.errors import InputError
from binpick.lab import methods, middlebury
from binpick.settings import PRESETS, Hybrid, Sgbm, StereoSettings

DATA = Path(__file__).parents[3] / "shared" / "data" / "middlebury_v3q"
SHIFT = 12


def pfm(values: np.ndarray, order: str) -> bytes:
    rows, columns = values.shape
    scale = b"-0.003922" if order == "<" else b"1.0"
    return b"Pf\n%d %d\n%s\n" % (columns, rows, scale) + values[::-1].astype(f"{order}f4").tobytes()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """One scene: a texture 12 px apart, its first row unknown, its last row hidden."""
    place = tmp_path / "Wall"
    place.mkdir()
    texture = np.random.default_rng(1).uniform(0, 255, (60, 172)).astype(np.float32)
    texture = cv2.GaussianBlur(texture, (0, 0), 1.0)
    texture = np.clip(4 * (texture - texture.mean()) + 128, 0, 255).astype(np.uint8)
    truth, mask = np.full((60, 160), SHIFT, np.float32), np.full((60, 160), 255, np.uint8)
    truth[0], mask[-1] = np.inf, 128
    for name, image in (("im0", texture[:, :160]), ("im1", texture[:, SHIFT : SHIFT + 160]), ("mask0nocc", mask)):
        cv2.imwrite(str(place / f"{name}.png"), image)
    (place / "disp0GT.pfm").write_bytes(pfm(truth, "<"))
    (place / "calib.txt").write_text("cam0=[713 0 356; 0 713 238; 0 0 1]\n width= 160\n ndisp= 20 \n isint=0\n")
    return tmp_path


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_pfm_is_read_top_row_first_and_unscaled(tmp_path, order):
    values = np.float32([[1, 2, 3], [4, np.inf, 6]])
    (tmp_path / "d.pfm").write_bytes(pfm(values, order))
    assert np.array_equal(middlebury.pfm(tmp_path / "d.pfm"), values)


@pytest.mark.parametrize("body", [b"", b"PF\n1 1\n-1\n" + bytes(12), b"Pf\n2 2\n-1\n" + bytes(8), b"Pf\n2\n-1\n"])
def test_a_broken_pfm_is_refused(tmp_path, body):
    (tmp_path / "d.pfm").write_bytes(body)
    with pytest.raises(InputError, match="not a grey PFM"):
        middlebury.pfm(tmp_path / "d.pfm")


def test_a_scene_is_judged_where_both_cameras_see(folder):
    scene, = middlebury.scenes(folder)
    assert scene.name == "Wall"
    assert scene.rectified.window.num_disparities == 32
    assert not scene.judged[0].any()
    assert not scene.judged[-1].any()
    marks = middlebury.marks(scene)
    assert set(marks) == {"disparities", "plain_sgbm", "plain_sgbm_bare", "quality", "at_density_of", "less"}
    assert marks["plain_sgbm_bare"]["density"] < 0.85 < marks["plain_sgbm"]["density"]
    assert marks["quality"]["median_px"] < 0.2


def test_a_folder_without_scenes_or_with_half_of_one_is_refused(tmp_path, folder):
    with pytest.raises(InputError, match="no Middlebury scenes"):
        list(middlebury.scenes(tmp_path / "Wall" / "nowhere"))
    (folder / "Wall" / "im1.png").unlink()
    with pytest.raises(InputError, match=r"im1\.png missing"):
        list(middlebury.scenes(folder))


def test_a_calib_without_range_is_refused(tmp_path):
    (tmp_path / "calib.txt").write_text("width=3\n")
    with pytest.raises(InputError, match="ndisp"):
        middlebury.disparities(tmp_path / "calib.txt")


def test_five_paths_change_the_semi_global_matcher_alone():
    settings = StereoSettings(matcher=Sgbm(block_px=7), wls_lambda=3000.0)
    changed = methods.five_paths(settings)
    assert changed.matcher == Sgbm(block_px=7, mode="sgbm")
    assert changed.wls_lambda == 3000.0
    assert methods.five_paths(StereoSettings(matcher=Hybrid())).matcher == Hybrid()


@pytest.mark.skipif(not DATA.is_dir(), reason="Middlebury's scenes do not lie in ../shared/data")
def test_ours_errs_less_than_plain_sgbm_on_real_scenes():
    scene = next(s for s in middlebury.scenes(DATA) if s.name == "Motorcycle")
    marks = middlebury.marks(scene)
    assert marks["plain_sgbm"]["bad2"] == pytest.approx(0.039, abs=0.005)
    assert marks["at_density_of"]["plain_sgbm_bare"]["density"] >= marks["plain_sgbm_bare"]["density"]
    assert marks["less"]["plain_sgbm_bare"]["bad1"] > 0.25
    assert marks["less"]["plain_sgbm_bare"]["bad2"] > 0.25
    assert PRESETS["quality"].matcher.kind in ("sgbm", "hybrid")
