"""Depth against ground truth: bad pixels, median error and density on the parts, beside plain SGBM on the same frames."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int16

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


def plain_matcher(num_disparities: int, mode: int = cv2.STEREO_SGBM_MODE_SGBM_3WAY) -> cv2.StereoSGBM:
    """The yardstick that every table is read against."""
    return cv2.StereoSGBM.create(0, num_disparities, 5, 200, 800, 1, 0, 10, 100, 2, mode)


def absolute(raw: Int16[np.ndarray, "h2 w2"], rectified: Rectified) -> Field:
    """OpenCV's disparities of a rectified pair as ours: without the margin, in px, NaN = not matched."""
    raw = raw[:, rectified.margin :]
    disparity: Field = raw.astype(np.float32) / 16 + np.float32(rectified.window.min_disparity)
    disparity[raw < 0] = np.nan
    return disparity


def plain_sgbm(rectified: Rectified) -> Field:
    """Disparity of the yardstick: SGBM 3-way, left pass only; NaN = not matched."""
    raw = plain_matcher(rectified.window.num_disparities).compute(rectified.left, rectified.right)
    return absolute(np.asarray(raw, dtype=np.int16), rectified)


def score(
    disparity: Field, truth: Field, on_part: Bool[np.ndarray, "h w"], visible_both: Bool[np.ndarray, "h w"]
) -> DepthScore:
    """Scores a disparity map (NaN = not measured) on the pixels of parts; where none is measured, shares and median are NaN."""
    judged = on_part & np.isfinite(truth)
    error = np.abs(disparity - truth)[judged & np.isfinite(disparity)]
    seen = judged & visible_both
    return DepthScore(
        bad1=float((error > 1).mean()) if error.size else float("nan"),
        bad2=float((error > 2).mean()) if error.size else float("nan"),
        median_px=float(np.median(error)) if error.size else float("nan"),
        density=float(np.isfinite(disparity)[seen].mean()),
        pixels=int(seen.sum()),
    )
