"""Matches are corrected by the images, planes believed where they agree with them, and left alone where they do not."""

import cv2
import numpy as np
import pytest

from binpick.data import Rectified, Window
from binpick.stereo import refine

ROWS, COLS, MARGIN = 64, 80, 32
INSIDE = np.s_[10:-10, 10:-10]


def pair(disparity: np.ndarray) -> Rectified:
    """A sum of waves, so that any place between pixels has an exact grey level; the left view is the right one, moved."""
    rng = np.random.default_rng(4)
    v, u = np.mgrid[:ROWS, :COLS + MARGIN].astype(float)
    waves = [(rng.uniform(-0.8, 0.8), rng.uniform(-0.8, 0.8), rng.uniform(0, 6.3)) for _ in range(40)]

    def grey(columns: np.ndarray) -> np.ndarray:
        total = sum(np.sin(a * columns + b * v + c) for a, b, c in waves)
        return np.clip(np.rint(120 + 12 * total), 0, 255).astype(np.uint8)

    return Rectified(grey(u - disparity), grey(u), Window(0, 0, COLS, ROWS, 0, MARGIN), MARGIN, 1000.0, 0.1, 40.0, 32.0,
                     np.eye(4))


def plane(along_u: float = 0.0, along_v: float = 0.0, at: float = 15.0) -> np.ndarray:
    v, u = np.mgrid[:ROWS, -MARGIN:COLS]
    return at + along_u * u + along_v * v


@pytest.mark.parametrize("reach", [refine.FULL, refine.HALF], ids=["full", "half"])
@pytest.mark.parametrize("true", [plane(at=15.3), plane(0.05, -0.04), plane(-0.1, 0.08, 18)], ids=["flat", "slanted", "steep"])
def test_rounded_matches_become_the_surface_and_its_slope(true: np.ndarray, reach: refine.Reach) -> None:
    window = true[:, MARGIN:].astype(np.float32)
    matched = np.round(window * 4) / 4
    found = refine.refine(matched, pair(true), reach)
    before, after = (np.abs(field - window)[INSIDE] for field in (matched, found.disparity))
    assert np.median(after) < 0.02
    assert np.median(after) < 0.4 * np.median(before)
    assert abs(np.mean((found.disparity - window)[INSIDE])) < 0.015
    assert np.array_equal(found.departure[INSIDE], np.abs(found.disparity - matched)[INSIDE])
    # cells are 2 px, slopes per px
    steep = np.hypot(true[0, 1] - true[0, 0], true[1, 0] - true[0, 0])
    assert np.median(found.slope[5:-5, 5:-5]) == pytest.approx(steep, abs=0.01)
    assert np.median(found.bend[5:-5, 5:-5]) < 0.02


def test_a_match_that_planes_contradict_stays_as_it_was() -> None:
    true = plane(at=15.25)
    matched = np.full((ROWS, COLS), 15.25, np.float32)
    rng = np.random.default_rng(1)
    odd = (rng.integers(10, ROWS - 10, 12), rng.integers(10, COLS - 10, 12))
    matched[odd] += np.float32(4)
    found = refine.refine(matched, pair(true), refine.FULL)
    assert np.array_equal(found.disparity[odd], matched[odd])
    assert (found.departure[odd] > refine.TRUSTED_PX).all()
    changed = found.disparity != matched
    assert (np.abs(found.disparity - matched)[changed] < refine.TRUSTED_PX).all()


def test_nothing_is_added_where_nothing_was_matched_and_holes_disturb_nobody() -> None:
    true = plane(0.03, 0.02)
    matched = true[:, MARGIN:].astype(np.float32)
    rng = np.random.default_rng(2)
    matched[rng.uniform(size=matched.shape) < 0.3] = np.nan
    matched[20:40, 30:50] = np.nan
    found = refine.refine(matched, pair(true), refine.FULL)
    assert np.array_equal(np.isnan(found.disparity), np.isnan(matched))
    off = np.abs(found.disparity - true[:, MARGIN:])[INSIDE]
    assert np.nanmedian(off) < 0.02
    assert np.nanmax(off) < 0.2
    empty = refine.refine(np.full((ROWS, COLS), np.nan, np.float32), pair(true), refine.FULL)
    assert np.isnan(empty.disparity).all()


def test_planes_do_not_reach_across_a_crease_or_a_jump() -> None:
    """A roof, and a step of 6 px: both surfaces are found up to the last cells before the edge."""
    u = np.arange(-MARGIN, COLS)
    for profile, edge in ((18 - 0.12 * np.abs(u - 40), 40), (np.where(u < 40, 12.3, 18.3), 40)):
        true = np.tile(profile, (ROWS, 1))
        window = true[:, MARGIN:]
        found = refine.refine(window.astype(np.float32), pair(true), refine.FULL)
        off = np.abs(found.disparity - window)[10:-10]
        near = np.r_[edge - 10:edge - 2, edge + 2:edge + 10]
        assert np.median(off[:, near]) < 0.05
        assert (off[:, near] < 0.2).mean() > 0.95


@pytest.mark.parametrize("shape", [(63, 79), (64, 79), (63, 80)])
def test_odd_sides_are_refined_to_the_last_pixel(shape: tuple[int, int]) -> None:
    rows, cols = shape
    true = plane(at=15.3)
    whole = pair(true)
    part = Rectified(whole.left[:rows, :MARGIN + cols], whole.right[:rows, :MARGIN + cols],
                     Window(0, 0, cols, rows, 0, MARGIN), MARGIN, 1000.0, 0.1, 40.0, 32.0, np.eye(4))
    found = refine.refine(np.full(shape, 15.25, np.float32), part, refine.FULL)
    assert found.disparity.shape == found.departure.shape == shape
    off = np.abs(found.disparity - 15.3)
    assert np.median(off[-2:]) < 0.05
    # beside the last columns the two images do not show the same
    assert off.max() < 0.5
    assert found.misfit.shape == (rows // 2, cols // 2)


def test_where_in_memory_the_arrays_lie_does_not_matter() -> None:
    true = plane(0.05, -0.04)
    matched, seen = true[:, MARGIN:].astype(np.float32), pair(true)
    results = set()
    for offset in range(0, 64, 4):
        room = np.empty(matched.nbytes + 128, np.uint8)
        begin = -room.ctypes.data % 64 + offset
        moved = room[begin:begin + matched.nbytes].view(np.float32).reshape(matched.shape)
        moved[:] = matched
        found = refine.refine(moved, seen, refine.FULL)
        results.add(b"".join(field.tobytes() for field in (found.disparity, found.misfit, found.slope, found.bend)))
    assert len(results) == 1


def test_slow_brightness_is_no_disparity() -> None:
    """One camera sees everything 20 grey levels brighter, and ever more to the right."""
    true = plane(at=15.3)
    seen = pair(true)
    shade = np.linspace(0, 40, COLS + MARGIN, dtype=np.float32)
    brighter = np.clip(cv2.add(seen.left.astype(np.float32), np.tile(shade, (ROWS, 1))), 0, 255).astype(np.uint8)
    shaded = Rectified(brighter, seen.right, seen.window, MARGIN, 1000.0, 0.1, 40.0, 32.0, np.eye(4))
    found = refine.refine(np.full((ROWS, COLS), 15.25, np.float32), shaded, refine.FULL)
    assert abs(float(np.median(found.disparity[INSIDE])) - 15.3) < 0.02
