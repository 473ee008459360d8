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
from binpick.stereo import fit, sums
from binpick.stereo.compiled import compiled
from binpick.stereo.fit import Cells, Planes
from binpick.stereo.warp import Line, lengthened, sample

Field = Float32[np.ndarray, "h w"]
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
    planes = fit.planes(cells.disparity, cells.weight, reach.radius, middle)
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
    totals = np.empty((5, matched.shape[1]), np.float32)
    for row in range(rows):
        totals[:] = 0
        for v in (2 * row, 2 * row + 1):
            _registered(matched[v], left[v], right[v], margin, totals)
        for col in range(cols):
            g2, ge = totals[0, 2 * col] + totals[0, 2 * col + 1], totals[1, 2 * col] + totals[1, 2 * col + 1]
            g2d = totals[2, 2 * col] + totals[2, 2 * col + 1]
            known, plain = totals[3, 2 * col] + totals[3, 2 * col + 1], totals[4, 2 * col] + totals[4, 2 * col + 1]
            if known > 1:
                step = min(max(ge / max(g2, LEAST_SLOPE), -MOST_STEP), MOST_STEP)
                disparity[row, col] = (g2d / g2 if g2 > LEAST_SLOPE else plain / known) - step
                mean = g2 * QUARTER
                weight[row, col] = mean / (1 + mean / STRONG) + LEAST_WEIGHT
    return disparity, weight


@compiled
def _registered(matched: Line, left: Line, right: Float32[np.ndarray, "whole_w"], margin: int,
                totals: Float32[np.ndarray, "5 w"]) -> None:
    """A row's g², g e, g² d, count and d, added to `totals`."""
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
        totals[0, u] += rise * rise
        totals[1, u] += rise * (left[u] - value[u])
        totals[2, u] += rise * rise * filled[u]
        totals[3, u] += known
        totals[4, u] += filled[u]


@compiled
def _slopes(line: Line, slopes: Float32[np.ndarray, "longer"]) -> None:
    """Grey levels per px along a row, by central differences; none at its ends."""
    slopes[:] = 0
    for u in range(1, len(line) - 1):
        slopes[u] = (line[u + 1] - line[u - 1]) * np.float32(0.5)


def _band(image: Image, band_px: int) -> Field:
    """Less the mean around."""
    band: Field = cv2.subtract(image, cv2.blur(image, (band_px, band_px)), dtype=cv2.CV_32F)
    return band


@dataclass(frozen=True, slots=True, eq=False)
class _Vote:
    """The weighted mean of the planes of a cell's windows, continued to the cell; `misfit` is the logarithm of theirs, px²."""

    level: Cells
    slope_u: Cells
    slope_v: Cells
    misfit: Cells


def _vote(planes: Planes, radius: int, middle: float) -> _Vote:
    """Nine windows: around the cell and `radius` to all sides. Each one's say is the inverse cube of its cost.

    With the square edges blur, with the fourth power noise is taken out no better.
    """
    say, level, slope_u, slope_v = _counted(planes.say, planes.level, planes.slope_u, planes.slope_v, radius)
    return _Vote(level + np.float32(middle), slope_u, slope_v, np.log(say) * np.float32(-1 / 3))


@compiled
def _counted(say: Cells, level: Cells, slope_u: Cells, slope_v: Cells, radius: int) -> tuple[Cells, Cells, Cells, Cells]:
    """The windows' whole say, and what they say of a cell, of planes weighted by their say with `radius` zeros around."""
    rows, cols = say.shape[0] - 2 * radius, say.shape[1] - 2 * radius
    says, levels = np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32)
    slopes_u, slopes_v = np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32)
    everywhere, turned = np.array((1, 1, 1, 0), np.float32), np.array((-radius, 0, radius, 0), np.float32)
    column = np.empty((5, say.shape[1]), np.float32)
    far, own = 2 * radius, np.float32(ASIDE**3 - 1)
    for v in range(rows):
        column[:] = 0
        for k, (field, taps) in enumerate(((say, everywhere), (level, everywhere), (slope_u, everywhere), (slope_v, everywhere),
                                           (slope_v, turned))):
            sums.add_four(column[k], field[v], field[v + radius], field[v + far], field[v], taps)
        for u in range(cols):
            at = u + radius
            total = column[0, u] + column[0, at] + column[0, u + far] + say[v + radius, at] * own
            plane = column[1, u] + column[1, at] + column[1, u + far] + level[v + radius, at] * own
            plane -= (column[2, u + far] - column[2, u]) * np.float32(radius)
            plane -= column[4, u] + column[4, at] + column[4, u + far]
            scale = 1 / total
            says[v, u], levels[v, u] = total, plane * scale
            slopes_u[v, u] = (column[2, u] + column[2, at] + column[2, u + far] + slope_u[v + radius, at] * own) * scale
            slopes_v[v, u] = (column[3, u] + column[3, at] + column[3, u + far] + slope_v[v + radius, at] * own) * scale
    return says, levels, slopes_u, slopes_v
