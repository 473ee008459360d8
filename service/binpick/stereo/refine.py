"""Sub-pixel disparity: each match is corrected by the images' own slope, and planes are fitted to what many of them say.

The correction is one Gauss-Newton step of image registration (Lucas and Kanade 1981): where the right image, warped by the
disparity, differs by e from the left one and rises by g per px, the match is e/g px off, and says so with weight g². Planes
through the weighted corrections of a window take out their noise and the matcher's pixel locking. Windows stand around the
pixel and to all sides of it; each has its say the more the better its plane fits, so that they do not reach across depth edges.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32

from binpick.data import Disparity, Image, Rectified
from binpick.stereo.warp import warp

Field = Float32[np.ndarray, "h w"]
Cells = Float32[np.ndarray, "rows cols"]
MOST_STEP_PX = 0.25
"""A single correction counts no further: beyond that the image is not straight, or the match is wrong."""
STRONG = 200.0
"""Squared grey levels per px from which an edge's weight grows no further: a part's outline is no better than a dot."""
LEAST_WEIGHT = 0.02
"""What a cell without any slope still weighs: it says what the matcher said."""
ASIDE = 2.0
"""How many times better a window aside must fit to have the same say as the one around the pixel."""
LEAST_COST = 1e-5
"""Squared px: no plane fits better than this, and no window outvotes all others by more."""
SLOPE_PRIOR = 0.05
"""Cells² added to the windows' moments: keeps planes with little support level."""
TRUSTED_PX = 0.6
"""A plane that contradicts the match by more is not believed: the match then stands as it was found."""


@dataclass(frozen=True, slots=True)
class Reach:
    """How far around a pixel is looked: `radius` cells of 2x2 px to each side of a window's middle.

    The mean over squares of `band_px` is taken off both images: cameras and shading differ in slow brightness, dots do not.
    """

    radius: int
    band_px: int


FULL, HALF = Reach(radius=3, band_px=9), Reach(radius=2, band_px=5)
"""At full resolution windows of 14x14 px; of 20x20 px at half, where a pixel is worth two."""


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """Disparities in px relative to the window's smallest; NaN where nothing was matched. Cells are 2x2 px.

    `departure` is how far the plane lies from the match (px), `misfit` the logarithm of its mean squared residual (px²), more
    where little supports it, `support` the mean weight of the corrections around (squared grey levels per px), `slope` its
    steepness and `bend` how far that differs from the steepness around, both px per px.
    """

    disparity: Disparity
    departure: Disparity
    misfit: Cells
    slope: Cells
    bend: Cells
    support: Cells


def refine(matched: Disparity, rectified: Rectified, reach: Reach) -> Refined:
    """The matched disparity (px relative to the window's smallest, NaN: none), on the window's pixels, refined."""
    cells = _cells(matched, rectified, reach.band_px)
    middle = rectified.window.num_disparities / 2
    planes = _fits(cells, reach.radius, middle)
    vote = _vote(planes, reach.radius, middle)
    shape = matched.shape
    v, u = (np.resize(np.array([-0.25, 0.25], np.float32), n) for n in shape)
    plane = spread(np.where(cells.weight > 0, vote.level, np.float32(np.nan)), shape)
    plane += spread(vote.slope_u, shape) * u
    plane += spread(vote.slope_v, shape) * v[:, None]
    departure = np.abs(plane - matched)
    with np.errstate(invalid="ignore"):
        disparity = np.where(departure < TRUSTED_PX, plane, matched)
    # not cv2.magnitude: its last bit depends on where in memory the arrays lie
    steepness = np.minimum(np.sqrt(vote.slope_u * vote.slope_u + vote.slope_v * vote.slope_v) / 2, np.float32(1))
    bend = _bend(vote.slope_u, vote.slope_v, reach.radius)
    return Refined(disparity, departure, vote.misfit, steepness, bend, planes.support)


def _bend(slope_u: Cells, slope_v: Cells, radius: int) -> Cells:
    size = 2 * radius + 1
    off = (np.clip(slope - cv2.blur(slope, (size, size)), -2, 2) for slope in (slope_u, slope_v))
    u, v = (np.nan_to_num(cv2.blur(field * field, (3, 3))) for field in off)
    return np.minimum(np.asarray(cv2.sqrt(cv2.max(u + v, 0)), np.float32) / 2, 1)


@dataclass(frozen=True, slots=True, eq=False)
class _Corrected:
    """2x2 px each: what the matches say after correction, px, and the weight of it (0: nothing matched)."""

    disparity: Cells
    weight: Cells


def _cells(matched: Disparity, rectified: Rectified, band_px: int) -> _Corrected:
    margin = rectified.margin
    known = np.isfinite(matched)
    filled = np.where(known, matched, np.float32(0))
    left, right = _band(rectified.left[:, margin:], band_px), _band(rectified.right, band_px)
    warped = warp(cv2.merge([right, _slope(right)]), filled, margin, cv2.INTER_LINEAR)
    rise = (_slope(left) + warped[..., 1]) * np.float32(0.5)
    rise *= known
    square = rise * rise
    g2, ge, g2d, share, plain = (mean_of_four(field) for field in (
        square, rise * (left - warped[..., 0]), square * filled, known.astype(np.float32), filled))
    step = np.clip(ge / np.maximum(g2, np.float32(1e-3)), -MOST_STEP_PX, MOST_STEP_PX)
    with np.errstate(divide="ignore", invalid="ignore"):
        before = np.where(g2 > 1e-3, g2d / g2, plain / share)
    seen = share > 0.4
    weight = np.where(seen, g2 / (1 + g2 / np.float32(STRONG)) + np.float32(LEAST_WEIGHT), np.float32(0))
    return _Corrected(np.where(seen, before - step, np.float32(0)), weight)


def mean_of_four(field: np.ndarray) -> Cells:
    """Of each 2x2 px; an odd last row or column is left out."""
    rows, cols = (side // 2 * 2 for side in field.shape)
    return np.asarray(cv2.resize(field[:rows, :cols], (cols // 2, rows // 2), interpolation=cv2.INTER_AREA), np.float32)


def _band(image: Image, band_px: int) -> Field:
    """Less the mean around."""
    band: Field = cv2.subtract(image, cv2.blur(image, (band_px, band_px)), dtype=cv2.CV_32F)
    return band


def _slope(image: Field) -> Field:
    """Grey levels per px along the row, by central differences."""
    return np.asarray(cv2.Sobel(image, cv2.CV_32F, 1, 0, ksize=1, scale=0.5), np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class _Planes:
    """Least-squares planes of the windows centred on every cell: level at the centre, slopes per cell, mean squared misfit."""

    level: Cells
    slope_u: Cells
    slope_v: Cells
    misfit: Cells
    support: Cells


def _fits(cells: _Corrected, radius: int, middle: float) -> _Planes:
    """The planes. float32 suffices around the middle: |d| < 64 px, misfits good to 1e-3 px²."""
    w = cells.weight
    d = (cells.disparity - np.float32(middle)) * (w > 0)
    ones = np.ones(2 * radius + 1, dtype=np.float32)
    ramp = np.arange(-radius, radius + 1, dtype=np.float32)

    def window(field: Cells, along_u: Float32[np.ndarray, "k"], along_v: Float32[np.ndarray, "k"]) -> Cells:
        summed: Cells = cv2.sepFilter2D(field, cv2.CV_32F, along_u, along_v, borderType=cv2.BORDER_CONSTANT)
        return summed

    wd = w * d
    n = np.maximum(window(w, ones, ones), np.float32(1e-6))
    scale = 1 / n
    mean_u, mean_v, mean_d = window(w, ramp, ones) * scale, window(w, ones, ramp) * scale, window(wd, ones, ones) * scale
    uu = window(w, ramp**2, ones) * scale - mean_u**2 + np.float32(SLOPE_PRIOR)
    vv = window(w, ones, ramp**2) * scale - mean_v**2 + np.float32(SLOPE_PRIOR)
    uv = window(w, ramp, ramp) * scale - mean_u * mean_v
    ud = window(wd, ramp, ones) * scale - mean_u * mean_d
    vd = window(wd, ones, ramp) * scale - mean_v * mean_d
    dd = window(wd * d, ones, ones) * scale - mean_d**2
    det = uu * vv - uv * uv
    a, b = (ud * vv - vd * uv) / det, (vd * uu - ud * uv) / det
    level = mean_d - a * mean_u - b * mean_v + np.float32(middle)
    return _Planes(level, a, b, np.maximum(dd - a * ud - b * vd, np.float32(0)), n * np.float32(1 / ones.size**2))


@dataclass(frozen=True, slots=True, eq=False)
class _Vote:
    """The weighted mean of the planes of a cell's windows, continued to the cell; `misfit` is the logarithm of theirs, px²."""

    level: Cells
    slope_u: Cells
    slope_v: Cells
    misfit: Cells


def _vote(planes: _Planes, radius: int, middle: float) -> _Vote:
    """Nine windows: around the cell and `radius` to all sides. Each one's say is the inverse cube of its cost.

    With the square edges blur, with the fourth power noise is taken out no better. The sums are separable.
    """
    cost = np.maximum(planes.misfit + np.float32(1e-3) / (planes.support + np.float32(1e-3)), np.float32(LEAST_COST))
    say = 1 / (cost * cost * cost)
    weighted_u, weighted_v = say * planes.slope_u, say * planes.slope_v
    everywhere, turned = np.zeros((2, 2 * radius + 1), np.float32)
    everywhere[::radius], turned[::radius] = 1, (-radius, 0, radius)

    def around(field: Cells, along_u: Float32[np.ndarray, "k"], along_v: Float32[np.ndarray, "k"]) -> Cells:
        summed: Cells = cv2.sepFilter2D(field, cv2.CV_32F, along_u, along_v, borderType=cv2.BORDER_CONSTANT)
        return summed

    def all_of(field: Cells) -> Cells:
        summed: Cells = np.asarray(around(field, everywhere, everywhere) + field * np.float32(ASIDE**3 - 1), np.float32)
        return summed

    total = all_of(say)
    level = all_of(say * (planes.level - np.float32(middle)))
    level -= around(weighted_u, turned, everywhere) + around(weighted_v, everywhere, turned)
    scale = 1 / total
    return _Vote(level * scale + np.float32(middle), all_of(weighted_u) * scale, all_of(weighted_v) * scale,
                 np.log(total) * np.float32(-1 / 3))


def spread(cells: Cells, shape: tuple[int, int]) -> Field:
    """Cells on all pixels: each cell's value on its four, the last ones also on an odd last row and column."""
    rows, cols = cells.shape
    even = cv2.resize(cells, (2 * cols, 2 * rows), interpolation=cv2.INTER_NEAREST)
    spread: Field = cv2.copyMakeBorder(even, 0, shape[0] - 2 * rows, 0, shape[1] - 2 * cols, cv2.BORDER_REPLICATE)
    return spread
