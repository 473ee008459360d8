"""Depth against ground truth: bad pixels, median error and density on the parts, beside plain SGBM on the same frames."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from binpick.data import Rectified

Field = Float32[np.ndarray, "h w"]


@dataclass(frozen=True, slots=True)
class DepthScore:
    """bad-1, bad-2 and the median |Δd| over measured part pixels; density over part pixels both cameras see."""

    bad1: float
    bad2: float
    median_px: float
    density: float
    pixels: int


def plain_sgbm(rectified: Rectified) -> Field:
    """Disparity of the yardstick every table is read against: SGBM 3-way, left pass only; NaN = not matched."""
    matcher = cv2.StereoSGBM.create(
        0, rectified.window.num_disparities, 5, 200, 800, 1, 0, 10, 100, 2, cv2.STEREO_SGBM_MODE_SGBM_3WAY
    )
    raw = matcher.compute(rectified.left, rectified.right)[:, rectified.margin :]
    disparity: Field = raw.astype(np.float32) / 16 + np.float32(rectified.window.min_disparity)
    disparity[raw < 0] = np.nan
    return disparity


def score(
    disparity: Field, truth: Field, on_part: Bool[np.ndarray, "h w"], visible_both: Bool[np.ndarray, "h w"]
) -> DepthScore:
    """Scores a disparity map (NaN = not measured) on the pixels of parts."""
    judged = on_part & np.isfinite(truth)
    error = np.abs(disparity - truth)[judged & np.isfinite(disparity)]
    seen = judged & visible_both
    return DepthScore(
        bad1=float((error > 1).mean()),
        bad2=float((error > 2).mean()),
        median_px=float(np.median(error)),
        density=float(np.isfinite(disparity)[seen].mean()),
        pixels=int(seen.sum()),
    )
