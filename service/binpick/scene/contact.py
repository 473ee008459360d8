"""How the surface goes on across a short way: in steps and in bends, and how regions that touch do so along their border.

Two points a few millimetres apart lie above or below each other's tangent planes. Where one surface goes on both are zero; at a
fold both points lie on the same side, at a step on opposite sides. This holds whatever lies between the two, so a border that
is measured a pixel off, or as a ramp, does not hide what it separates.
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from binpick.data import Labels, Mask
from binpick.scene.surface import Surface

DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))
"""Rows and columns of the ways: right, down, and both diagonals."""

Grid = tuple[slice, slice]
Field = Float32[np.ndarray, "h w"]
Planes = Float32[np.ndarray, "3 h w"]
Integers = Int64[np.ndarray, "n"]
Values = Float64[np.ndarray, "n"]


@dataclass(frozen=True, slots=True, eq=False)
class Ways:
    """All ways of one direction: what lies at their start, middle and end, and the surface between.

    `step_m` is how far the end lies above the start's surface; `bend_m` is positive at concave folds. Both are defined where
    `known` holds. `sigma_m` is the lesser depth noise of the two ends.
    """

    start: Grid
    middle: Grid
    end: Grid
    known: Bool[np.ndarray, "h w"]
    step_m: Field
    bend_m: Field
    sigma_m: Field


def ways(surface: Surface, of_interest: Mask, half_px: int) -> list[Ways]:
    """The ways of all directions, `half_px` pixels to either side of their middle."""
    xyz, normal = (np.ascontiguousarray(field.transpose(2, 0, 1)) for field in (surface.xyz, surface.normal))
    offset: Field = np.einsum("khw,khw->hw", xyz, normal)
    with ThreadPoolExecutor(max(1, cv2.getNumThreads()), thread_name_prefix="binpick-ways") as pool:
        return list(pool.map(partial(_ways, xyz, normal, offset, surface.sigma_z_m, of_interest, half_px), DIRECTIONS))


def _ways(xyz: Planes, normal: Planes, offset: Field, sigma_z_m: Field, of_interest: Mask, half_px: int,
          direction: tuple[int, int]) -> Ways:
    down, right = (sign * (half_px if not all(direction) else max(1, round(half_px / 2**0.5))) for sign in direction)
    start, middle, end = _grids(down, right, of_interest.shape)
    # how far the end lies above the start's tangent plane, and the start above the end's; both halved
    above, below = np.negative(offset[start]), np.negative(offset[end])
    product = np.empty_like(above)
    for plane, slope in zip(xyz, normal, strict=True):
        above += np.multiply(slope[start], plane[end], out=product)
        below += np.multiply(slope[end], plane[start], out=product)
    above *= np.float32(0.5)
    below *= np.float32(0.5)
    return Ways(start, middle, end, of_interest[start] & of_interest[end], above - below, np.add(above, below, out=product),
                np.minimum(sigma_z_m[start], sigma_z_m[end]))


def _grids(down: int, right: int, shape: tuple[int, ...]) -> tuple[Grid, Grid, Grid]:
    """Where ways start, their middles and their ends, for a step to either side."""
    rows, cols = shape
    aside = abs(right)
    middle = (slice(down, rows - down), slice(aside, cols - aside))
    start = (slice(0, rows - 2 * down), slice(aside - right, cols - aside - right))
    end = (slice(2 * down, rows), slice(aside + right, cols - aside + right))
    return start, middle, end


@dataclass(frozen=True, slots=True, eq=False)
class Contacts:
    """Pairs of regions (first < second) that ways join, how many do, and their mean step (up from the first) and bend."""

    first: Int64[np.ndarray, "n"]
    second: Int64[np.ndarray, "n"]
    count: Float64[np.ndarray, "n"]
    step_m: Float64[np.ndarray, "n"]
    bend_m: Float64[np.ndarray, "n"]

    @classmethod
    def of(cls, start: Integers, end: Integers, count: Values, step_m: Values, bend_m: Values) -> "Contacts":
        """Pairs that occur several times, in either order, as one; what joins a region to itself is left out."""
        apart = start != end
        start, end, count, step_m, bend_m = (values[apart] for values in (start, end, count, step_m, bend_m))
        regions = int(max(start.max(initial=0), end.max(initial=0))) + 1
        pairs, place = np.unique(np.minimum(start, end) * regions + np.maximum(start, end), return_inverse=True)
        sums = (count, np.where(start < end, step_m, -step_m) * count, bend_m * count)
        # of nothing at all bincount makes integers
        number, step, bend = (np.bincount(place, values, len(pairs)).astype(np.float64) for values in sums)
        return cls(pairs // regions, pairs % regions, number, step / number, bend / number)

    def merged(self, group: Integers) -> "Contacts":
        """The contacts of the groups that the regions fall into."""
        return Contacts.of(group[self.first], group[self.second], self.count, self.step_m, self.bend_m)


def contacts(regions: Labels, along: list[Ways]) -> Contacts:
    """The contacts of labelled regions; 0 is nobody. Noise averages out along a border, a true step does not."""
    start, end, step, bend = (np.concatenate(parts) for parts in zip(*_crossing(regions, along), strict=True))
    return Contacts.of(start, end, np.ones(len(start)), step, bend)


def _crossing(regions: Labels, along: list[Ways]) -> Iterator[tuple[Integers, Integers, Values, Values]]:
    """Of each way from one region to another: where it starts, where it ends, the step and the bend."""
    for way in along:
        start, end = regions[way.start], regions[way.end]
        place = np.flatnonzero(way.known & (start != end) & (start > 0) & (end > 0))
        p, q = (labels.ravel()[place].astype(np.int64) for labels in (start, end))
        step, bend = (field.ravel()[place].astype(np.float64) for field in (way.step_m, way.bend_m))
        yield p, q, step, bend
