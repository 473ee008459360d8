"""How the surface goes on across a short way: in steps and in bends, and how regions that touch do so along their border.

Two points a few millimetres apart lie above or below each other's tangent planes. Where one surface goes on both are zero; at a
fold both points lie on the same side, at a step on opposite sides. This holds whatever lies between the two, so a border that
is measured a pixel off, or as a ramp, does not hide what it separates.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64

from binpick.data import Labels, Mask
from binpick.scene.surface import Surface

DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))
"""Rows and columns of the ways: right, down, and both diagonals."""

Integers = Int64[np.ndarray, "n"]
Values = Float64[np.ndarray, "n"]
Metres = Float32[np.ndarray, "n"]


@dataclass(frozen=True, slots=True, eq=False)
class Ways:
    """All ways of one direction between pixels of interest: the pixels at their start, middle and end, counted in reading
    order, and what lies between.

    `step_m` is how far the end lies above the start's surface; `bend_m` is positive at concave folds. `sigma_m` is the lesser
    depth noise of the two ends.
    """

    start: Integers
    middle: Integers
    end: Integers
    step_m: Metres
    bend_m: Metres
    sigma_m: Metres


def ways(surface: Surface, of_interest: Mask, half_px: int) -> list[Ways]:
    """The ways of all directions, `half_px` pixels to either side of their middle, whose both ends are of interest."""
    rows, cols = of_interest.shape
    pixels = np.flatnonzero(of_interest)
    xyz, normal = (np.ascontiguousarray(field.reshape(-1, 3)[pixels].T) for field in (surface.xyz, surface.normal))
    offset: Metres = np.einsum("kn,kn->n", xyz, normal)
    sigma_m = surface.sigma_z_m.ravel()[pixels]
    # each pixel's place among those of interest, -1 for others, with a frame as wide as ways are long
    wide = 2 * half_px
    place = np.full((rows + wide, cols + 2 * wide), -1)
    place[:rows, wide:-wide][of_interest] = np.arange(len(pixels))
    framed = pixels + pixels // cols * (2 * wide) + wide
    found = []
    for direction in DIRECTIONS:
        down, right = (sign * (half_px if not all(direction) else max(1, round(half_px / 2**0.5))) for sign in direction)
        there = place.ravel()[framed + 2 * (down * place.shape[1] + right)]
        start = np.flatnonzero(there >= 0)
        end = there[start]
        # how far the end lies above the start's tangent plane, and the start above the end's; both halved
        above, below = np.negative(offset[start]), np.negative(offset[end])
        for plane, slope in zip(xyz, normal, strict=True):
            above += slope[start] * plane[end]
            below += slope[end] * plane[start]
        above *= np.float32(0.5)
        below *= np.float32(0.5)
        found.append(Ways(pixels[start], pixels[start] + down * cols + right, pixels[end], above - below, above + below,
                          np.minimum(sigma_m[start], sigma_m[end])))
    return found


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
    flat = regions.ravel()
    for way in along:
        start, end = flat[way.start], flat[way.end]
        crosses = np.flatnonzero((start != end) & (start > 0) & (end > 0))
        p, q = (labels[crosses].astype(np.int64) for labels in (start, end))
        step, bend = (values[crosses].astype(np.float64) for values in (way.step_m, way.bend_m))
        yield p, q, step, bend
