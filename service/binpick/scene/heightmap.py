"""The bin seen from above: the highest measured point per cell, and a watertight version where unseen means occupied."""

import cv2
import numpy as np
from jaxtyping import Float32

from binpick.data import Cloud, HeightMap, frozen
from binpick.settings import Bin

CELL_M = 0.002
"""Edge of a cell: about four pixels at 1 m, so that one wrong pixel cannot punch a hole."""


def height_map(xyz_bin: Cloud, model: Bin) -> HeightMap:
    """The height map over the bin's inside from points in the bin's frame (NaN = not measured).

    The highest point of a cell counts: errors towards "occupied" only cost a grasp. Points below the floor count as floor.
    """
    length, width, height_m = model.inner_size_m
    cols, rows = int(np.ceil(length / CELL_M)), int(np.ceil(width / CELL_M))
    x, y, z = cv2.split(xyz_bin)
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
    return HeightMap(height=frozen(grid), watertight=frozen(_fill(grid, np.float32(height_m))), cell_m=CELL_M,
                     origin_x_m=-length / 2, origin_y_m=-width / 2, coverage=coverage)


def _fill(grid: Float32[np.ndarray, "rows cols"], rim_m: np.float32) -> Float32[np.ndarray, "rows cols"]:
    """Unseen cells take the highest of what borders their hole; a hole at the wall may hide the whole wall's height.

    A single unseen row between measured cells is a gap of sampling, not a hiding place, and is closed the same way.
    """
    unseen = ~np.isfinite(grid)
    count, labels = cv2.connectedComponents(unseen.astype(np.uint8), connectivity=8)
    around = cv2.dilate(np.where(unseen, np.float32(0), grid), np.ones((3, 3), dtype=np.uint8))
    highest = np.zeros(count, dtype=np.float32)
    np.maximum.at(highest, labels[unseen], around[unseen])
    if np.isinf(highest).any() or not np.isfinite(grid).any():
        highest[:] = rim_m
    return np.where(unseen, highest[labels], grid).astype(np.float32)
