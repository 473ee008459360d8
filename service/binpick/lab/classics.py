"""Window matching as it is taught: SSD and NCC over every disparity, winner takes all, a parabola between whole pixels.

A floor for the tables, and small enough to be read in class. One box filter per disparity does the sums of all windows at once;
only the best cost so far and its two neighbours are kept, so memory does not grow with the search range.
"""

from collections.abc import Callable, Iterator

import cv2
import numpy as np
from jaxtyping import Float32

from binpick.data import Disparity, Image, Rectified

Grid = Float32[np.ndarray, "h w"]
Costs = Callable[[Image, Image, int, int], Iterator[Grid]]
FLAT = 1.0
"""Grey levels squared: variance below which a window has nothing to correlate."""


def ssd(left: Image, right: Image, margin: int, window_px: int) -> Iterator[Grid]:
    """Mean squared difference of the windows, one cost map of the left image's columns from `margin` on per disparity."""
    target = left[:, margin:]
    for shift in range(margin):
        yield cv2.sqrBoxFilter(cv2.absdiff(target, _shifted(right, margin, shift)), cv2.CV_32F, (window_px, window_px))


def ncc(left: Image, right: Image, margin: int, window_px: int) -> Iterator[Grid]:
    """1 − the windows' normalised cross-correlation, their means taken off: brightness and contrast do not matter."""
    target, other = (image.astype(np.float32) - np.float32(image.mean()) for image in (left[:, margin:], right))
    (mean, spread), (means, spreads) = _moments(target, window_px), _moments(other, window_px)
    for shift in range(margin):
        there = _shifted(means, margin, shift)
        covariance = cv2.blur(target * _shifted(other, margin, shift), (window_px, window_px)) - mean * there
        yield 1 - covariance / (spread * _shifted(spreads, margin, shift))


def match(rectified: Rectified, costs: Costs, window_px: int) -> Disparity:
    """Each pixel's cheapest disparity in the window's range; every pixel gets one, right or wrong."""
    found = winner(costs(rectified.left, rectified.right, rectified.margin, window_px))
    return found + np.float32(rectified.window.min_disparity)


def winner(costs: Iterator[Grid]) -> Disparity:
    """The place of the lowest cost; between whole disparities where a parabola through it and its neighbours is lowest."""
    last = next(costs)
    best, before, after = last.copy(), np.full_like(last, np.nan), np.full_like(last, np.nan)
    place = np.zeros_like(last)
    for shift, cost in enumerate(costs, start=1):
        np.copyto(after, cost, where=place == shift - 1)
        better = cost < best
        for kept, value in ((best, cost), (before, last), (after, np.float32(np.nan)), (place, np.float32(shift))):
            np.copyto(kept, value, where=better)
        last = cost
    bend = before - 2 * best + after
    # NaN at the ends of the range, 0 where neighbours cost the same: whole disparities then
    bent = bend > 0
    offset = np.divide(before - after, 2 * bend, out=np.zeros_like(best), where=bent)
    disparity: Disparity = place + np.clip(offset, -0.5, 0.5)
    return disparity


def _shifted(image: np.ndarray, margin: int, shift: int) -> np.ndarray:
    """The right image's columns that the window's pixels have at this disparity."""
    return image[:, margin - shift : image.shape[1] - shift]


def _moments(image: Grid, window_px: int) -> tuple[Grid, Grid]:
    """Every window's mean and standard deviation."""
    mean = cv2.blur(image, (window_px, window_px))
    variance = cv2.blur(image * image, (window_px, window_px)) - mean * mean
    return mean, np.sqrt(np.maximum(variance, np.float32(FLAT)))
