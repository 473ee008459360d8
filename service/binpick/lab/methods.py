"""What the stereo bench compares: one function from a rectified pair to disparity per method, plain SGBM first."""

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
from jaxtyping import Float32, Int16

from binpick.data import Rectified
from binpick.lab import classics
from binpick.lab.stereo import Field, absolute, plain_matcher
from binpick.settings import PRESETS, Sgbm, StereoSettings

PLAIN, OURS = "plain_sgbm", tuple(PRESETS)
CLASSIC_WINDOW_PX = 9
CONFIDENT = 200
"""WLS confidence from which the reports this project started from believed a pixel; of 255."""

Method = Callable[[Rectified], Field]


def others() -> dict[str, Method]:
    """The rows beside plain SGBM and our presets, by name."""
    return {
        "sgbm_wls": _smoothed,
        "sgbm_wls_confident": _confident,
        "bm": _blocks,
        "ssd": partial(classics.match, costs=classics.ssd, window_px=CLASSIC_WINDOW_PX),
        "ncc": partial(classics.match, costs=classics.ncc, window_px=CLASSIC_WINDOW_PX),
    }


def five_paths(settings: StereoSettings) -> StereoSettings:
    """A preset with its semi-global matcher on OpenCV's five paths; other matchers stay as they are."""
    if not isinstance(settings.matcher, Sgbm):
        return settings
    return settings.model_copy(update={"matcher": settings.matcher.model_copy(update={"mode": "sgbm"})})


def _wls(rectified: Rectified) -> tuple[Int16[np.ndarray, "h w"], Int16[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Raw left disparity, the filter's map and its confidence, in the order of OpenCV's sample.

    Making the filter first switches the left matcher's own checks off: the confidence is to replace them.
    """
    matcher = plain_matcher(rectified.window.num_disparities)
    wls = cv2.ximgproc.createDisparityWLSFilter(matcher)
    wls.setLambda(8000)
    wls.setSigmaColor(1.5)
    raw = matcher.compute(rectified.left, rectified.right)
    raw_right = cv2.ximgproc.createRightMatcher(matcher).compute(rectified.right, rectified.left)
    smooth = wls.filter(raw, rectified.left, disparity_map_right=raw_right)
    return (np.asarray(raw, dtype=np.int16), np.asarray(smooth, dtype=np.int16),
            np.asarray(wls.getConfidenceMap(), dtype=np.float32))


def _smoothed(rectified: Rectified) -> Field:
    """The filter's map, where its confidence is not nought."""
    _, smooth, confidence = _wls(rectified)
    return absolute(np.where(confidence > 0, smooth, np.int16(-1)), rectified)


def _confident(rectified: Rectified) -> Field:
    """The raw disparity, where the filter's confidence is high."""
    raw, _, confidence = _wls(rectified)
    return absolute(np.where(confidence > CONFIDENT, raw, np.int16(-1)), rectified)


def _blocks(rectified: Rectified) -> Field:
    """OpenCV's block matcher with plain SGBM's checks; its speckle range is in 1/16 px."""
    matcher = cv2.StereoBM.create(rectified.window.num_disparities, 15)
    matcher.setTextureThreshold(10)
    matcher.setUniquenessRatio(10)
    matcher.setDisp12MaxDiff(1)
    matcher.setSpeckleWindowSize(100)
    matcher.setSpeckleRange(2 * 16)
    return absolute(np.asarray(matcher.compute(rectified.left, rectified.right), dtype=np.int16), rectified)
