"""The right image as the left view sees it, if the disparities are right."""

import cv2
import numpy as np
from jaxtyping import Float32, Shaped

from binpick.stereo.compiled import compiled

Line = Float32[np.ndarray, "w"]
Seen = Shaped[np.ndarray, "h w ..."]


def warp(right: Shaped[np.ndarray, "h whole_w ..."], disparity: Float32[np.ndarray, "h w"], margin: int, interpolation: int,
         ) -> Seen:
    """What stands in `right` (margin columns more on its left) at each window pixel's disparity, px relative to the window's
    smallest, by one of OpenCV's interpolations; 0 outside, and where the disparity is NaN.
    """
    rows, cols = disparity.shape
    u = np.arange(margin, margin + cols, dtype=np.float32) - disparity
    v = np.repeat(np.arange(rows, dtype=np.float32)[:, None], cols, axis=1)
    seen: Seen = cv2.remap(right, u, v, interpolation)
    return seen


@compiled
def sample(line: Float32[np.ndarray, "longer"], disparity: Line, margin: int, seen: Line) -> None:
    """The same for one row: `line`, of the right image, between its pixels. It needs one pixel more at its end; disparities lie
    within the margin, none is NaN."""
    for u in range(len(disparity)):
        place = np.float32(u + margin) - disparity[u]
        left = np.int32(place)
        seen[u] = line[left] + (line[left + 1] - line[left]) * (place - np.float32(left))


@compiled
def lengthened(row: Shaped[np.ndarray, "w"], line: Float32[np.ndarray, "longer"]) -> None:
    """A row as `sample` wants it: its last pixel twice."""
    for u in range(len(row)):
        line[u] = row[u]
    line[len(row)] = row[len(row) - 1]
