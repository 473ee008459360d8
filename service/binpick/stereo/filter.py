"""The right view confirms the left: the confidence of OpenCV's weighted least squares filter, and its smooth map for people."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Int16, UInt8

from binpick.data import Disparity, Image, Rectified
from binpick.settings import StereoSettings
from binpick.settings.stereo import Onnx
from binpick.stereo import pyramid, search
from binpick.stereo.compiled import compiled
from binpick.stereo.pyramid import HalfField
from binpick.stereo.search import SCALE, Plain

AGREEMENT = 12
"""Left and right agree within this, 1/16 px at half resolution: 1.5 px, OpenCV's default, at full resolution."""
EDGE_RADIUS, ROLL_OFF = 1, 1e-3
"""Half-resolution pixels around a depth edge that lose confidence, and how much by each (1/16 px)² of variance."""
UNMATCHED = -SCALE
Fixed = Int16[np.ndarray, "half_h half_w"]
Share = Float32[np.ndarray, "half_h half_w"]
"""0 to 1, or to 255."""


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Both views' disparities at half resolution, 1/16 px, the left one's margin included; below zero: none."""

    left: Fixed
    right: Fixed
    margin: int


def confirm(found: Disparity, rectified: Rectified, matcher: Plain) -> tuple[UInt8[np.ndarray, "window_h window_w"], Views]:
    """Confidence (0 to 255) of the window's pixels, and the views that it was told from.

    `found` is the left view's disparity on the whole grid, margin included, as `matcher` found it. The right view only says yes
    or no within 1.5 px, so it is matched at half resolution, an eighth of the work for the same verdicts.
    """
    half = pyramid.shrink(rectified)
    views = Views(_fixed(pyramid.coarse(found, rectified.window)), _fixed(_right(half, rectified, matcher)), half.margin)
    shape = rectified.window.height, rectified.window.width
    return pyramid.large(_confidence(views), shape, cv2.INTER_LINEAR).astype(np.uint8), views


def fill(views: Views, rectified: Rectified, settings: StereoSettings, guide: Image | None,
         ) -> Float32[np.ndarray, "window_h window_w"]:
    """The smoothed map of the window's pixels, px, absolute; `guide` is the left image without the pattern.

    The filter wants the right disparity negated (opencv_contrib#2974); the map ramps across depth edges: it is never evidence.
    """
    window, wls = rectified.window, cv2.ximgproc.createDisparityWLSFilterGeneric(use_confidence=True)
    wls.setLambda(settings.wls_lambda)
    wls.setSigmaColor(settings.wls_sigma_color)
    wls.setLRCthresh(AGREEMENT)
    wls.setDepthDiscontinuityRadius(EDGE_RADIUS)
    seen = pyramid.guide(rectified.left if guide is None else guide, window)
    rows, cols = views.left.shape
    smooth = wls.filter(views.left, seen, disparity_map_right=-views.right, ROI=(views.margin, 0, cols - views.margin, rows))
    filled = np.asarray(smooth[:, views.margin:], np.float32) * np.float32(2 / SCALE)
    return pyramid.large(filled, (window.height, window.width), cv2.INTER_LINEAR) + np.float32(window.min_disparity)


def _confidence(views: Views) -> Share:
    """Of the left view's pixels, 0 to 255, as the filter has it: none where the views disagree, less beside depth edges."""
    left, right = views.left[:, views.margin:], views.right[:, :views.left.shape[1] - views.margin]
    return _agreed(left, right, _flat(left), _flat(right), views.margin)


def _flat(fixed: Fixed) -> Share:
    """1 on a surface, less where disparities vary."""
    size = 2 * EDGE_RADIUS + 1
    view = np.ascontiguousarray(fixed)
    mean = cv2.boxFilter(view, cv2.CV_32F, (size, size))
    squares = cv2.sqrBoxFilter(view, cv2.CV_32F, (size, size))
    return np.asarray(cv2.max(1 - np.float32(ROLL_OFF) * (squares - mean * mean), 0), np.float32)


@compiled
def _agreed(left: Fixed, right: Fixed, left_flat: Share, right_flat: Share, margin: int) -> Share:
    rows, cols = left.shape
    confidence = np.empty((rows, cols), np.float32)
    for v in range(rows):
        for u in range(cols):
            share, there = left_flat[v, u], u + margin - np.int32(left[v, u]) // SCALE
            if 0 <= there < cols:
                agree = abs(np.int32(left[v, u]) - np.int32(right[v, there])) < AGREEMENT
                share = min(share, right_flat[v, there]) if agree else np.float32(0)
            confidence[v, u] = share * np.float32(255)
    return confidence


def _right(half: Rectified, rectified: Rectified, matcher: Plain) -> HalfField:
    """The right view's disparity at half resolution, in its pixels."""
    if isinstance(matcher, Onnx):
        whole = search.search_right(rectified.left, rectified.right, rectified.window.num_disparities, matcher)
        return pyramid.coarse(whole, rectified.window)
    return search.search_right(half.left, half.right, half.window.num_disparities, matcher)


def _fixed(disparity: HalfField) -> Fixed:
    """As OpenCV writes disparities: 1/16 px, below zero where there is none."""
    fixed: Fixed = np.where(np.isfinite(disparity), disparity * SCALE, UNMATCHED).astype(np.int16)
    return fixed
