"""What speaks for and against each match: is it seen in both images, does another surface explain it better, do planes fit."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from binpick.data import Disparity, Image, Rectified
from binpick.stereo.compiled import compiled
from binpick.stereo.fit import Cells
from binpick.stereo.refine import Refined
from binpick.stereo.warp import Line, lengthened, sample

Field = Float32[np.ndarray, "h w"]
Known = Bool[np.ndarray, "h w"]
NOISE_VARIANCE, NOISE_PER_STEP = 8.0, 1 / 16
"""Squared grey levels of the difference of two pixels: twice a read noise of 2, and shot noise of the brightness."""
PER_SIGMA = (1 / np.sqrt(NOISE_VARIANCE + NOISE_PER_STEP * np.arange(256))).astype(np.float32)
"""Of each grey level."""
HALF = np.float32(0.5)
BEYOND = np.float32(4096)
"""Px; further than any disparity: what is not matched is never the lowest."""
MOST = 5.0
"""Differences between the images count up to so many sigma of noise: beyond, something else is seen."""
NEAR_PX = 3
AROUND = np.ones((NEAR_PX, NEAR_PX), np.uint8)
BLOCK_CELLS, WIDE_CELLS, GLINT_CELLS, GLOSS_CELLS = 3, 5, 7, 15
"""Sides of the squares that are looked at, in pixels and in cells of 2x2 px."""
DARK = 5.0
"""Grey levels below which a ratio of brightness means little."""
TWO_SURFACES_PX = 1.5
"""Disparities that differ by more within 5x5 px are two hypotheses for the pixels between them."""
MOST_JUMP_PX = 6.0
"""No jump is more of a jump than this one; 12 px or its root told less on the tuning seeds."""
OF_PIXELS = ("rival", "spread", "spread_near", "departure", "mismatch")
OF_CELLS = ("misfit", "slope", "bend", "support", "texture", "holes", "unconfirmed", "bright", "gloss", "glint", "glint_near")
"""The planes of `Evidence`, in their order; what changes slowly is kept for cells of 2x2 px.

rival: how much better (sigma) the other surface within 5x5 px explains the 3x3 px around, 0 where there is none. spread: range
of disparities in 5x5 and 3x3. departure, misfit, slope, bend, support: of the plane (see `refine`). mismatch: difference of the
images at this disparity, 3x3. texture: log of the image's squared slope, 6x6. holes: share of the 10x10 px without a match.
unconfirmed: what the filter's confidence leaves. bright: mean grey level / 100, 6x6: in shadow little is sure. gloss: log of
how much the views differ in brightness, 30x30; glint, glint_near: how that changes per cell along the row, 14x14 and 6x6: where
it does, a highlight moves across the surface and takes the match along.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """The measures of every pixel of the window; those of unmatched pixels mean nothing. `two` tells where surfaces compete."""

    pixels: Float32[np.ndarray, "n h w"]
    cells: Float32[np.ndarray, "m h2 w2"]
    two: Bool[np.ndarray, "h w"]


def gather(matched: Disparity, refined: Refined, confidence: UInt8[np.ndarray, "h w"], rectified: Rectified) -> Evidence:
    """The evidence on matched disparities, px relative to the window's smallest, NaN: not matched."""
    left = rectified.left[:, rectified.margin:]
    pixels = np.empty((len(OF_PIXELS), *matched.shape), np.float32)
    put = dict(zip(OF_PIXELS, pixels, strict=True))
    known, flat, deep = _bounds(matched)
    high, low = flat, deep
    for name in ("spread_near", "spread"):          # 3x3 of 3x3 is 5x5
        high, low = cv2.dilate(high, AROUND), cv2.erode(low, AROUND)
        _range(high, low, put[name])
    low = np.asarray(cv2.min(low, high), np.float32)
    seen, mismatch, difference = _compared(left, rectified.right, rectified.margin, flat, high, low, PER_SIGMA)
    cv2.blur(mismatch, (NEAR_PX, NEAR_PX), dst=put["mismatch"])
    two = _rival(cv2.blur(difference, (NEAR_PX, NEAR_PX)), flat, known, high, low, put["rival"])
    np.fmin(refined.departure, 2, out=put["departure"])
    return Evidence(pixels, _of_cells(left, seen, known, refined, confidence), two)


@compiled
def _bounds(matched: Disparity) -> tuple[Known, Field, Field]:
    """What is matched; the matches with 0, and with BEYOND, where there is none."""
    known, flat, deep = np.empty(matched.shape, np.bool_), np.empty_like(matched), np.empty_like(matched)
    for v in range(len(matched)):
        for u in range(matched.shape[1]):
            known[v, u] = not np.isnan(matched[v, u])
            flat[v, u] = matched[v, u] if known[v, u] else np.float32(0)
            deep[v, u] = matched[v, u] if known[v, u] else BEYOND
    return known, flat, deep


@compiled
def _range(high: Field, low: Field, spread: Field) -> None:
    """From the lowest to the highest match around; none where nothing is matched."""
    for v in range(len(high)):
        for u in range(high.shape[1]):
            spread[v, u] = min(max(high[v, u] - low[v, u], np.float32(0)), np.float32(MOST_JUMP_PX))


@compiled
def _rival(difference: Field, flat: Field, known: Known, high: Field, low: Field, rival: Field) -> Known:
    """How much better the surface explains the pixel that it was not matched to; where there are two."""
    two = np.empty(flat.shape, np.bool_)
    for v in range(len(flat)):
        for u in range(flat.shape[1]):
            two[v, u] = known[v, u] and high[v, u] - low[v, u] > np.float32(TWO_SURFACES_PX)
            better = difference[v, u] if flat[v, u] + flat[v, u] > high[v, u] + low[v, u] else -difference[v, u]
            rival[v, u] = better if two[v, u] else np.float32(0)
    return two


@compiled
def _compared(left: Image, right: UInt8[np.ndarray, "h whole_w"], margin: int, flat: Field, high: Field, low: Field,
              per_sigma: Float32[np.ndarray, "256"]) -> tuple[Image, Field, Field]:
    """The right image as the left view sees it at `flat`, how unlike they are there (sigmas of noise, at most MOST), and how
    much more so at `high` than at `low`."""
    seen, mismatch, difference = np.empty_like(left), np.empty_like(flat), np.empty_like(flat)
    line, there = np.empty(right.shape[1] + 1, np.float32), np.empty(left.shape[1], np.float32)
    grey, scale, other = np.empty_like(there), np.empty_like(there), np.empty_like(there)
    for v in range(left.shape[0]):
        lengthened(right[v], line)
        for u in range(len(grey)):
            grey[u], scale[u] = left[v, u], per_sigma[left[v, u]]
        sample(line, high[v], margin, there)
        _unlike(grey, scale, there, difference[v])
        sample(line, low[v], margin, there)
        _unlike(grey, scale, there, other)
        for u in range(len(other)):
            difference[v, u] -= other[u]
        sample(line, flat[v], margin, there)
        _unlike(grey, scale, there, mismatch[v])
        for u in range(len(there)):
            seen[v, u] = np.uint8(there[u])
    return seen, mismatch, difference


@compiled
def _unlike(grey: Line, scale: Line, there: Line, unlike: Line) -> None:
    """Of a row in units of `scale`, and `there` rounded to whole grey levels."""
    for u in range(len(grey)):
        there[u] = np.floor(there[u] + HALF)
        off = abs(grey[u] - there[u]) * scale[u]
        unlike[u] = off if off < np.float32(MOST) else np.float32(MOST)


def _of_cells(left: Image, seen: Image, known: Known, refined: Refined, confidence: UInt8[np.ndarray, "h w"],
              ) -> Float32[np.ndarray, "m h2 w2"]:
    rows, cols = refined.misfit.shape
    cells = np.empty((len(OF_CELLS), rows, cols), np.float32)
    put = dict(zip(OF_CELLS, cells, strict=True))
    put["misfit"][:], put["slope"][:], put["bend"][:] = refined.misfit, refined.slope, refined.bend
    put["support"][:] = refined.support
    steep, missing, *views = _means(left, seen, known)
    np.log(1 + cv2.blur(steep, (BLOCK_CELLS, BLOCK_CELLS)), out=put["texture"])
    cv2.blur(missing, (WIDE_CELLS, WIDE_CELLS), dst=put["holes"])
    np.multiply(255 - confidence[:2 * rows:2, :2 * cols:2], np.float32(1 / 255), out=put["unconfirmed"])
    near, around, wide = (tuple(cv2.blur(view, (size, size)) for view in views)
                          for size in (BLOCK_CELLS, GLINT_CELLS, GLOSS_CELLS))
    np.multiply(near[0], np.float32(1 / 100), out=put["bright"])
    np.abs(_brighter(*wide), out=put["gloss"])
    for name, pair in (("glint", around), ("glint_near", near)):
        np.abs(cv2.Sobel(_brighter(*pair), cv2.CV_32F, 1, 0, ksize=1, scale=0.5), out=put[name])
    return cells


@compiled
def _means(left: Image, seen: Image, known: Known) -> tuple[Cells, Cells, Cells, Cells]:
    """Of each cell: the left image's squared slope along the row, the share without a match, both images in whole levels."""
    rows, cols = left.shape[0] // 2, left.shape[1] // 2
    steep, missing = np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32)
    here, there = np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32)
    squares = np.zeros(left.shape[1], np.int32)
    for row in range(rows):
        v, below = 2 * row, 2 * row + 1
        for u in range(1, len(squares) - 1):
            rise, rise_below = np.int32(left[v, u + 1]) - left[v, u - 1], np.int32(left[below, u + 1]) - left[below, u - 1]
            squares[u] = rise * rise + rise_below * rise_below
        for col in range(cols):
            u, beside = 2 * col, 2 * col + 1
            steep[row, col] = np.float32(squares[u] + squares[beside]) * np.float32(1 / 16)
            matched = np.int32(known[v, u]) + known[v, beside] + known[below, u] + known[below, beside]
            missing[row, col] = 1 - np.float32(matched) * np.float32(0.25)
            here[row, col] = (np.int32(left[v, u]) + left[v, beside] + left[below, u] + left[below, beside] + 2) // 4
            there[row, col] = (np.int32(seen[v, u]) + seen[v, beside] + seen[below, u] + seen[below, beside] + 2) // 4
    return steep, missing, here, there


def _brighter(left: Cells, right: Cells) -> Cells:
    """Log of how much brighter the left view is than the right one."""
    return np.asarray(np.log((left + np.float32(DARK)) / (right + np.float32(DARK))), np.float32)
