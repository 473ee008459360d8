"""Half resolution: a rectified pair shrunk by two, and what was found there brought back."""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from binpick.data import Depth, Disparity, Image, Rectified, Window, frozen
from binpick.stereo.search import STEP

HalfImage = UInt8[np.ndarray, "half_h half_w"]
HalfField = Float32[np.ndarray, "half_h half_w"]
SAME_SURFACE_PX = 0.5
"""Between disparities of neighbours that differ by less (half-resolution px) there is surface; else a jump, which stays one."""


def padding(num_disparities: int) -> int:
    """Columns by which the shrunk pair's margin is wider, at full resolution: its range is rounded up to whole steps."""
    return 2 * _half(num_disparities) - num_disparities


def shrink(rectified: Rectified) -> Rectified:
    """The pair at half resolution: a disparity there is half of the one here.

    Odd sides are padded to even ones, or OpenCV would shrink by a little more than two and stretch every disparity.
    """
    window = rectified.window
    margin = _half(window.num_disparities)
    left, right = (_shrunk(image, window) for image in (rectified.left, rectified.right))
    rows, cols = left.shape
    return replace(rectified, left=left, right=right, margin=margin,
                   window=Window(0, 0, cols - margin, rows, 0, margin))


def coarse(whole: Disparity, window: Window) -> HalfField:
    """A full-resolution disparity, margin included, on the shrunk pair's grid: every second pixel's, halved."""
    rows, cols = whole.shape
    padded = cv2.copyMakeBorder(whole, 0, rows % 2, padding(window.num_disparities), cols % 2, cv2.BORDER_REPLICATE)
    return np.asarray(padded[::2, ::2], np.float32) / 2


def guide(image: Image, window: Window) -> HalfImage:
    """An image of the full grid on the shrunk pair's."""
    return _shrunk(image, window)


def double(depth: Depth, window: Window) -> Depth:
    """The depth of a shrunk pair on the window it was shrunk from: disparities absolute again, and twice as uncertain."""
    shape, low = (window.height, window.width), np.float32(window.min_disparity)
    disparity = _fine(depth.disparity, shape)
    disparity *= 2
    disparity += low
    confidence = np.asarray(large(depth.confidence, shape, cv2.INTER_LINEAR), np.uint8)
    return Depth(disparity=frozen(disparity), fill=partial(_filled, depth, shape, low), confidence=frozen(confidence),
                 measured=frozen(np.isfinite(disparity)),
                 sigma_px=frozen(large(2 * depth.sigma_px, shape, cv2.INTER_NEAREST)))


def _filled(depth: Depth, shape: tuple[int, int], low: np.float32) -> Disparity:
    return large(2 * depth.filled + low, shape, cv2.INTER_LINEAR)


def _half(num_disparities: int) -> int:
    return STEP * ((num_disparities + 2 * STEP - 1) // (2 * STEP))


def _shrunk(image: Image, window: Window) -> HalfImage:
    rows, cols = image.shape
    even = cv2.copyMakeBorder(image, 0, rows % 2, padding(window.num_disparities), cols % 2, cv2.BORDER_REPLICATE)
    small = cv2.resize(even, (even.shape[1] // 2, even.shape[0] // 2), interpolation=cv2.INTER_AREA)
    shrunk: HalfImage = frozen(np.asarray(small, np.uint8))
    return shrunk


def large(field: np.ndarray, shape: tuple[int, int], interpolation: int) -> np.ndarray:
    """A field of the shrunk grid on the full one of this shape, by one of OpenCV's interpolations."""
    rows, cols = field.shape
    return np.asarray(cv2.resize(field, (2 * cols, 2 * rows), interpolation=interpolation)[:shape[0], :shape[1]])


def _fine(field: HalfField, shape: tuple[int, int]) -> Disparity:
    """Interpolated on a surface, the nearest pixel's value where one ends; NaN stays NaN."""
    nearest, smooth = (large(field, shape, way) for way in (cv2.INTER_NEAREST, cv2.INTER_LINEAR))
    fine = nearest.copy()
    with np.errstate(invalid="ignore"):
        np.copyto(fine, smooth, where=cv2.absdiff(smooth, nearest) < SAME_SURFACE_PX)
    return fine
