"""Gray code read from warped copies of OpenCV's own patterns: a plane with a step, noise, shadow, reflections."""

import cv2
import numpy as np
import pytest

from binpick.data import BLACK_PATTERN, FIRST_GRAY_PATTERN, GRAY_CODE_SIZE_PX, Image, Light, Rectified, Window
from binpick.stereo import graycode

ROWS, COLS, MARGIN, LOW = 90, 260, 64, 200
"""The window; its right view is shifted by LOW."""
LIGHTS = tuple(Light(6000.0, 0.0, True, pattern) for pattern in range(FIRST_GRAY_PATTERN, BLACK_PATTERN + 1))
SCALE = 1.4
"""Camera pixels per pixel of the projector."""


def patterns() -> list[Image]:
    width, height = GRAY_CODE_SIZE_PX
    _, images = cv2.structured_light.GrayCodePattern.create(width, height).generate()
    return [*images, np.full((height, width), 255, np.uint8), np.zeros((height, width), np.uint8)]


def disparity_of(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A slanted plane at 10 to 15 px (less LOW), and a square before it at 40; u counts from the grid's left edge."""
    return np.where((np.abs(u - 190) < 50) & (np.abs(v - 45) < 25), 40.0, 10 + u / 64).astype(np.float32)


def scene(noise: float = 0.0, contrast: float = 100.0, shadow: slice = slice(0),
          mirror: slice = slice(0)) -> tuple[Rectified, ...]:
    """The sequence as two cameras see it, the projector midway between them.

    Nothing falls on the columns `shadow` of the left view; `mirror` shows the right camera another row of the projector there.
    """
    u, v = np.meshgrid(np.arange(COLS + MARGIN, dtype=np.float32), np.arange(ROWS, dtype=np.float32))
    truth = disparity_of(u, v)
    left_column = (u - truth / 2) / SCALE + 300
    # the right view: what lies at u - disparity; the plane first, then the square before it
    near, far = u + 40, (u + 10) / (1 - 1 / 64)
    right_column = np.where(disparity_of(near, v) == 40, near - 20, far - (10 + far / 64) / 2) / SCALE + 300
    row = v / SCALE + 300
    right_row = row.copy()
    right_row[:, mirror] += 40
    rng = np.random.default_rng(5)
    shots = []
    for pattern in patterns():
        views = []
        for column, seen_row, dark in ((left_column, row, shadow), (right_column, right_row, slice(0))):
            view = cv2.remap(pattern.astype(np.float32) / 255, column.astype(np.float32), seen_row, cv2.INTER_LINEAR)
            view[:, dark] = 0
            view = cv2.GaussianBlur(view, (0, 0), 0.75) * np.float32(contrast) + 15
            views.append(np.clip(np.rint(view + rng.normal(0, noise, view.shape)), 0, 255).astype(np.uint8))
        shots.append(Rectified(*views, Window(0, 0, COLS, ROWS, LOW, MARGIN), MARGIN, 1000.0, 0.1, 0.0, 0.0, np.eye(4)))
    return tuple(shots)


def truth() -> np.ndarray:
    u, v = np.meshgrid(np.arange(COLS) + MARGIN, np.arange(ROWS))
    return disparity_of(u, v) + LOW


@pytest.mark.parametrize(("noise", "contrast", "median_px", "density"), [(0.0, 100.0, 0.02, 0.85), (2.5, 100.0, 0.04, 0.85),
                                                                         (2.5, 30.0, 0.12, 0.7)])
def test_a_plane_and_a_step_are_measured_between_the_pixels(noise: float, contrast: float, median_px: float,
                                                            density: float) -> None:
    disparity, sigma = graycode.decode(scene(noise, contrast), LIGHTS)
    measured = np.isfinite(disparity)
    error = np.abs(disparity - truth())[measured]
    assert disparity.shape == (ROWS, COLS)
    assert np.array_equal(measured, np.isfinite(sigma))
    assert measured.mean() > density
    assert np.median(error) < median_px
    assert (error > 1).mean() < 2e-3
    assert (error < 2 * sigma[measured]).mean() > 0.9


def test_what_only_one_camera_sees_is_not_measured() -> None:
    disparity, _ = graycode.decode(scene(), LIGHTS)
    hidden = slice(190 - MARGIN - 50 - 20, 190 - MARGIN - 53)     # left of the square, behind it for the right camera
    assert np.isfinite(disparity[25:65, hidden]).mean() < 0.02


def test_shadow_and_black_are_not_measured() -> None:
    disparity, _ = graycode.decode(scene(noise=2.5, shadow=slice(MARGIN + 10, MARGIN + 60)), LIGHTS)
    assert np.isfinite(disparity[:, 12:58]).sum() == 0
    assert np.isfinite(graycode.decode(scene(noise=2.5, contrast=3.0), LIGHTS)[0]).sum() == 0


def test_the_same_columns_in_another_row_of_the_projector_are_a_reflection() -> None:
    disparity, _ = graycode.decode(scene(mirror=slice(0, 120)), LIGHTS)
    assert np.isfinite(disparity[:, :40]).sum() == 0
    assert np.isfinite(disparity[:, 150:]).mean() > 0.85


def test_it_reads_the_code_of_opencv() -> None:
    """OpenCV's decoder: right minus left, whole pixels, 0 where there is nothing."""
    shots = scene()
    coder = cv2.structured_light.GrayCodePattern.create(*GRAY_CODE_SIZE_PX)
    found, theirs = coder.decode([[shot.left for shot in shots[:-2]], [shot.right for shot in shots[:-2]]], None,
                                 [shots[-1].left, shots[-1].right], [shots[-2].left, shots[-2].right])
    ours, _ = graycode.decode(shots, LIGHTS)
    theirs = np.where(theirs == 0, np.nan, LOW - theirs)[:, MARGIN:]
    both = np.isfinite(ours) & np.isfinite(theirs)
    assert found
    assert both.mean() > 0.7
    assert np.median(np.abs(ours - theirs)[both]) < 0.5
    assert np.isfinite(ours).sum() > np.isfinite(theirs).sum() * 0.95


def test_the_order_of_the_shots_does_not_matter_and_other_shots_do_not_disturb() -> None:
    shots = scene()
    want, _ = graycode.decode(shots, LIGHTS)
    extra = (Light(6000.0, 0.0, False), Light(6000.0, 0.0, True, 2))
    got, _ = graycode.decode((*shots[::-1], shots[0], shots[1]), (*LIGHTS[::-1], *extra))
    assert np.array_equal(got, want, equal_nan=True)


def test_only_a_whole_sequence_is_complete() -> None:
    assert graycode.complete(LIGHTS)
    assert not graycode.complete(LIGHTS[:-1])
    assert not graycode.complete((Light(6000.0, 0.0, True),))


def test_depth_has_no_islands_and_is_filled_for_people() -> None:
    shots = scene(noise=2.5)
    depth = graycode.measure(shots, LIGHTS, 100)
    count, _, stats, _ = cv2.connectedComponentsWithStats(depth.measured.astype(np.uint8), connectivity=4)
    assert stats[1:, cv2.CC_STAT_AREA].min() >= 100
    assert count > 1
    assert np.array_equal(depth.measured, np.isfinite(depth.disparity))
    assert np.array_equal(depth.measured, np.isfinite(depth.sigma_px))
    assert np.isfinite(depth.filled).all()
    assert np.array_equal(depth.filled[depth.measured], depth.disparity[depth.measured])
    assert set(np.unique(depth.confidence)) == {0, 255}
    nothing = graycode.measure(scene(contrast=0.0), LIGHTS, 100)
    assert not nothing.measured.any()
    assert (nothing.filled == 0).all()
