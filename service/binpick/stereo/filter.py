"""The right view confirms the left: OpenCV's weighted least squares filter, its confidence, and a smooth map for people."""

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from binpick.data import Disparity, Image, Rectified
from binpick.settings import StereoSettings
from binpick.settings.stereo import Onnx
from binpick.stereo import pyramid, search
from binpick.stereo.search import SCALE, Plain

AGREEMENT = 12
"""Left and right agree within this, 1/16 px at half resolution: 1.5 px, OpenCV's default, at full resolution."""
EDGE_RADIUS = 1
"""Half-resolution pixels around a depth edge that lose confidence."""
UNMATCHED = -SCALE


def confirm(found: Disparity, rectified: Rectified, matcher: Plain, settings: StereoSettings, guide: Image | None = None,
            ) -> tuple[UInt8[np.ndarray, "window_h window_w"], Float32[np.ndarray, "window_h window_w"]]:
    """Confidence (0 to 255) and the smoothed map (px, relative to the window's smallest) of the window's pixels.

    `found` is the left view's disparity on the whole grid, margin included, as `matcher` found it; `guide` the left image
    without the pattern. The right view only says yes or no within 1.5 px, so it is matched at half resolution, an eighth of the
    work for the same verdicts. The filter wants the right disparity negated (opencv_contrib#2974); the smoothed map ramps
    across depth edges: it is never evidence.
    """
    window = rectified.window
    half = pyramid.shrink(rectified)
    right = _right(half, rectified, matcher)
    wls = cv2.ximgproc.createDisparityWLSFilterGeneric(use_confidence=True)
    wls.setLambda(settings.wls_lambda)
    wls.setSigmaColor(settings.wls_sigma_color)
    wls.setLRCthresh(AGREEMENT)
    wls.setDepthDiscontinuityRadius(EDGE_RADIUS)
    inside = (half.margin, 0, half.window.width, half.window.height)
    smooth = wls.filter(_fixed(pyramid.coarse(found, window)), half.left if guide is None else pyramid.guide(guide, window),
                        disparity_map_right=-_fixed(right), ROI=inside)
    filled = np.asarray(smooth, np.float32) * np.float32(2 / SCALE)
    confidence, filled = (_grown(field[:, half.margin:], (window.height, window.width))
                          for field in (wls.getConfidenceMap(), filled))
    return confidence.astype(np.uint8), filled


def _right(half: Rectified, rectified: Rectified, matcher: Plain) -> Float32[np.ndarray, "half_h half_w"]:
    """The right view's disparity at half resolution, in its pixels."""
    if isinstance(matcher, Onnx):
        whole = search.search_right(rectified.left, rectified.right, rectified.window.num_disparities, matcher)
        return pyramid.coarse(whole, rectified.window)
    return search.search_right(half.left, half.right, half.window.num_disparities, matcher)


def _fixed(disparity: Disparity) -> np.ndarray:
    """As OpenCV writes disparities: 1/16 px, below zero where there is none."""
    return np.where(np.isfinite(disparity), disparity * SCALE, UNMATCHED).astype(np.int16)


def _grown(field: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """From half to full resolution."""
    rows, cols = field.shape
    large = cv2.resize(field, (2 * cols, 2 * rows), interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(large[:shape[0], :shape[1]])
