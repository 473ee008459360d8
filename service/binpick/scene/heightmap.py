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
    points = xyz_bin[np.isfinite(xyz_bin[..., 2])]
    j = np.floor((points[:, 0] + length / 2) / CELL_M).astype(np.int32)
    i = np.floor((points[:, 1] + width / 2) / CELL_M).astype(np.int32)
    inside = (i >= 0) & (i < rows) & (j >= 0) & (j < cols)
    heights = np.full(rows * cols, -np.inf, dtype=np.float32)
    np.maximum.at(heights, (i * cols + j)[inside], np.maximum(points[inside, 2], np.float32(0)))
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
