"""Planted surfaces are measured to a fiftieth of a pixel up to their edges, by the same bits each time; nothing is nothing."""

import itertools
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from binpick import cli
from binpick.data import Depth, Rectified, Window
from binpick.errors import ImageError
from binpick.settings import PRESETS, Bm, Hybrid, Sgbm, StereoSettings
from binpick.stereo import depth, search, trust
from binpick.stereo.strip import Strip

ND, LOW, ROWS, COLS, FINE = 64, 40, 120, 264, 8
QUALITY, FAST = PRESETS["quality"], PRESETS["fast"]
MATCHERS = {"3way": Sgbm(), "sgbm": Sgbm(mode="sgbm"), "hh": Sgbm(mode="hh"), "hh4": Sgbm(mode="hh4"), "hybrid": Hybrid(),
            "bm": Bm()}
SETTINGS = PRESETS | {name: StereoSettings(matcher=matcher) for name, matcher in MATCHERS.items()}


def texture(seed: int, rows: int = ROWS, cols: int = COLS + 160) -> np.ndarray:
    """Blurred dots, FINE samples per pixel: the band ends well below half a sample per pixel, so the spectrum says all."""
    dots = (np.random.default_rng(seed).uniform(0, 1, (rows, cols)) < 0.06).astype(np.float32)
    coarse = cv2.GaussianBlur(dots, (0, 0), 1.2)
    spectrum = np.fft.rfft(40 + 150 * coarse / coarse.max(), axis=1)
    return np.fft.irfft(np.pad(spectrum, ((0, 0), (0, cols * FINE // 2 + 1 - spectrum.shape[1]))), cols * FINE, axis=1) * FINE


def sampled(fine: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Grey levels at these columns, of 80 px further right."""
    place = (columns + 80) * FINE
    whole = np.floor(place).astype(int)
    part, row = place - whole, np.arange(len(columns))[:, None]
    return fine[row, whole] * (1 - part) + fine[row, whole + 1] * part


def taken(left: np.ndarray, right: np.ndarray, seed: int = 0) -> Rectified:
    """The pair as cameras with noise see it."""
    rng = np.random.default_rng(seed + 100)
    views = (np.clip(np.rint(view + rng.normal(0, 2, view.shape)), 0, 255).astype(np.uint8) for view in (left, right))
    return rectified(*views)


def rectified(left: np.ndarray, right: np.ndarray, num_disparities: int = ND) -> Rectified:
    rows, cols = left.shape
    window = Window(0, 0, cols - num_disparities, rows, LOW, num_disparities)
    return Rectified(left, right, window, num_disparities, 1000.0, 0.1, 100.0, 60.0, np.eye(4))


def surface(disparity: np.ndarray, seed: int = 0) -> Rectified:
    """One surface with this disparity beyond LOW at the left view's pixels, margin included."""
    columns = np.broadcast_to(np.arange(disparity.shape[1], dtype=float), disparity.shape)
    fine = texture(seed, disparity.shape[0], disparity.shape[1] + 160)
    return taken(sampled(fine, columns - disparity), sampled(fine, columns), seed)


def flat(disparity: float, rows: int = ROWS, cols: int = COLS, seed: int = 0) -> Rectified:
    return surface(np.full((rows, cols), disparity), seed)


def step(low: float, high: float, rows: int = ROWS, bottom: int = 90) -> tuple[Rectified, np.ndarray, np.ndarray]:
    """A block before a wall; the window's true disparity, and which pixels of the wall only the left camera sees."""
    wall, block = texture(1, rows), texture(51, rows)
    columns = np.broadcast_to(np.arange(COLS, dtype=float), (rows, COLS))
    inside = np.zeros((rows, COLS), bool)
    inside[40:bottom, 150:210] = True
    covered = np.zeros((rows, COLS), bool)
    covered[40:bottom] = (columns[40:bottom] + high >= 150) & (columns[40:bottom] + high < 210)
    left = np.where(inside, sampled(block, columns), sampled(wall, columns))
    right = np.where(covered, sampled(block, columns + high), sampled(wall, columns + low))
    hidden = np.zeros((rows, COLS), bool)
    hidden[40:bottom, int(150 - (high - low)):150] = True
    return taken(left, right), np.where(inside, high, low)[:, ND:], hidden[:, ND:]


def ramp(along_u: float, along_v: float, at: float) -> np.ndarray:
    v, u = np.mgrid[:ROWS, -ND:COLS - ND]
    return at + along_u * u + along_v * v


def by_fraction(pairs: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """The median error of found against true disparities, for each eighth of a pixel."""
    found, true = (np.concatenate([field.ravel() for field in fields]) for fields in zip(*pairs, strict=True))
    part = true % 1
    return np.array([np.nanmedian((found - true)[(part >= k / 8) & (part < (k + 1) / 8)]) for k in range(8)])


SURFACES = {
    "flat": [np.full((ROWS, COLS), 20 + k / 8 + 1 / 16) for k in range(16)],
    "turned": [ramp(0.02, 0.0, 18)], "turned back": [ramp(-0.03, 0.0, 28)],
    "tilted": [ramp(0.0, 0.025, 20)], "both": [ramp(0.015, -0.03, 22)],
}


@pytest.mark.parametrize("shapes", SURFACES.values(), ids=SURFACES)
def test_a_surface_is_measured_without_pixel_locking(shapes: list[np.ndarray]) -> None:
    pairs = [(surface(shape, k), shape[:, ND:]) for k, shape in enumerate(shapes)]
    ours, coarse = ([depth.measure(pair, preset) for pair, _ in pairs] for preset in (QUALITY, FAST))
    plain = [search.search(pair.left, pair.right, ND, Sgbm())[:, ND:] for pair, _ in pairs]
    bias, half_bias, locking = (
        by_fraction([(found, true) for found, (_, true) in zip(some, pairs, strict=True)])
        for some in ([d.disparity - LOW for d in ours], [d.disparity - LOW for d in coarse], plain))
    assert np.sqrt(np.mean(bias**2)) < 0.02
    assert np.abs(bias).max() < 0.03
    assert np.sqrt(np.mean(locking**2)) > 0.08
    assert np.sqrt(np.mean(half_bias**2)) < 0.07
    assert min(found.measured.mean() for found in (*ours, *coarse)) > 0.95


@pytest.mark.parametrize(("low", "high"), [(10.375, 40.625), (12.25, 20.75)])
@pytest.mark.parametrize(("preset", "within"), [("quality", 0.2), ("fast", 0.45)])
def test_a_step_keeps_its_edge(preset: str, within: float, low: float, high: float) -> None:
    pair, true, hidden = step(low, high)
    found = depth.measure(pair, PRESETS[preset])
    beside = cv2.morphologyEx(true.astype(np.float32), cv2.MORPH_GRADIENT, np.ones((5, 5))) > 0
    inner = np.zeros_like(beside)
    inner[4:-4, 4:-4] = True
    clear = inner & ~beside & ~hidden
    off = np.abs(found.disparity - LOW - true)
    assert found.measured[clear].mean() > 0.97
    assert (off[clear & found.measured] < within).mean() > 0.985
    middle = np.abs(found.disparity - LOW - (low + high) / 2) < (high - low) / 8
    assert middle[~hidden].sum() == 0
    assert middle.sum() <= 0.001 * true.size


@pytest.mark.parametrize("preset", PRESETS)
def test_what_is_not_measured_is_nan_and_what_is_has_a_sigma(preset: str) -> None:
    found = depth.measure(step(12.25, 20.75)[0], PRESETS[preset])
    assert 0.5 < found.measured.mean() < 1
    for field in (found.disparity, found.sigma_px):
        assert np.array_equal(np.isfinite(field), found.measured)
    scale = 2 if preset == "fast" else 1
    sigma = found.sigma_px[found.measured]
    assert sigma.min() >= np.float32(scale * trust.LEAST_SIGMA_PX)
    assert sigma.max() <= np.float32(scale * trust.MOST_SIGMA_PX)
    assert np.isfinite(found.filled).all()
    assert not any(field.flags.writeable for field in (found.disparity, found.filled, found.confidence, found.measured))


@pytest.fixture
def threads() -> Iterator[None]:
    before = cv2.getNumThreads()
    yield
    cv2.setNumThreads(before)


def content(found: Depth) -> tuple[bytes, ...]:
    """All but `filled`, which OpenCV's filter smooths in as many pieces as there are threads."""
    return tuple(field.tobytes() for field in (found.disparity, found.confidence, found.measured, found.sigma_px))


@pytest.mark.parametrize("settings", SETTINGS.values(), ids=SETTINGS)
def test_neither_threads_nor_memory_change_a_single_bit(settings: StereoSettings, threads: None) -> None:
    pair = step(12.25, 20.75, rows=261)[0]
    results, occupied = set(), []
    for count in (1, 2, 1, 2):
        cv2.setNumThreads(count)
        results.add(content(depth.measure(pair, settings)))
        # arrays come to lie elsewhere: OpenCV's own sums may then differ in their last bit
        occupied += [np.empty(1000 + 331 * count * k, np.uint8) for k in range(7)]
    assert len(results) == 1


def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str]:
    """Exit code and stderr."""
    monkeypatch.setattr(sys, "argv", ["binpick", "depth", *map(str, arguments)])
    with pytest.raises(SystemExit) as left:
        cli.main()
    return int(left.value.code or 0), capsys.readouterr().err


@pytest.mark.parametrize("preset", PRESETS)
def test_the_command_writes_the_same_bytes_with_one_thread(preset: str, threads: None, tmp_path: Path,
                                                           monkeypatch: pytest.MonkeyPatch,
                                                           capsys: pytest.CaptureFixture[str]) -> None:
    pair = step(12.25, 20.75, rows=261)[0]
    views = [tmp_path / f"{side}.png" for side in ("left", "right")]
    for path, image in zip(views, (pair.left, pair.right), strict=True):
        cv2.imwrite(str(path), image)
    written = []
    for count in (1, 2):
        cv2.setNumThreads(count)
        out = tmp_path / str(count)
        assert command(monkeypatch, capsys, "--left", views[0], "--right", views[1], "--rectified", "--num-disparities", ND,
                       "--preset", preset, "--out", out) == (0, "")
        written.append((out / "disparity.tiff").read_bytes())
    assert written[0] == written[1]


def test_an_unknown_preset_is_one_clear_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                             capsys: pytest.CaptureFixture[str]) -> None:
    code, told = command(monkeypatch, capsys, "--left", "l.png", "--right", "r.png", "--rectified", "--preset", "slow",
                         "--out", tmp_path)
    assert code != 0
    assert told.count("\n") == 1
    assert "there is no preset 'slow'; there are quality, fast" in told


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("rows", [247, 249, 273, 993, 1217, 1300])
def test_strips_leave_no_seam(rows: int, preset: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is computed strip by strip is what the whole window gives; edges and holes cross the borders."""
    pair, _, _ = step(12.25, 20.75, rows=rows, bottom=rows)
    striped = depth.measure(pair, PRESETS[preset])
    monkeypatch.setattr(depth, "strips", lambda rows, _most, _overlap: [Strip(0, 0, rows, rows)])
    whole = depth.measure(pair, PRESETS[preset])
    both = striped.measured & whole.measured
    # a few pixels have two planes that fit equally well: the last bit decides
    assert (striped.measured != whole.measured).mean() < 2e-3
    assert (np.abs(striped.disparity - whole.disparity)[both] > 1e-3).mean() < 2e-3
    assert (np.abs(striped.sigma_px - whole.sigma_px)[both] > 2e-3).mean() < 2e-3
    assert np.array_equal(striped.confidence, whole.confidence)


def grey(level: float, noise: float, seed: int) -> np.ndarray:
    return np.clip(np.rint(np.random.default_rng(seed).normal(level, noise, (ROWS, COLS))), 0, 255).astype(np.uint8)


NOTHING = {"black": (grey(0, 0, 0), grey(0, 0, 0)), "saturated": (grey(255, 0, 0), grey(255, 0, 0)),
           "foreign": (flat(20.0, seed=1).left, flat(20.0, seed=2).right),
           "left covered": (grey(0, 0, 0), flat(20.0).right), "right covered": (flat(20.0).left, grey(0, 0, 0)),
           "right saturated": (flat(20.0).left, grey(255, 0, 0)), "dark noise": (grey(4, 1.5, 1), grey(4, 1.5, 2))}


@pytest.mark.parametrize("views", NOTHING.values(), ids=NOTHING)
@pytest.mark.parametrize("settings", [*PRESETS.values(), StereoSettings(matcher=Bm())], ids=[*PRESETS, "bm"])
def test_where_nothing_is_to_be_seen_next_to_nothing_is_measured(settings: StereoSettings, views: tuple) -> None:
    assert depth.measure(rectified(*views), settings).measured.mean() < 0.05


@pytest.mark.parametrize("preset", PRESETS)
def test_a_bare_lit_surface_is_mostly_not_measured(preset: str) -> None:
    """Sensor noise alone; here and there it agrees by chance over a block, and nothing tells it from faint texture."""
    for level, noise in ((60, 2.0), (120, 2.5), (200, 3.0)):
        assert depth.measure(rectified(grey(level, noise, 1), grey(level, noise, 2)), PRESETS[preset]).measured.mean() < 0.2


def test_more_risk_measures_more_of_the_same() -> None:
    pair = step(12.25, 20.75)[0]
    found = [depth.measure(pair, QUALITY.model_copy(update={"max_risk": risk, "speckle_px": 0}))
             for risk in (0.05, 0.2, 0.5, 1.0)]
    for few, more in itertools.pairwise(found):
        assert not (few.measured & ~more.measured).any()
        assert few.measured.sum() < more.measured.sum()
        assert np.array_equal(few.disparity[few.measured], more.disparity[few.measured])


def test_block_matching_is_refined_as_well() -> None:
    true = ramp(0.02, 0.01, 20)
    found = depth.measure(surface(true), StereoSettings(matcher=Bm()))
    off = found.disparity - LOW - true[:, ND:]
    assert found.measured.mean() > 0.5
    assert np.nanmedian(np.abs(off)) < 0.06
    assert abs(np.nanmedian(off)) < 0.02
    # block matching knows no border
    assert not found.measured[:7].any()


def test_the_guide_changes_the_map_for_people_alone() -> None:
    pair, true, _ = step(12.25, 20.75)
    guide = np.zeros_like(pair.left)
    guide[:, ND:] = np.where(true > 15, 180, 60)
    for settings in (QUALITY, FAST):
        bare, guided = depth.measure(pair, settings), depth.measure(pair, settings, guide)
        assert not np.array_equal(bare.filled, guided.filled)
        assert np.array_equal(bare.confidence, guided.confidence)
        assert np.array_equal(bare.disparity, guided.disparity, equal_nan=True)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize(("shape", "num_disparities"), [((61, 141), 48), ((60, 140), 48), ((61, 140), 64), ((60, 141), 80)])
def test_odd_sides_and_ranges_stretch_nothing(preset: str, shape: tuple[int, int], num_disparities: int) -> None:
    rows, cols = shape
    seen = flat(20.25, rows, cols + num_disparities)
    found = depth.measure(rectified(seen.left, seen.right, num_disparities), PRESETS[preset])
    assert found.disparity.shape == shape
    assert found.measured.mean() > 0.9
    off = found.disparity - LOW - 20.25
    assert abs(np.nanmedian(off)) < (0.03 if preset == "quality" else 0.12)
    # one pixel in fifty would be a stretched row
    assert np.nanmax(np.abs(np.nanmedian(off, axis=0)[6:-6])) < 0.4
    assert found.measured[:, -8:].mean() > 0.6
    assert found.measured[-8:].mean() > 0.6


@pytest.mark.parametrize("preset", PRESETS)
def test_a_window_smaller_than_a_block_is_refused(preset: str) -> None:
    with pytest.raises(ImageError, match="too small for a matched block of 3 px"):
        depth.measure(rectified(np.zeros((40, ND + 2), np.uint8), np.zeros((40, ND + 2), np.uint8)), PRESETS[preset])
