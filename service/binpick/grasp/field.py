"""A distance field: how far from the part's surface any point is, and which way, by one look into a grid."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32
from scipy import ndimage

CELLS = 150_000
"""Cells of a field: about 1 mm for a part of 60 mm, which the first-order step from a cell's middle refines."""
MARGIN = 0.18
"""How far the field reaches beyond the part, of its largest side."""

Offsets = Float32[np.ndarray, "*batch 3"]
Distances = Float32[np.ndarray, "*batch"]


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """The middles of a box of cells: where the first one is, their side, and how many there are along x, y, z."""

    low: Float32[np.ndarray, "3"]
    cell_m: float
    shape: tuple[int, int, int]

    @classmethod
    def around(cls, low: np.ndarray, high: np.ndarray) -> "Grid":
        """The grid around a box."""
        margin = MARGIN * float((high - low).max())
        size = high - low + 2 * margin
        cell_m = float(np.cbrt(size.prod() / CELLS))
        nx, ny, nz = (np.ceil(size / cell_m).astype(int) + 1).tolist()
        return cls((low - margin).astype(np.float32), cell_m, (nx, ny, nz))

    @property
    def points(self) -> Float32[np.ndarray, "x y z 3"]:
        """All middles."""
        axes = (np.arange(count, dtype=np.float32) * np.float32(self.cell_m) for count in self.shape)
        return np.asarray(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1) + self.low)


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """Signed distance (inside negative, metres) and its unit gradient at each cell, x slowest."""

    grid: Grid
    table: Float32[np.ndarray, "cells 4"]

    @classmethod
    def of(cls, grid: Grid, distance: Float32[np.ndarray, "x y z"], inside: np.ndarray) -> "Field":
        """The field of unsigned distances and of which cells lie inside.

        Pieces that overlap have surfaces inside the part: there the way to the nearest cell outside counts.
        """
        depth = (ndimage.distance_transform_edt(inside) - 1).astype(np.float32) * np.float32(grid.cell_m)
        signed = np.where(inside, -np.maximum(distance, depth), distance)
        slopes = np.stack([*np.gradient(signed, grid.cell_m)], axis=-1)
        slopes /= np.maximum(np.linalg.norm(slopes, axis=-1, keepdims=True), 1e-6)
        table = np.concatenate([signed[..., None], slopes], axis=-1).reshape(-1, 4)
        return cls(grid, np.ascontiguousarray(table, dtype=np.float32))

    def at(self, points: Offsets) -> tuple[Distances, Offsets]:
        """Distance and direction away from the surface; beyond the grid its border is extended straight."""
        grid = self.grid
        nx, ny, nz = grid.shape
        place = (points - grid.low) * np.float32(1 / grid.cell_m)
        cell = np.rint(place)
        np.clip(cell, 0, np.array([nx - 1, ny - 1, nz - 1], dtype=np.float32), out=cell)
        found = self.table[((cell[..., 0] * ny + cell[..., 1]) * nz + cell[..., 2]).astype(np.int32)]
        way = found[..., 1:]
        place -= cell
        return found[..., 0] + np.float32(grid.cell_m) * np.einsum("...i,...i->...", place, way), way
