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
from binpick.stereo.compiled import compiled
from binpick.stereo.warp import Line, lengthened, sample

Field = Float32[np.ndarray, "h w"]
Cells = Float32[np.ndarray, "rows cols"]
ZERO, QUARTER, ONE = np.float32(0), np.float32(0.25), np.float32(1)
MOST_STEP = np.float32(0.25)
"""Px; a single correction counts no further: beyond that the image is not straight, or the match is wrong."""
LEAST_SLOPE = np.float32(4e-3)
"""Squared grey levels per px, of four pixels together, from which the images say anything."""
STRONG = np.float32(200)
"""Squared grey levels per px from which an edge's weight grows no further: a part's outline is no better than a dot."""
LEAST_WEIGHT = np.float32(0.02)
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
    disparity, departure = _believed(matched, cells.weight, vote.level, vote.slope_u, vote.slope_v)
    # not cv2.magnitude: its last bit depends on where in memory the arrays lie
    steepness = np.minimum(np.sqrt(vote.slope_u * vote.slope_u + vote.slope_v * vote.slope_v) / 2, np.float32(1))
    bend = _bend(vote.slope_u, vote.slope_v, reach.radius)
    return Refined(disparity, departure, vote.misfit, steepness, bend, planes.support)


@compiled
def _believed(matched: Disparity, weight: Cells, level: Cells, slope_u: Cells, slope_v: Cells) -> tuple[Disparity, Disparity]:
    """The planes at the pixels' centres, or the match where that contradicts it, and how far off they are; NaN: no match."""
    rows, cols = weight.shape
    disparity, departure = np.empty_like(matched), np.empty_like(matched)
    for v in range(matched.shape[0]):
        row, down = min(v // 2, rows - 1), -QUARTER if v % 2 == 0 else QUARTER
        for u in range(matched.shape[1]):
            col, aside = min(u // 2, cols - 1), -QUARTER if u % 2 == 0 else QUARTER
            plane = level[row, col] + slope_u[row, col] * aside + slope_v[row, col] * down
            off = abs(plane - matched[v, u]) if weight[row, col] > 0 else np.float32(np.nan)
            departure[v, u] = off
            disparity[v, u] = plane if off < np.float32(TRUSTED_PX) else matched[v, u]
    return disparity, departure


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
    left, right = _band(rectified.left[:, rectified.margin:], band_px), _band(rectified.right, band_px)
    return _Corrected(*_corrected(matched, left, right, rectified.margin))


@compiled
def _corrected(matched: Disparity, left: Field, right: Float32[np.ndarray, "h whole_w"], margin: int) -> tuple[Cells, Cells]:
    """Of each 2x2 px, the disparity after one step of registration and its weight."""
    rows, cols = matched.shape[0] // 2, matched.shape[1] // 2
    disparity, weight = np.zeros((rows, cols), np.float32), np.zeros((rows, cols), np.float32)
    sums = np.empty((5, matched.shape[1]), np.float32)
    for row in range(rows):
        sums[:] = 0
        for v in (2 * row, 2 * row + 1):
            _registered(matched[v], left[v], right[v], margin, sums)
        for col in range(cols):
            g2, ge = sums[0, 2 * col] + sums[0, 2 * col + 1], sums[1, 2 * col] + sums[1, 2 * col + 1]
            g2d = sums[2, 2 * col] + sums[2, 2 * col + 1]
            known, plain = sums[3, 2 * col] + sums[3, 2 * col + 1], sums[4, 2 * col] + sums[4, 2 * col + 1]
            if known > 1:
                step = min(max(ge / max(g2, LEAST_SLOPE), -MOST_STEP), MOST_STEP)
                disparity[row, col] = (g2d / g2 if g2 > LEAST_SLOPE else plain / known) - step
                mean = g2 * np.float32(0.25)
                weight[row, col] = mean / (1 + mean / STRONG) + LEAST_WEIGHT
    return disparity, weight


@compiled
def _registered(matched: Line, left: Line, right: Float32[np.ndarray, "whole_w"], margin: int, sums: Float32[np.ndarray, "5 w"],
                ) -> None:
    """A row's g², g e, g² d, count and d, added to `sums`."""
    line, slopes = np.empty(len(right) + 1, np.float32), np.empty(len(right) + 1, np.float32)
    lengthened(right, line)
    _slopes(right, slopes)
    filled, value = np.empty(len(left), np.float32), np.empty(len(left), np.float32)
    slope, own = np.empty(len(left), np.float32), np.empty(len(left), np.float32)
    for u in range(len(left)):
        filled[u] = ZERO if np.isnan(matched[u]) else matched[u]
    sample(line, filled, margin, value)
    sample(slopes, filled, margin, slope)
    _slopes(left, own)
    for u in range(len(left)):
        known = ZERO if np.isnan(matched[u]) else ONE
        rise = (own[u] + slope[u]) * np.float32(0.5) * known
        sums[0, u] += rise * rise
        sums[1, u] += rise * (left[u] - value[u])
        sums[2, u] += rise * rise * filled[u]
        sums[3, u] += known
        sums[4, u] += filled[u]


@compiled
def _slopes(line: Line, slopes: Float32[np.ndarray, "longer"]) -> None:
    """Grey levels per px along a row, by central differences; none at its ends."""
    slopes[:] = 0
    for u in range(1, len(line) - 1):
        slopes[u] = (line[u + 1] - line[u - 1]) * np.float32(0.5)


def mean_of_four(field: np.ndarray) -> Cells:
    """Of each 2x2 px; an odd last row or column is left out."""
    rows, cols = (side // 2 * 2 for side in field.shape)
    return np.asarray(cv2.resize(field[:rows, :cols], (cols // 2, rows // 2), interpolation=cv2.INTER_AREA), np.float32)


def _band(image: Image, band_px: int) -> Field:
    """Less the mean around."""
    band: Field = cv2.subtract(image, cv2.blur(image, (band_px, band_px)), dtype=cv2.CV_32F)
    return band


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
