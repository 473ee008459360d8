"""Half resolution: a disparity is half as large, whatever the sides; what comes back keeps surfaces smooth and jumps sharp."""

import cv2
import hypothesis.extra.numpy as arrays
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from binpick.data import Depth, Rectified, Window
from binpick.stereo import pyramid


def pair(rows: int, cols: int, num_disparities: int, shift: int = 0) -> Rectified:
    """A texture of broad waves, the right view `shift` px further left."""
    noise = np.random.default_rng(3).uniform(0, 255, (rows, cols + num_disparities + shift)).astype(np.float32)
    seen = cv2.GaussianBlur(noise, (0, 0), 3.0)
    seen = np.clip(8 * (seen - seen.mean()) + 128, 0, 255).astype(np.uint8)
    width = cols + num_disparities
    return Rectified(seen[:, :width].copy(), seen[:, shift:shift + width].copy(),
                     Window(7, 9, cols, rows, 40, num_disparities), num_disparities, 1000.0, 0.1, 50.0, 20.0, np.eye(4))


SIDES = st.integers(1, 40)
RANGES = st.sampled_from([16, 32, 48, 64, 80, 112])


@given(SIDES, SIDES, RANGES)
def test_the_shrunk_pair_holds_all_of_it(rows: int, cols: int, num_disparities: int) -> None:
    whole = pair(rows, cols, num_disparities)
    half = pyramid.shrink(whole)
    assert half.left.shape == half.right.shape == (half.window.height, half.window.width + half.margin)
    assert (half.window.height, half.window.width) == (-(-rows // 2), -(-cols // 2))
    assert half.margin == half.window.num_disparities >= num_disparities / 2
    assert half.window.num_disparities % 16 == 0
    assert pyramid.padding(num_disparities) == 2 * half.margin - num_disparities


@given(SIDES, SIDES, RANGES)
def test_a_coarse_map_lies_on_the_shrunk_grid_at_half_the_disparity(rows: int, cols: int, num_disparities: int) -> None:
    whole = pair(rows, cols, num_disparities)
    column = np.tile(np.arange(cols + num_disparities, dtype=np.float32), (rows, 1))
    half = pyramid.shrink(whole)
    inner = pyramid.coarse(column, whole.window)[:, half.margin:]
    assert inner.shape == (half.window.height, half.window.width)
    assert np.array_equal(inner[0], np.float32(num_disparities / 2) + np.arange(inner.shape[1], dtype=np.float32))
    assert pyramid.guide(whole.left, whole.window).shape == half.left.shape


@pytest.mark.parametrize("shape", [(40, 60), (41, 61), (40, 61), (41, 60)])
@pytest.mark.parametrize("num_disparities", [32, 48])
def test_images_are_shrunk_by_two_exactly(shape: tuple[int, int], num_disparities: int) -> None:
    whole = pair(*shape, num_disparities, shift=10)
    half = pyramid.shrink(whole)
    # 10 px apart are 5 after: were odd sides stretched, the last columns would differ
    inside = half.left[:-1, half.margin:half.left.shape[1] - 6].astype(int)
    moved = half.right[:-1, half.margin - 5:half.left.shape[1] - 11].astype(int)
    assert np.abs(inside - moved).max() <= 1
    pad = pyramid.padding(num_disparities)
    mean = whole.left[0:2, num_disparities:num_disparities + 2].mean()
    assert abs(float(half.left[0, (num_disparities + pad) // 2]) - mean) <= 0.5


def depth(disparity: np.ndarray) -> Depth:
    field = disparity.astype(np.float32)
    return Depth(disparity=field, fill=lambda: np.nan_to_num(field), confidence=np.full(field.shape, 255, np.uint8),
                 measured=np.isfinite(field), sigma_px=np.where(np.isfinite(field), np.float32(0.1), np.float32(np.nan)))


def window(rows: int, cols: int, low: int = 40) -> Window:
    return Window(0, 0, cols, rows, low, 64)


@pytest.mark.parametrize("shape", [(20, 30), (19, 30), (20, 29), (19, 29)])
def test_a_slanted_surface_comes_back_without_steps(shape: tuple[int, int]) -> None:
    rows, cols = shape
    v, u = np.mgrid[:-(-rows // 2), :-(-cols // 2)]
    large = pyramid.double(depth(10 + 0.1 * u - 0.05 * v), window(rows, cols))
    # the middle of a coarse pixel lies between two fine ones
    fine_v, fine_u = np.mgrid[:rows, :cols]
    want = 40 + 2 * (10 + 0.1 * (fine_u / 2 - 0.25) - 0.05 * (fine_v / 2 - 0.25))
    assert large.disparity.shape == shape
    assert np.abs(large.disparity - want)[2:-2, 2:-2].max() < 1e-4
    assert np.allclose(large.sigma_px, 0.2)
    assert large.measured.all()


FIELDS = arrays.arrays(np.float32, (3, 4), elements=st.one_of(st.just(np.nan), st.floats(0, 30, width=32)))


@given(FIELDS, st.sampled_from([5, 6]), st.sampled_from([7, 8]))
def test_nothing_is_invented_between_surfaces_nor_where_nothing_was(coarse: np.ndarray, rows: int, cols: int) -> None:
    large = pyramid.double(depth(coarse), window(rows, cols, low=0))
    nearest = np.repeat(np.repeat(coarse, 2, axis=0), 2, axis=1)[:rows, :cols]
    assert np.array_equal(large.measured, np.isfinite(nearest))
    assert np.array_equal(np.isfinite(large.disparity), large.measured)
    assert np.array_equal(np.isfinite(large.sigma_px), large.measured)
    off = np.abs(large.disparity - 2 * nearest)[large.measured]
    assert (off <= 2 * pyramid.SAME_SURFACE_PX + 1e-5).all()


def test_a_jump_stays_one() -> None:
    coarse = np.full((10, 10), 5.0)
    coarse[:, 5:] = 20.0
    large = pyramid.double(depth(coarse), window(20, 20, low=0))
    assert np.array_equal(np.unique(large.disparity), np.float32([10, 40]))
    assert (large.disparity[:, :10] == 10).all()
