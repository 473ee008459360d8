"""Pieces of one prism: they end flush on both sides, so what folds up from a part or stands on it is known as its own.

Pieces of a part need not touch in the image, as a stem hides part of the bar it stands on; and where they do touch in a
concave fold, two parts look the same. But pieces of a prism are equally wide and end in the same two planes; parts that fell
into a bin hardly ever do.
"""

from dataclasses import dataclass, fields

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64
from scipy import ndimage

from binpick.data import Labels, Mask
from binpick.scene.surface import Surface

LEAST_M2 = 60e-6
"""A face smaller than this says nothing about its part's width."""
FLAT_M = 0.0012
"""A face is flat when it lies within this of a plane, rms."""
NARROW_M = 0.008
"""Faces narrower than this may end flush by chance."""
REACH_M = 0.025
"""Faces further apart than this in the image are not compared."""
CORNERS = 32
"""So many corners of a face's outline are looked at."""
FOLDED, LEVEL = float(np.cos(np.deg2rad(50.0))), float(np.cos(np.deg2rad(12.0)))
"""Two faces fold when their normals' product is below the first; they are level with each other above the second."""
FOLD_FLUSH_M, FLUSH_M = 0.003, 0.0035
"""Both ends of two faces that fold, and of two level ones, lie within this of each other."""
FOLD_GAP_M, FOLD_HIDDEN_M = 0.005, 0.012
"""Of two faces that fold, one comes this near to the other's plane, the other as near as the first lets it be seen."""
HIGHER = 1.2
"""What stands on a part is higher by this many times their common width: lower things may as well have come to lie there."""
OVERLAP_M, GAP_M = 0.005, 0.005
"""It begins where the face ends: as much earlier, or later, than measured and hidden."""

Vectors = Float64[np.ndarray, "n 3"]
Values = Float64[np.ndarray, "n"]
Integers = Int64[np.ndarray, "n"]
Flags = Bool[np.ndarray, "n"]


@dataclass(frozen=True, slots=True, eq=False)
class Faces:
    """Flat faces: their part, mean normal, centre, the corners of their outline, and two directions of their sides.

    All in the bin's frame; `box` is first row, end row, first column, end column in the image.
    """

    part: Integers
    normal: Vectors
    centre: Vectors
    corners: Float64[np.ndarray, "n k 3"]
    sides: Float64[np.ndarray, "n 2 3"]
    box: Int64[np.ndarray, "n 4"]

    def take(self, index: Integers) -> "Faces":
        """Some of them, or some several times."""
        return Faces(*(getattr(self, field.name)[index] for field in fields(self)))

    def range(self, along: Vectors) -> tuple[Values, Values]:
        """Where each begins and ends along a direction of its own."""
        at = np.einsum("nki,ni->nk", self.corners, along)
        return at.min(axis=1), at.max(axis=1)


def pairs(faces: Labels, parts: Labels, surface: Surface, spacing_m: float) -> tuple[Integers, Integers]:
    """Pairs of labelled parts that have flush faces; a pair may occur several times."""
    flat = _flat(faces, parts, surface, spacing_m)
    first, second = np.nonzero(np.triu(_near(flat.box, REACH_M / spacing_m) & (flat.part[:, None] != flat.part), 1))
    product = _product(flat.normal[first], flat.normal[second])
    # the lower of two level faces comes first
    swap = (product > LEVEL) & (_product(flat.centre[second] - flat.centre[first], flat.normal[first]) < 0)
    first, second = np.where(swap, second, first), np.where(swap, first, second)
    fold, level = np.flatnonzero(product < FOLDED), np.flatnonzero(product > LEVEL)
    same = np.concatenate([fold[_folded(flat.take(first[fold]), flat.take(second[fold]))],
                           level[_standing(flat.take(first[level]), flat.take(second[level]), surface.eyes)]])
    return flat.part[first[same]], flat.part[second[same]]


def _flat(faces: Labels, parts: Labels, surface: Surface, spacing_m: float) -> Faces:
    """The large and flat ones of labelled faces; every second row and column tells their planes."""
    few, count = faces[::2, ::2], int(faces.max(initial=0)) + 1
    place = np.flatnonzero(few)
    label = few.ravel()[place]
    xyz, towards = (np.ascontiguousarray(field[::2, ::2].reshape(-1, 3)[place].T) for field in (surface.xyz, surface.normal))
    size = np.maximum(np.bincount(label, minlength=count), 1).astype(np.float64)
    sums = [np.stack([np.bincount(label, axis, count) for axis in field], axis=1) for field in (xyz, towards)]
    centre, normal = sums[0] / size[:, None], _unit(sums[1].astype(np.float64))
    off = sum(normal[label, axis] * (xyz[axis] - centre[label, axis]) for axis in range(3))
    rough = np.sqrt(np.bincount(label, off * off, count) / size)
    owner = np.zeros(count, dtype=np.int64)
    owner[label] = parts[::2, ::2].ravel()[place]
    chosen = np.flatnonzero((4 * size >= LEAST_M2 / spacing_m**2) & (rough < FLAT_M))
    boxes = ndimage.find_objects(faces)
    corners, bounds = np.empty((len(chosen), CORNERS, 3)), np.empty((len(chosen), 4), dtype=np.int64)
    for i, face in enumerate(chosen.tolist()):
        high, wide = boxes[face - 1]
        hull = _hull(faces[high, wide] == face)
        corners[i] = surface.xyz[high, wide][hull[:, 1], hull[:, 0]]
        bounds[i] = high.start, high.stop, wide.start, wide.stop
    return Faces(owner[chosen], normal[chosen], centre[chosen], corners, _sides(corners, normal[chosen]), bounds)


def _hull(mask: Mask) -> Int32[np.ndarray, "k 2"]:
    """Corners (column, row) of the convex hull: some several times, or the most even choice of them."""
    outlines = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]
    hull = cv2.convexHull(np.concatenate(outlines))[:, 0]
    return np.asarray(hull[np.linspace(0, len(hull) - 1, CORNERS).round().astype(np.int64)])


def _sides(corners: Float64[np.ndarray, "n k 3"], normal: Vectors) -> Float64[np.ndarray, "n 2 3"]:
    """The directions of the smallest rectangle around each face's corners."""
    across = _unit(np.cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)]))
    plane = np.stack([across, np.cross(normal, across)], axis=1)
    flat = np.einsum("nki,nai->nka", corners, plane).astype(np.float32)
    turn = np.deg2rad([cv2.minAreaRect(points)[2] for points in flat])
    cos, sin = np.cos(turn)[:, None], np.sin(turn)[:, None]
    return np.stack([cos * plane[:, 0] + sin * plane[:, 1], cos * plane[:, 1] - sin * plane[:, 0]], axis=1)


def _near(box: Int64[np.ndarray, "n 4"], reach_px: float) -> Bool[np.ndarray, "n n"]:
    """Which boxes in the image come near to which."""
    rows, cols = (np.maximum(box[:, None, end] - box[:, end + 1], box[:, end] - box[:, None, end + 1]) for end in (0, 2))
    near: Bool[np.ndarray, "n n"] = np.maximum(rows, cols) <= reach_px
    return near


def _folded(first: Faces, second: Faces) -> Flags:
    """Faces that meet in a concave fold, over its whole length."""
    between = second.centre - first.centre
    concave = (_product(between, first.normal) > 0) & (_product(between, second.normal) < 0)
    gaps = [np.abs(np.einsum("nki,ni->nk", one.corners - other.centre[:, None], other.normal)).min(axis=1)
            for one, other in ((first, second), (second, first))]
    meet = (np.minimum(*gaps) < FOLD_GAP_M) & (np.maximum(*gaps) < FOLD_HIDDEN_M)
    off_m, _ = _off(first, second, _unit(np.cross(first.normal, second.normal)))
    return np.asarray(concave & meet & (off_m < FOLD_FLUSH_M))


def _standing(low: Faces, high: Faces, eyes: Float64[np.ndarray, "2 3"]) -> Flags:
    """Level faces of which one stands on the other's part: that one goes on up to where the higher one hides it."""
    normal, between = _unit(low.normal + high.normal), high.centre - low.centre
    height = _product(between, normal)
    stands = np.zeros(len(height), dtype=bool)
    for along in (*low.sides.transpose(1, 0, 2), *high.sides.transpose(1, 0, 2), _unit(np.cross(normal, between))):
        across = _unit(np.cross(normal, along))
        across *= np.where(_product(across, between) < 0, -1.0, 1.0)[:, None]
        begin = high.range(across)[0]
        edge = high.centre + (begin - _product(high.centre, across))[:, None] * across
        slope = np.max([_product(eye - edge, across) / _product(eye - edge, normal) for eye in eyes], axis=0)
        gap = begin - low.range(across)[1]
        off_m, wide_m = _off(low, high, along)
        stands |= ((gap > -OVERLAP_M) & (gap < GAP_M + height * np.maximum(slope, 0))
                   & (off_m < FLUSH_M) & (height > HIGHER * wide_m))
    return stands


def _off(one: Faces, other: Faces, along: Vectors) -> tuple[Values, Values]:
    """How far faces are from ending flush on both sides along a direction, inf if one is narrow; and the lesser width."""
    begin, end = one.range(along)
    begin_too, end_too = other.range(along)
    wide = np.minimum(end - begin, end_too - begin_too)
    off = np.maximum(np.abs(begin - begin_too), np.abs(end - end_too))
    return np.where(wide < NARROW_M, np.inf, off), wide


def _product(one: Vectors, other: Vectors) -> Values:
    product: Values = np.einsum("ni,ni->n", one, other)
    return product


def _unit(vectors: Vectors) -> Vectors:
    unit: Vectors = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
    return unit
