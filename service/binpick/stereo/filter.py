"""Measured or not: WLS confidence, depth edges and speckle decide; the smoothed map is for people only."""

import cv2
import numpy as np
from jaxtyping import Bool, Int16

from binpick.data import Depth, Image, Mask, Rectified, frozen
from binpick.settings import StereoSettings
from binpick.stereo.match import SCALE, Matched

SGBM_SIGMA_PX = 0.25
"""1-sigma disparity noise of SGBM on projected dots: the median error of `binpick bench --tuning`, 0.156 px, over 0.6745 as for
a normal distribution, rounded up; one number for all pixels, not calibrated per pixel."""
AGREEMENT = 12
"""Left and right agree within this, 1/16 px at half resolution: 1.5 px, OpenCV's default, at full resolution."""
EDGE_RADIUS = 1
"""Half-resolution pixels around a depth edge that lose confidence; OpenCV's own choice cost a tenth of the part pixels here."""
TEXTURE_PX = 7
LEAST_CONTRAST = 4
"""Grey levels between the darkest and the brightest pixel around, from which there is something to match."""
JUMP_PX = 2.0
"""A disparity step between neighbours above this is a depth edge."""


def measure(matched: Matched, rectified: Rectified, settings: StereoSettings) -> Depth:
    """The depth of the window's pixels.

    A pixel is measured when its surroundings have texture, SGBM matched it, the WLS filter's left-right confidence reaches
    `min_confidence`, and it is neither within `edge_px` of a depth edge nor in a speckle. OpenCV's filter wants the right
    disparity negated, which its right matcher already delivers (opencv_contrib#2974).
    """
    wls = cv2.ximgproc.createDisparityWLSFilter(matched.half_matcher)
    wls.setLambda(settings.wls_lambda)
    wls.setSigmaColor(settings.wls_sigma_color)
    wls.setLRCthresh(AGREEMENT)
    wls.setDepthDiscontinuityRadius(EDGE_RADIUS)
    smooth = wls.filter(matched.half_left, matched.half_guide, disparity_map_right=matched.half_right)
    rows, cols = matched.left.shape
    margin = rectified.margin
    confidence = cv2.resize(wls.getConfidenceMap(), (cols, rows), interpolation=cv2.INTER_LINEAR)[:, margin:].astype(np.uint8)
    filled = cv2.resize(smooth.astype(np.float32) * np.float32(2 / SCALE), (cols, rows),
                        interpolation=cv2.INTER_LINEAR)[:, margin:]
    raw = np.ascontiguousarray(matched.left[:, margin:])
    measured = gate(raw, settings) & (confidence >= settings.min_confidence) & _textured(rectified.left[:, margin:])
    disparity = raw.astype(np.float32) / SCALE + rectified.window.min_disparity
    disparity[~measured] = np.nan
    sigma_px = np.where(measured, np.float32(SGBM_SIGMA_PX), np.float32(np.nan))
    return Depth(disparity=frozen(disparity), filled=frozen(filled + np.float32(rectified.window.min_disparity)),
                 confidence=frozen(confidence), measured=frozen(measured), sigma_px=frozen(sigma_px))


def gate(raw: Int16[np.ndarray, "h w"], settings: StereoSettings) -> Mask:
    """Which raw disparities stand on firm ground: matched, away from depth edges, not in a speckle."""
    sound: Bool[np.ndarray, "h w"] = raw >= 0
    if settings.speckle_px:
        speckled = raw.copy()
        cv2.filterSpeckles(speckled, -SCALE, settings.speckle_px, 2 * SCALE)
        sound &= speckled >= 0
    if settings.edge_px:
        sound &= ~_near_jump(raw, sound, settings.edge_px)
    return sound


def _textured(image: Image) -> Mask:
    """Where the image varies at all within a block: black and saturated areas match everything equally well."""
    contrast = cv2.morphologyEx(image, cv2.MORPH_GRADIENT, np.ones((TEXTURE_PX, TEXTURE_PX), dtype=np.uint8))
    return np.asarray(contrast >= LEAST_CONTRAST)


def _near_jump(raw: Int16[np.ndarray, "h w"], sound: Mask, edge_px: int) -> Mask:
    """Pixels within edge_px of a disparity step; holes are no steps."""
    kernel = np.ones((3, 3), dtype=np.uint8)
    highest = cv2.dilate(np.where(sound, raw, np.int16(-32768)), kernel)
    lowest = cv2.erode(np.where(sound, raw, np.int16(32767)), kernel)
    jump = (highest.astype(np.int32) - lowest > JUMP_PX * SCALE).astype(np.uint8)
    if edge_px > 1:
        jump = cv2.dilate(jump, np.ones((2 * edge_px - 1, 2 * edge_px - 1), dtype=np.uint8))
    return np.asarray(jump > 0)

