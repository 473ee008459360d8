"""The right image as the left view sees it, if the disparities are right."""

import cv2
import numpy as np
from jaxtyping import Float32, Shaped

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
