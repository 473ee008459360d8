"""Sub-pixel disparity: each match is corrected by the images' own slope, and planes are fitted to what many of them say.

The correction is one Gauss-Newton step of image registration (Lucas and Kanade 1981): where the right image, warped by the
disparity, differs by e from the left one and rises by g per px, the match is e/g px off, and says so with weight g². Planes
through the weighted corrections of a window take out their noise and the matcher's pixel locking; since the window that fits
best may stand to any side of the pixel, they do not reach across depth edges.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32

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
"""How many times better a window aside must fit than the one around the pixel."""
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

    @property
    def windows(self) -> tuple[tuple[int, int], ...]:
        """Rows and columns from a cell to the middles of the windows it may belong to, its own first."""
        steps = (0, -self.radius, self.radius)
        return tuple((dv, du) for dv in steps for du in steps)


FULL, HALF = Reach(radius=3, band_px=9), Reach(radius=2, band_px=5)
"""At full resolution windows of 14x14 px; of 20x20 px at half, where a pixel is worth two."""


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """Disparities in px relative to the window's smallest; NaN where nothing was matched. Cells are 2x2 px.

    `departure` is how far the plane lies from the match (px), `misfit` the logarithm of its mean squared residual (px²),
    `slope` its steepness and `bend` how far that differs from the steepness around, both px per px.
    """

    disparity: Disparity
    departure: Disparity
    misfit: Cells
    slope: Cells
    bend: Cells


def refine(matched: Disparity, rectified: Rectified, reach: Reach) -> Refined:
    """The matched disparity (px relative to the window's smallest, NaN: none), on the window's pixels, refined."""
    cells = _cells(matched, rectified, reach.band_px)
    level, slope_u, slope_v, misfit = _best(*_fits(cells, reach.radius, rectified.window.num_disparities / 2), reach)
    shape = matched.shape
    v, u = (np.resize(np.array([-0.25, 0.25], np.float32), n) for n in shape)
    plane = spread(level, shape)
    plane += spread(slope_u, shape) * u
    plane += spread(slope_v, shape) * v[:, None]
    departure = np.abs(plane - matched)
    with np.errstate(invalid="ignore"):
        disparity = np.where(departure < TRUSTED_PX, plane, matched)
    # not cv2.magnitude: its last bit depends on where in memory the arrays lie
    steepness = np.minimum(np.sqrt(slope_u * slope_u + slope_v * slope_v) / 2, np.float32(1))
    return Refined(disparity, departure, np.log(np.minimum(misfit, 10) + np.float32(1e-4)), steepness,
                   _bend(slope_u, slope_v, reach.radius))


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


def _fits(cells: _Corrected, radius: int, middle: float) -> tuple[_Planes, Bool[np.ndarray, "rows cols"]]:
    """The planes, and which cells are known. float32 suffices around the middle: |d| < 64 px, misfits good to 1e-3 px²."""
    w = cells.weight
    known = w > 0
    d = (cells.disparity - np.float32(middle)) * known
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
    return _Planes(level, a, b, np.maximum(dd - a * ud - b * vd, np.float32(0)), n * np.float32(1 / ones.size**2)), known


def _best(planes: _Planes, known: Bool[np.ndarray, "rows cols"], reach: Reach) -> tuple[Cells, Cells, Cells, Cells]:
    """Of the windows around and aside of each cell the plane that fits best, continued to the cell; NaN: cell not known."""
    (rows, cols), r = known.shape, reach.radius
    cost = np.pad(planes.misfit + np.float32(1e-3) / (planes.support + np.float32(1e-3)), r, constant_values=np.inf)
    best = cost[r:r + rows, r:r + cols].copy()
    choice = np.zeros(known.shape, dtype=np.uint8)
    for k, (dv, du) in enumerate(reach.windows[1:], 1):
        aside = cost[r + dv:r + dv + rows, r + du:r + du + cols] * np.float32(ASIDE)
        better = aside < best
        choice[better] = k
        np.copyto(best, aside, where=better)
    down, across = (np.array(offsets, dtype=np.int32).take(choice) for offsets in zip(*reach.windows, strict=True))
    source = np.arange(rows * cols, dtype=np.int32).reshape(rows, cols) + down * cols + across
    slope_u, slope_v = planes.slope_u.ravel().take(source), planes.slope_v.ravel().take(source)
    level = planes.level.ravel().take(source) - slope_u * across.astype(np.float32) - slope_v * down.astype(np.float32)
    level[~known] = np.nan
    return level, slope_u, slope_v, best


def spread(cells: Cells, shape: tuple[int, int]) -> Field:
    """Cells on all pixels: each cell's value on its four, the last ones also on an odd last row and column."""
    rows, cols = cells.shape
    even = cv2.resize(cells, (2 * cols, 2 * rows), interpolation=cv2.INTER_NEAREST)
    spread: Field = cv2.copyMakeBorder(even, 0, shape[0] - 2 * rows, 0, shape[1] - 2 * cols, cv2.BORDER_REPLICATE)
    return spread
