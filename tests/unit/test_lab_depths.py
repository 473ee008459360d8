"""A planted scene through the judge: regions from the truth, errors per pixel, figures, table and plate."""

import io
import json

import cv2
import numpy as np
import pytest
from rich.console import Console

from binpick.data import Depth, Rectified, Window
from binpick.lab import depths, marks, methods, plates, tables
from binpick.lab.depths import Answer, Marked, Series, Sheet
from binpick.lab.regions import near_jump, regions
from binpick.lab.stereo import plain_sgbm, score
from binpick.settings import PRESETS
from binpick.sim.truth import Truth
from binpick.stereo import depth

ROWS, COLUMNS = 90, 140
BLOCK, CYLINDER = 1, 2
MIXED, DARK = Series("mixed_A", "A"), Series("no_projector_A", "A", projector=False)


def truth() -> Truth:
    """A sloping floor at 50 px, a block 8 px nearer on the left, a lying cylinder on the right; the rest is the bin."""
    u, v = np.meshgrid(np.arange(COLUMNS, dtype=np.float32), np.arange(ROWS, dtype=np.float32))
    disparity = 50 + 0.02 * u
    part_id = np.zeros((ROWS, COLUMNS), dtype=np.int32)
    block = (v > 20) & (v < 70) & (u > 15) & (u < 60)
    disparity[block] = (58 + 0.03 * v)[block]
    part_id[block] = BLOCK
    across = np.abs(v - 45)
    tube = (across < 21) & (u > 80) & (u < 125)
    disparity[tube] = (55 + 0.18 * np.sqrt(np.maximum(24.0**2 - across**2, 0)))[tube]
    part_id[tube] = CYLINDER
    return Truth(disparity.astype(np.float32), part_id, np.ones((ROWS, COLUMNS), dtype=bool))


def seen(true: Truth) -> Rectified:
    """What cameras would see of it: a random texture, the right view being where the left is looked up."""
    texture = cv2.GaussianBlur(np.random.default_rng(5).uniform(0, 255, (ROWS, 400)).astype(np.float32), (0, 0), 1.2)
    texture = np.clip(4 * (texture - texture.mean()) + 128, 0, 255)
    u, v = np.meshgrid(np.arange(COLUMNS + 32, dtype=np.float32), np.arange(ROWS, dtype=np.float32))
    shift = np.hstack([np.repeat(true.disparity[:, :1], 32, axis=1), true.disparity]) - 40
    right = texture[:, 100:272].astype(np.uint8)
    left = cv2.remap(texture, u + 100 - shift, v, cv2.INTER_CUBIC).clip(0, 255).astype(np.uint8)
    return Rectified(left, right, Window(0, 0, COLUMNS, ROWS, 40, 32), 32, 1000.0, 0.1, 70.0, 45.0, np.eye(4))


@pytest.fixture(scope="module")
def sheet() -> Sheet:
    true, kinds = truth(), {BLOCK: "block", CYLINDER: "cylinder"}
    pair = seen(true)
    found: dict[str, Depth] = {name: depth.measure(pair, settings) for name, settings in PRESETS.items()}
    maps = {methods.PLAIN: plain_sgbm(pair)} | {name: method(pair) for name, method in methods.others().items()}
    maps |= {name: measured.disparity for name, measured in found.items()}
    seconds = {name: [0.5, 0.3] if name in PRESETS else [0.2] for name in maps}
    return Sheet(MIXED, depths.mark(1, pair, true, kinds, maps, found, seconds), pair, true, maps, found)


def test_the_truth_tells_planes_round_faces_and_edges_apart():
    at = regions(truth(), {BLOCK: "block", CYLINDER: "cylinder"})
    assert at.planes[45, 37]
    assert at.curved[45, 102]
    assert at.edges[45, 18]
    assert not at.planes[:, 66:].any()
    assert not at.curved[:, :66].any()
    assert not (at.edges & (at.planes | at.curved)).any()
    assert not (at.parts & (truth().part_id == 0)).any()


def test_the_fold_of_a_block_is_neither_plane_nor_round():
    u = np.tile(np.arange(60, dtype=np.float32), (40, 1))
    roof = Truth(50 - 0.2 * np.abs(u - 30), np.ones((40, 60), dtype=np.int32), np.ones((40, 60), dtype=bool))
    at = regions(roof, {1: "block"})
    assert not at.planes[20, 28:33].any()
    assert not at.curved.any()
    assert at.planes[20, 10]


def test_an_edge_reaches_five_pixels():
    step = np.repeat(np.float32([[10] * 20 + [13] * 20]), 9, axis=0)
    assert np.flatnonzero(near_jump(step)[4]).tolist() == list(range(14, 26))
    assert not near_jump(np.repeat(np.float32([[10] * 20 + [11.5] * 20]), 9, axis=0)).any()


def test_every_method_measures_the_planted_scene(sheet):
    figures = marks.figures(sheet.series, [sheet.marked])
    assert list(figures["rows"]) == ["plain_sgbm", "sgbm_wls", "sgbm_wls_confident", "bm", "ssd", "ncc", "quality", "fast"]
    for name, row in figures["rows"].items():
        assert row["median_px"] < 0.3, name
        assert row["density"] > 0.2, name
    assert figures["rows"]["quality"]["time_ms"] == pytest.approx(400)
    assert figures["rows"]["quality"]["times_plain"] == pytest.approx(2.0)
    for split in figures["splits"].values():
        assert 0 < split["curved"]["share_of_part_pixels"] < split["planes"]["share_of_part_pixels"] < 1
    assert [scene["seed"] for scene in figures["sigma"]["fast"]] == [1]


def test_the_figures_agree_with_the_whole_exams_score(sheet):
    row = marks.figures(sheet.series, [sheet.marked])["scenes"]["plain_sgbm"][0]
    judged = score(sheet.maps["plain_sgbm"], sheet.truth.disparity, sheet.truth.part_id > 0, sheet.truth.visible_both)
    assert (row["bad1"], row["bad2"], row["median_px"], row["density"]) == pytest.approx(
        (judged.bad1, judged.bad2, judged.median_px, judged.density), abs=1e-4)


def test_the_plate_and_the_table_show_both_methods(sheet):
    (name, body), = plates.png(sheet).items()
    picture = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR)
    assert name == "mixed_A_1.png"
    assert picture.shape[1] == 4 * plates.TILE_WIDTH
    run = {"exam_sha256": "0" * 64, "threads": 2, "middlebury": {},
           "series": {"mixed_A": marks.figures(sheet.series, [sheet.marked])}}
    printed = io.StringIO()
    Console(width=150, file=printed).print(tables.tables(run))
    text = printed.getvalue()
    assert max(map(len, text.splitlines())) <= 150
    for words in ("plain SGBM", "ours: quality", "ours: fast", "NCC windows", "within 2σ"):
        assert words in text


def marked(seed: int, error: list[float], region: list[int], sigma: list[float], seconds: float = 0.1) -> Marked:
    """A scene whose presets all answer alike."""
    e, s = np.float32(error), np.float32(sigma)
    answers = {methods.PLAIN: Answer(e, None, (0.05,))} | {name: Answer(e, s, (seconds,)) for name in methods.OURS}
    return Marked(seed, np.full(len(e), 100, np.float32), np.uint8(region), np.ones(len(e), dtype=bool), 100.0, answers)


def test_figures_pool_pixels_and_name_the_worst_scene():
    P, E = depths.PLANE, depths.EDGE
    nan = np.nan
    scenes = [marked(1, [0.1, 0.3, 0.2, nan], [P, P, E, E], [0.2, 0.2, 0.1, nan]),
              marked(2, [-0.1, -3.0, 0.7, 5.0], [P, P, E, E], [0.2, 2.0, 1.0, 1.0], seconds=0.2)]
    figures = marks.figures(MIXED, scenes)
    row = figures["rows"]["quality"]
    assert row["density"] == pytest.approx(7 / 8)
    assert (row["bad05"], row["bad1"], row["bad2"]) == pytest.approx((3 / 7, 2 / 7, 2 / 7), abs=1e-4)
    assert row["median_px"] == pytest.approx(0.3)
    # errors are cut to ±1 px: (0.1 + 0.3 − 0.1 − 1) / 4, and (−0.1 − 1) / 2 in the second scene
    assert row["plane_bias_px"] == pytest.approx(-0.175)
    assert row["plane_bias_worst_px"] == pytest.approx(-0.55)
    # z = 1 m at 100 px: 1 % of disparity is 10 mm
    assert row["dz_median_mm"] == pytest.approx(3.0, abs=0.05)
    assert row["times_plain"] == pytest.approx(3.0)
    assert figures["sigma"]["fast"] == [
        {"seed": 1, "within_1": 0.5, "within_2": 1.0, "edges_within_1": 0.0, "sigma_median_px": 0.2},
        {"seed": 2, "within_1": 0.5, "within_2": 1.0, "edges_within_1": 0.5, "sigma_median_px": 1.1}]


def test_nothing_measured_is_no_figure_and_no_fault():
    nan = np.nan
    figures = marks.figures(DARK, [marked(1, [nan, nan], [depths.PLANE, depths.EDGE], [nan, nan])])
    assert figures["rows"]["quality"]["density"] == 0
    assert figures["rows"]["quality"]["bad2"] is None
    json.dumps(figures, allow_nan=False)
    run = {"exam_sha256": "0" * 64, "threads": 2, "middlebury": {}, "series": {"no_projector_A": figures}}
    Console(width=150, file=io.StringIO()).print(tables.tables(run))


def test_every_series_has_a_title_and_its_own_name():
    names = [series.name for series in depths.SERIES]
    assert len(set(names)) == len(names)
    assert set(names) == set(tables.TITLES)
    assert set(tables.NAMES) == {methods.PLAIN, *methods.others(), *methods.OURS}
