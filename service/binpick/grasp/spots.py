"""Spots: where on faces and parts a tool's lips are worth a try, and what is measured around each of its cups there."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64
from scipy.spatial import cKDTree

from binpick import geometry
from binpick.data import Labels, Segments
from binpick.settings.tool import Cup

SKIRT_RADIUS = 1.5
"""What lies within this many lip radii is looked at: there the cup's own body comes down."""
POINTS_PER_RADIUS = 6
"""Neighbourhoods are looked at with about this many points along the lip's radius, if there are as many."""
PEAK_M = 0.004
"""Of the spots in a square of this side one is tried."""
LEAST_INSIDE = 0.65
"""Spots nearer to their segment's border than this share of the lip's radius are not tried; tilt shortens distances."""
CENTRING_M = 0.0015
"""What lies this far off the plane says nothing about where the face's middle is."""

Frames = Float64[np.ndarray, "n 4 4"]


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """The points around each cup on each of n spots, in the spot's frame: origin there, z along the normal. NaN = not measured.

    `cup` numbers the cup that each of the k places is looked at for, `lip` holds that cup's centre and radius, `place` the
    points' pixels. Every `stride`-th point of every `stride`-th row is there. `own`: of the spot's part.
    """

    local: Float32[np.ndarray, "n k 3"]
    own: Bool[np.ndarray, "n k"]
    place: Int64[np.ndarray, "n k"]
    cup: Int64[np.ndarray, "k"]
    lip: Float32[np.ndarray, "k 3"]
    stride: int

    @property
    def cups(self) -> list[int]:
        """The numbers of all cups."""
        return list(range(int(self.cup.max(initial=-1)) + 1))

    @property
    def radial(self) -> Float32[np.ndarray, "n k"]:
        """Distance from the middle of the cup, in lip radii."""
        x, y, radius = self.lip.T
        away: Float32[np.ndarray, "n k"] = np.hypot(self.local[..., 0] - x, self.local[..., 1] - y) / radius
        return away

    def take(self, index: np.ndarray) -> "Patch":
        """Some of the spots."""
        return replace(self, local=self.local[index], own=self.own[index], place=self.place[index])

    def of_cup(self, number: int) -> "Patch":
        """One cup's places."""
        mine = self.cup == number
        if mine.all():
            return self
        return replace(self, local=self.local[:, mine], own=self.own[:, mine], place=self.place[:, mine], cup=self.cup[mine],
                       lip=self.lip[mine])


def spacing(segments: Segments) -> float:
    """Median distance of neighbouring points of parts, metres; 1 mm when there are none."""
    parts = segments.parts[::4]
    place = np.nonzero((parts[:, 1:] > 0) & (parts[:, :-1] == parts[:, 1:]))
    rows = segments.xyz[::4]
    steps = rows[place[0], place[1] + 1] - rows[place]
    return float(np.median(np.linalg.norm(steps, axis=1))) if len(steps) else 0.001


def spots(segments: Segments, radius_m: float, spacing_m: float) -> tuple[Int32[np.ndarray, "n 2"], int]:
    """Pixels (row, column) worth a try: on faces and on parts, where the border is locally farthest away.

    Also how many were left out because the border is too near.
    """
    cell = max(1, round(PEAK_M / spacing_m))
    wide_px = LEAST_INSIDE * radius_m / spacing_m
    kept, narrow = [], 0
    for labels in (segments.faces, segments.parts):
        found, distance = _peaks(labels, cell)
        usable = np.isfinite(segments.normal[found[:, 0], found[:, 1]]).all(axis=1)
        usable &= segments.parts[found[:, 0], found[:, 1]] > 0
        narrow += int((usable & (distance < wide_px)).sum())
        kept.append(found[usable & (distance >= wide_px)])
    return np.unique(np.concatenate(kept), axis=0).astype(np.int32), narrow


def _peaks(labels: Labels, cell: int) -> tuple[Int32[np.ndarray, "n 2"], Float32[np.ndarray, "n"]]:
    """Local maxima of the distance to the segment's border, and that distance, px: at most one in a square cell."""
    inner = labels > 0
    inner[:, 1:] &= labels[:, 1:] == labels[:, :-1]
    inner[1:] &= labels[1:] == labels[:-1]
    distance = cv2.distanceTransform(inner.astype(np.uint8), cv2.DIST_L2, 5)
    highest = cv2.dilate(distance, np.ones((7, 7), dtype=np.uint8))
    pixels = np.flatnonzero((distance >= highest) & (distance > 2))
    found, far = np.stack(np.divmod(pixels, labels.shape[1]), axis=1), distance.ravel()[pixels]
    columns = labels.shape[1] // cell + 1
    square = found[:, 0] // cell * columns + found[:, 1] // cell
    order = np.lexsort((-far, square))
    _, first = np.unique(square[order], return_index=True)
    chosen = order[first]
    return found[chosen].astype(np.int32), far[chosen]


def patches(segments: Segments, at: Int32[np.ndarray, "n 2"], T_bin_spot: Frames, cups: tuple[Cup, ...], spacing_m: float,
            ) -> Patch:
    """The neighbourhood of every cup on every spot, in the spot's frame, whose y is opposite to the TCP's."""
    cols = segments.parts.shape[1]
    middle = at[:, 0].astype(np.int64) * cols + at[:, 1]
    xyz, parts = segments.xyz.reshape(-1, 3), segments.parts.ravel()
    stride = max(1, int(min(cup.radius_m for cup in cups) / POINTS_PER_RADIUS / max(spacing_m, 1e-4)))
    places, cup, lip = [], [], []
    for number, each in enumerate(cups):
        here = at if each.x_m == each.y_m == 0 else _beneath(segments, T_bin_spot, each)
        place = _disc(segments, here, each.radius_m, spacing_m, stride)
        places.append(place)
        cup.append(np.full(place.shape[1], number))
        lip.append(np.tile(np.array([each.x_m, -each.y_m, each.radius_m], dtype=np.float32), (place.shape[1], 1)))
    place = np.concatenate(places, axis=1)
    offset = xyz.take(place, axis=0) - T_bin_spot[:, None, :3, 3].astype(np.float32)
    local = np.matmul(offset, T_bin_spot[:, :3, :3].astype(np.float32))
    return Patch(local=local, own=parts.take(place) == parts[middle][:, None], place=place, cup=np.concatenate(cup),
                 lip=np.concatenate(lip), stride=stride)


def _disc(segments: Segments, at: Int32[np.ndarray, "n 2"], radius_m: float, spacing_m: float, stride: int,
          ) -> Int64[np.ndarray, "n k"]:
    """The pixels of a disc around each spot, wide enough for the skirt where the surface is tilted."""
    rows, cols = segments.parts.shape
    reach = int(np.ceil(SKIRT_RADIUS * 1.3 * radius_m / max(spacing_m, 1e-4) / stride))
    steps = stride * np.arange(-reach, reach + 1)
    i, j = (side.ravel() for side in np.meshgrid(steps, steps, indexing="ij"))
    disc = np.hypot(i, j) <= reach * stride
    i, j = i[disc], j[disc]
    place: Int64[np.ndarray, "n k"] = np.clip(at[:, :1] + i, 0, rows - 1) * cols + np.clip(at[:, 1:] + j, 0, cols - 1)
    return place


def _beneath(segments: Segments, T_bin_spot: Frames, cup: Cup) -> Int32[np.ndarray, "n 2"]:
    """The pixels of parts nearest to where a cup's centre comes to lie; one far from it shows that nothing is there."""
    pixels = np.flatnonzero(segments.parts)
    centres = T_bin_spot[:, :3, 3] + T_bin_spot[:, :3, :2] @ np.array([cup.x_m, -cup.y_m])
    nearest = pixels[cKDTree(segments.xyz.reshape(-1, 3)[pixels]).query(centres)[1]]
    return np.stack(np.divmod(nearest, segments.parts.shape[1]), axis=1).astype(np.int32)


def centred(patch: Patch, T_bin_spot: Frames) -> tuple[Patch, Frames]:
    """Spots moved along their plane to the middle of what the part shows of it there.

    Pixels are as wide as what a narrow face leaves beside the lip; the mean of many points is finer.
    """
    x, y = (patch.local[..., a] - patch.lip[:, a] for a in range(2))
    with np.errstate(invalid="ignore"):
        on_face = patch.own & (np.abs(patch.local[..., 2]) < CENTRING_M) & (patch.radial < SKIRT_RADIUS)
    count = np.maximum(on_face.sum(axis=1), 1)
    shift = np.stack([np.where(on_face, a, np.float32(0)).sum(axis=1) / count for a in (x, y)], axis=-1)
    local = patch.local.copy()
    local[..., :2] -= shift[:, None]
    moved = T_bin_spot.copy()
    moved[:, :3, 3] += np.einsum("nij,nj->ni", T_bin_spot[:, :3, :2], shift.astype(np.float64))
    return replace(patch, local=local), moved


def frames(z: Float64[np.ndarray, "n 3"], hint: Float64[np.ndarray, "n 3"], origin: Float64[np.ndarray, "n 3"]) -> Frames:
    """Frames with z along the given directions and x the part of the hint square to it, as `geometry.frame_of_axes`."""
    z = z / np.linalg.norm(z, axis=1, keepdims=True)
    x = hint - (hint * z).sum(axis=1, keepdims=True) * z
    parallel = np.linalg.norm(x, axis=1) < 1e-9
    x[parallel] = np.cross(z[parallel], np.eye(3)[np.abs(z[parallel]).argmin(axis=1)])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    made = np.tile(np.eye(4), (len(z), 1, 1))
    made[:, :3, 0], made[:, :3, 1], made[:, :3, 2], made[:, :3, 3] = x, np.cross(z, x), z, origin
    return made


def long_axis(points: Float32[np.ndarray, "n 3"]) -> geometry.Vector:
    """The direction of the longest extent of a part, bin frame, sign fixed (first non-zero component positive)."""
    some = points[::max(1, len(points) // 400)].astype(np.float64)
    x, y, z = (some - some.mean(axis=0)).T
    # sums of products by numpy itself: BLAS would wake threads for so little
    xx, yy, zz, xy, xz, yz = ((a * b).sum() for a, b in ((x, x), (y, y), (z, z), (x, y), (x, z), (y, z)))
    _, vectors = np.linalg.eigh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    axis: geometry.Vector = vectors[:, 2]
    return axis if axis[np.flatnonzero(np.abs(axis) > 1e-9)[0]] > 0 else -axis
