"""Disparity of both views by semi-global matching (OpenCV's SGBM, three-way: both cores)."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Int16, UInt8

from binpick.data import Rectified
from binpick.settings import StereoSettings
from binpick.settings.stereo import Costs

SCALE = 16
"""OpenCV's disparities are integers in 1/16 px."""


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """Raw disparities in 1/16 px, margin included, relative to the window's smallest disparity; negative: not matched.

    The right view only confirms or denies the left one, within 1.5 px, so it is matched at half resolution, an eighth of the
    work for the same verdicts. `half_left` is the left disparity and `half_guide` the left image on that grid.
    """

    left: Int16[np.ndarray, "h w"]
    half_left: Int16[np.ndarray, "h2 w2"]
    half_right: Int16[np.ndarray, "h2 w2"]
    half_guide: UInt8[np.ndarray, "h2 w2"]
    half_matcher: cv2.StereoSGBM


def sgbm(costs: Costs, num_disparities: int, min_disparity: int = 0) -> cv2.StereoSGBM:
    """The left matcher.

    disp12MaxDiff makes OpenCV drop pixels whose way back from the right differs by more than 1 px.
    """
    return cv2.StereoSGBM.create(
        minDisparity=min_disparity, numDisparities=num_disparities, blockSize=costs.block_px, P1=costs.p1, P2=costs.p2,
        disp12MaxDiff=1, preFilterCap=31, uniquenessRatio=costs.uniqueness_percent,
        speckleWindowSize=0, speckleRange=0, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY)


def match(rectified: Rectified, settings: StereoSettings) -> Matched:
    """Left and right disparity of the window; the search range is the window's."""
    costs = settings.matcher
    assert isinstance(costs, Costs)
    left = np.asarray(sgbm(costs, rectified.window.num_disparities).compute(rectified.left, rectified.right), dtype=np.int16)
    rows, cols = left.shape[0] // 2, left.shape[1] // 2
    half_left, half_right = (cv2.resize(image, (cols, rows), interpolation=cv2.INTER_AREA)
                             for image in (rectified.left, rectified.right))
    half_matcher = sgbm(costs, 16 * ((rectified.window.num_disparities + 31) // 32))
    right = cv2.ximgproc.createRightMatcher(half_matcher).compute(half_right, half_left)
    return Matched(left=left, half_left=left[:2 * rows:2, :2 * cols:2] // 2, half_right=np.asarray(right, dtype=np.int16),
                   half_guide=np.asarray(half_left, dtype=np.uint8), half_matcher=half_matcher)
