"""The bin seen from above: the highest measured point per cell, and a watertight version where unseen means occupied."""

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from binpick.data import Cloud, HeightMap, Labels, Mask, frozen
from binpick.settings import Bin

Grid = Float32[np.ndarray, "rows cols"]

CELL_M = 0.002
"""Edge of a cell: about four pixels at 1 m, so that one wrong pixel cannot punch a hole."""
FALL = (1.0, 6.0)
"""How steeply sight lines fall behind an edge, at least and at most: cameras look less than 45° aslant, and edges are rough."""
WALL_CELLS = 3
"""Cells along a wall that show the wall, or what leans on it."""
WIDE_CELLS = 8
"""A hole in which a square of so many cells fits is more than a shadow beside a part: a part could lie there."""
REACHES = (1, 2, 4, 8, 16, 32, 64)
"""Steps in cells whose sums are all distances up to their own."""
NO_EYES = np.zeros((0, 3))


def height_map(xyz_bin: Cloud, model: Bin, eyes_bin: Float64[np.ndarray, "n 3"] = NO_EYES) -> HeightMap:
    """The height map over the bin's inside from points in the bin's frame (NaN = not measured).

    The highest point of a cell counts: errors towards "occupied" only cost a grasp; but single pixels that stand out of their
    surroundings do not count. Points below the floor count as floor. `eyes_bin` is where the cameras are: a wall that all of
    them see from inside hides nothing in the bin.
    """
    length, width, height_m = model.inner_size_m
    cols, rows = int(np.ceil(length / CELL_M)), int(np.ceil(width / CELL_M))
    x, y, z = cv2.split(xyz_bin)
    z = _without_spikes(z)
    x += np.float32(length / 2)
    y += np.float32(width / 2)
    with np.errstate(invalid="ignore"):
        inside = (x >= 0) & (x < length) & (y >= 0) & (y < width)
    # x and y are not negative here: cutting off the decimals rounds down; a cell may stick out of the bin by a part of its edge
    j, i = ((side[inside] / np.float32(CELL_M)).astype(np.int32) for side in (x, y))
    heights = np.full(rows * cols, -np.inf, dtype=np.float32)
    np.maximum.at(heights, np.minimum(i, rows - 1) * cols + np.minimum(j, cols - 1), np.maximum(z[inside], np.float32(0)))
    heights[np.isneginf(heights)] = np.nan
    grid = heights.reshape(rows, cols)
    coverage = float(np.isfinite(grid).mean())
    filled = _fill(grid, _inner(grid, model, eyes_bin), _fall(grid, model, eyes_bin), np.float32(height_m))
    return HeightMap(height=frozen(grid), watertight=frozen(filled), cell_m=CELL_M, origin_x_m=-length / 2,
                     origin_y_m=-width / 2, coverage=coverage)


def _without_spikes(z: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Heights opened by 3x3 pixels, unmeasured ones left out: at edges a pixel or two often stand some millimetres too high."""
    known, square = np.isfinite(z), np.ones((3, 3), dtype=np.uint8)
    lowest = cv2.erode(np.where(known, z, np.float32(np.inf)), square)
    opened = cv2.dilate(np.where(known, lowest, np.float32(-np.inf)), square)
    return np.where(known, opened, np.float32(np.nan)).astype(np.float32)


def _inner(grid: Grid, model: Bin, eyes_bin: Float64[np.ndarray, "n 3"]) -> Mask:
    """The cells behind which something can hide: all but those at walls that every eye sees from inside."""
    inner = np.ones(grid.shape, dtype=bool)
    for axis, half in ((1, model.inner_size_m[0] / 2), (0, model.inner_size_m[1] / 2)):
        along = np.moveaxis(inner, axis, 0)
        at = eyes_bin[:, 1 - axis]
        if len(at) and at.max() < half:
            along[-WALL_CELLS:] = False
        if len(at) and at.min() > -half:
            along[:WALL_CELLS] = False
    return inner


def _fall(grid: Grid, model: Bin, eyes_bin: Float64[np.ndarray, "n 3"]) -> Grid:
    """How steeply the flattest sight line over each cell falls, metres a metre."""
    fall = np.full(grid.shape, FALL[1 if len(eyes_bin) else 0], dtype=np.float32)
    (rows, cols), (length, width, _) = grid.shape, model.inner_size_m
    x, y = ((np.arange(count) + 0.5) * CELL_M - side / 2 for count, side in ((cols, length), (rows, width)))
    for eye in eyes_bin:
        aside = np.hypot(x[None, :] - eye[0], y[:, None] - eye[1])
        fall = np.minimum(fall, (eye[2] - model.inner_size_m[2]) / np.maximum(aside, 1e-3)).astype(np.float32)
    return np.maximum(fall, np.float32(FALL[0]))


def _fill(grid: Grid, inner: Mask, fall: Grid, rim_m: np.float32) -> Grid:
    """Unseen cells take the highest of what borders their hole; in narrow ones, which are shadows, sight lines leave less.

    A single unseen row between measured cells is a gap of sampling, not a hiding place, and is closed the same way. A wide hole
    at the wall may hide the whole wall's height.
    """
    unseen = ~np.isfinite(grid)
    if unseen.all():
        return np.full_like(grid, rim_m)
    count, labels = cv2.connectedComponents(unseen.astype(np.uint8), connectivity=8)
    square = np.ones((WIDE_CELLS, WIDE_CELLS), dtype=np.uint8)
    wide = cv2.dilate(cv2.morphologyEx(unseen.astype(np.uint8), cv2.MORPH_OPEN, square), square[:5, :5]) > 0
    known, hiding = (np.where(seen, grid, np.float32(0)) for seen in (~unseen, ~unseen & inner))
    anything, shadow = (_highest(heights, labels, count) for heights in (known, hiding))
    fill = np.where(wide, anything, np.minimum(shadow, _hidden(hiding, fall)))
    return np.where(unseen, fill, grid).astype(np.float32)


def _highest(heights: Grid, labels: Labels, count: int) -> Grid:
    """Of each hole the highest that borders it, in all its cells."""
    around, hole = cv2.dilate(heights, np.ones((3, 3), dtype=np.uint8)), labels > 0
    highest = np.zeros(count, dtype=np.float32)
    np.maximum.at(highest, labels[hole], around[hole])
    everywhere: Grid = highest[labels]
    return everywhere


def _hidden(hiding: Grid, fall: Grid) -> Grid:
    """How high each cell can be and lie behind something: the highest of all around it, less what sight lines fall by."""
    reached: Grid = cv2.dilate(hiding, np.ones((3, 3), dtype=np.uint8))     # edges are measured that exactly
    for reach in REACHES:
        square = np.ones((2 * reach + 1, 2 * reach + 1), dtype=np.uint8)
        reached = np.maximum(reached, cv2.dilate(reached, square) - fall * np.float32(reach * CELL_M))
    return reached
