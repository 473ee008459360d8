"""Suction grasps: where a lip of the cup's size lies on one part within its compliance, on measured points only."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from binpick import geometry
from binpick.data import Grasp, Labels, Segments
from binpick.settings import SuctionTool

FIT_RADIUS = 1.1
"""The plane is fitted, and the seal judged, within this many lip radii."""
SKIRT_RADIUS = 1.5
"""Within this many lip radii nothing may stand out of the plane: there the cup's own body comes down."""
STAND_OUT_M = 0.0015
"""What stands out further than this beside the lip keeps the cup from closing."""
SEAL_SHARE = 0.95
"""The measured surface may use this share of the compliance."""
SECTORS = 16
"""The lip is judged in this many sectors; each must show the part."""
POINTS_PER_RADIUS = 6
"""Neighbourhoods are looked at with about this many points along the lip's radius, if there are as many."""
PEAK_M = 0.004
"""Of the spots in a square of this side one is tried."""
LEAST_INSIDE = 0.65
"""Spots nearer to their segment's border than this share of the lip's radius are not tried; tilt shortens distances."""
CENTRING_M = 0.0015
"""What lies this far off the plane says nothing about where the face's middle is."""
CORRELATED_PX = 8.0
"""Half-resolution pixels that share one independent depth error: a matched block of 5x5 full-resolution pixels and the
matcher's smoothness."""
SHARED = 0.72
"""Of a pixel's sigma of depth, what stays under a whole lip: most of the error is the surface's (how it shines, how it is lit),
and does not average out however many pixels there are (tuning seeds, both worlds: 70 % of grasps within, 95 % within twice)."""


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """The points around each of n spots, in the spot's frame (origin there, z along the normal); NaN = not measured.

    Every `stride`-th point of every `stride`-th row is there.
    """

    local: Float32[np.ndarray, "n k 3"]
    own: Bool[np.ndarray, "n k"]
    stride: int


def candidates(segments: Segments, tool: SuctionTool, sigma_z_m: Float32[np.ndarray, "h w"],
               ) -> tuple[list[Grasp], dict[str, int]]:
    """All grasps whose lip seals and whose tilt the tool allows, and how many spots fell out for which reason.

    Qualities are 0 until ranked. The pose's z points into the part, x along the part's longest extent.
    """
    cup = tool.cups[0]
    spacing_m = _spacing(segments)
    spots, narrow = _spots(segments, cup.radius_m, spacing_m)
    reasons = {"spots": len(spots) + narrow, "rim_not_on_one_part": narrow}
    if not len(spots):
        return [], reasons
    patch, T_bin_spot = _centred(*_patches(segments, spots, cup.radius_m, spacing_m), cup.radius_m)
    on_one_part = _sectors(patch, 0.7 * cup.radius_m, 1.15 * cup.radius_m) == SECTORS
    reasons["rim_not_on_one_part"] += int((~on_one_part).sum())
    spots, T_bin_spot = spots[on_one_part], T_bin_spot[on_one_part]
    seal = _seal(Patch(patch.local[on_one_part], patch.own[on_one_part], patch.stride), cup.radius_m)
    limit_m = SEAL_SHARE * tool.compliance_m
    sealed = (np.maximum(seal.deviation_m, seal.bend_m) <= limit_m) & (seal.stand_out_m <= STAND_OUT_M)
    normal = seal.normal_bin(T_bin_spot)
    upright = np.arccos(np.clip(normal[:, 2], -1, 1)) <= tool.max_tilt_rad
    reasons |= {"no_seal": int((~sealed).sum()), "tilt": int((sealed & ~upright).sum())}
    chosen = np.flatnonzero(sealed & upright)
    grasps = _grasps(chosen, segments, spots[chosen], seal, normal[chosen], T_bin_spot[chosen], tool, sigma_z_m)
    reasons["sealed"] = len(grasps)
    return grasps, reasons


def _spacing(segments: Segments) -> float:
    """Median distance of neighbouring points of parts, metres; 1 mm when there are none."""
    parts = segments.parts[::4]
    place = np.nonzero((parts[:, 1:] > 0) & (parts[:, :-1] == parts[:, 1:]))
    rows = segments.xyz[::4]
    steps = rows[place[0], place[1] + 1] - rows[place]
    return float(np.median(np.linalg.norm(steps, axis=1))) if len(steps) else 0.001


def _spots(segments: Segments, radius_m: float, spacing_m: float) -> tuple[Int32[np.ndarray, "n 2"], int]:
    """Pixels (row, column) worth a try: on faces and on parts, where the border is locally farthest away.

    Also how many were left out because the border is too near.
    """
    cell = max(1, round(PEAK_M / spacing_m))
    wide_px = LEAST_INSIDE * radius_m / spacing_m
    kept, narrow = [], 0
    for labels in (segments.faces, segments.parts):
        spots, distance = _peaks(labels, cell)
        usable = np.isfinite(segments.normal[spots[:, 0], spots[:, 1]]).all(axis=1)
        usable &= segments.parts[spots[:, 0], spots[:, 1]] > 0
        narrow += int((usable & (distance < wide_px)).sum())
        kept.append(spots[usable & (distance >= wide_px)])
    return np.unique(np.concatenate(kept), axis=0).astype(np.int32), narrow


def _peaks(labels: Labels, cell: int) -> tuple[Int32[np.ndarray, "n 2"], Float32[np.ndarray, "n"]]:
    """Local maxima of the distance to the segment's border, and that distance, px: at most one in a square cell."""
    inner = labels > 0
    inner[:, 1:] &= labels[:, 1:] == labels[:, :-1]
    inner[1:] &= labels[1:] == labels[:-1]
    distance = cv2.distanceTransform(inner.astype(np.uint8), cv2.DIST_L2, 5)
    highest = cv2.dilate(distance, np.ones((7, 7), dtype=np.uint8))
    found = np.argwhere((distance >= highest) & (distance > 2))
    far = distance[found[:, 0], found[:, 1]]
    columns = labels.shape[1] // cell + 1
    square = found[:, 0] // cell * columns + found[:, 1] // cell
    order = np.lexsort((-far, square))
    _, first = np.unique(square[order], return_index=True)
    chosen = order[first]
    return found[chosen].astype(np.int32), far[chosen]


def _patches(segments: Segments, spots: Int32[np.ndarray, "n 2"], radius_m: float, spacing_m: float,
             ) -> tuple[Patch, Float64[np.ndarray, "n 4 4"]]:
    """The neighbourhood of every spot in its own frame."""
    rows, cols = segments.parts.shape
    stride = max(1, int(radius_m / POINTS_PER_RADIUS / max(spacing_m, 1e-4)))
    reach = int(np.ceil(SKIRT_RADIUS * 1.3 * radius_m / max(spacing_m, 1e-4) / stride))
    steps = stride * np.arange(-reach, reach + 1)
    i, j = (side.ravel() for side in np.meshgrid(steps, steps, indexing="ij"))
    disc = np.hypot(i, j) <= reach * stride
    i, j = i[disc], j[disc]
    place = np.clip(spots[:, :1] + i, 0, rows - 1) * cols + np.clip(spots[:, 1:] + j, 0, cols - 1)
    at = spots[:, 0] * cols + spots[:, 1]
    xyz, normals, parts = segments.xyz.reshape(-1, 3), segments.normal.reshape(-1, 3), segments.parts.ravel()
    origin, normal = xyz[at].astype(np.float64), normals[at].astype(np.float64)
    along = np.where(np.abs(normal[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    T_bin_spot = _frames(normal, along, origin)
    offset = xyz.take(place, axis=0) - origin[:, None].astype(np.float32)
    local = np.matmul(offset, T_bin_spot[:, :3, :3].astype(np.float32))
    return Patch(local=local, own=parts.take(place) == parts[at][:, None], stride=stride), T_bin_spot


def _centred(patch: Patch, T_bin_spot: Float64[np.ndarray, "n 4 4"], radius_m: float,
             ) -> tuple[Patch, Float64[np.ndarray, "n 4 4"]]:
    """Spots moved along their plane to the middle of what the part shows of it there.

    Pixels are as wide as what a narrow face leaves beside the lip; the mean of many points is finer.
    """
    x, y, z = (patch.local[..., a] for a in range(3))
    with np.errstate(invalid="ignore"):
        on_face = patch.own & (np.abs(z) < CENTRING_M) & (x * x + y * y < np.float32((SKIRT_RADIUS * radius_m) ** 2))
    count = np.maximum(on_face.sum(axis=1), 1)
    shift = np.stack([np.where(on_face, a, np.float32(0)).sum(axis=1) / count for a in (x, y)], axis=-1)
    local = patch.local.copy()
    local[..., :2] -= shift[:, None]
    moved = T_bin_spot.copy()
    moved[:, :3, 3] += np.einsum("nij,nj->ni", T_bin_spot[:, :3, :2], shift.astype(np.float64))
    return Patch(local=local, own=patch.own, stride=patch.stride), moved


def _frames(z: Float64[np.ndarray, "n 3"], hint: Float64[np.ndarray, "n 3"], origin: Float64[np.ndarray, "n 3"],
            ) -> Float64[np.ndarray, "n 4 4"]:
    """Frames with z along the given directions and x the part of the hint square to it, as `geometry.frame_of_axes`."""
    z = z / np.linalg.norm(z, axis=1, keepdims=True)
    x = hint - (hint * z).sum(axis=1, keepdims=True) * z
    parallel = np.linalg.norm(x, axis=1) < 1e-9
    x[parallel] = np.cross(z[parallel], np.eye(3)[np.abs(z[parallel]).argmin(axis=1)])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    frames = np.tile(np.eye(4), (len(z), 1, 1))
    frames[:, :3, 0], frames[:, :3, 1], frames[:, :3, 2], frames[:, :3, 3] = x, np.cross(z, x), z, origin
    return frames


@dataclass(frozen=True, slots=True, eq=False)
class Seal:
    """The lip's fit on each spot: plane slopes and level in the spot's frame, and how far the surface leaves it."""

    slope: Float64[np.ndarray, "n 2"]
    level_m: Float64[np.ndarray, "n"]
    centre_m: Float64[np.ndarray, "n"]
    bend_m: Float64[np.ndarray, "n"]
    deviation_m: Float64[np.ndarray, "n"]
    stand_out_m: Float64[np.ndarray, "n"]
    room: Float64[np.ndarray, "n"]
    support: Int32[np.ndarray, "n"]

    def normal_bin(self, T_bin_spot: Float64[np.ndarray, "n 4 4"]) -> Float64[np.ndarray, "n 3"]:
        """Unit normals of the fitted planes in the bin's frame."""
        local = np.concatenate([-self.slope, np.ones((len(self.slope), 1))], axis=1)
        local /= np.linalg.norm(local, axis=1, keepdims=True)
        normals: Float64[np.ndarray, "n 3"] = np.einsum("nac,nc->na", T_bin_spot[:, :3, :3], local)
        return normals


def _seal(patch: Patch, radius_m: float) -> Seal:
    """Least-squares plane of the own points under the lip, and the residuals that matter.

    `deviation_m` is the 90th percentile of the lip zone's residuals: a maximum would be the noise's, not the surface's.
    `bend_m` is how far the lip would have to follow the curvature alone: what a quadratic surface leaves of a plane.
    """
    x, y, z = (patch.local[..., a].astype(np.float64) for a in range(3))
    known = np.isfinite(z)
    x, y, z = (np.where(known, a, 0.0) for a in (x, y, z))
    radius = np.hypot(x, y)
    under = known & patch.own & (radius <= FIT_RADIUS * radius_m) & (np.abs(z) < radius_m)
    slope, level = _fit_planes(x, y, z, under)
    residual = z - level[:, None] - slope[:, :1] * x - slope[:, 1:] * y
    skirt = known & (radius <= SKIRT_RADIUS * radius_m)
    bend = _bend(x / radius_m, y / radius_m, residual, under)
    middle = under & (radius <= 0.4 * radius_m)
    return Seal(
        slope=slope, level_m=level, support=(under.sum(axis=1) * patch.stride**2).astype(np.int32),
        centre_m=np.where(middle, residual, 0).sum(axis=1) / np.maximum(middle.sum(axis=1), 1),
        room=_sectors(patch, 1.15 * radius_m, SKIRT_RADIUS * radius_m) / SECTORS,
        bend_m=bend, deviation_m=_quantile(np.abs(residual), under & (radius >= 0.6 * radius_m), 0.90),
        stand_out_m=_quantile(residual, skirt, 0.98))


def _sectors(patch: Patch, inner_m: float, outer_m: float) -> Int32[np.ndarray, "n"]:
    """In how many sectors of a ring around each spot the part's own points prevail."""
    x, y = patch.local[..., 0], patch.local[..., 1]
    radius = np.hypot(x, y)
    with np.errstate(invalid="ignore"):
        ring = (radius >= inner_m) & (radius <= outer_m)
    sector = np.floor((np.arctan2(y[ring], x[ring]) + np.pi) * (SECTORS / (2 * np.pi))).astype(np.int64) % SECTORS
    bins = SECTORS * np.nonzero(ring)[0] + sector
    own = patch.own[ring]
    mine, others = (np.bincount(bins[whose], minlength=SECTORS * len(x)).reshape(-1, SECTORS) for whose in (own, ~own))
    held: Int32[np.ndarray, "n"] = ((mine >= 2) & (mine >= 3 * others)).sum(axis=1).astype(np.int32)
    return held


def _fit_planes(x: Float64[np.ndarray, "n k"], y: Float64[np.ndarray, "n k"], z: Float64[np.ndarray, "n k"],
                under: Bool[np.ndarray, "n k"]) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, "n"]]:
    """z = level + slope · (x, y) by normal equations; a microscopic ridge (1 µm²) keeps spots without points solvable."""
    solved = _least_squares(np.stack([x, y, np.ones_like(x)], axis=-1), z, under, 1e-12)
    return solved[:, :2], solved[:, 2]


def _least_squares(columns: Float64[np.ndarray, "n k c"], z: Float64[np.ndarray, "n k"], of: Bool[np.ndarray, "n k"],
                   ridge: float) -> Float64[np.ndarray, "n c"]:
    """Coefficients of z in the columns over each row's selected points; the ridge keeps rows with too few solvable."""
    chosen = (columns * of[..., None]).transpose(0, 2, 1)
    normal = chosen @ columns + np.eye(columns.shape[2]) * ridge
    solved: Float64[np.ndarray, "n c"] = np.linalg.solve(normal, chosen @ z[..., None])[..., 0]
    return solved


def _bend(x: Float64[np.ndarray, "n k"], y: Float64[np.ndarray, "n k"], residual: Float64[np.ndarray, "n k"],
          under: Bool[np.ndarray, "n k"]) -> Float64[np.ndarray, "n"]:
    """Amplitude on the lip (radius 1) of the best quadratic's saddle a x² + b x y + c y² about the plane; same unit as z.

    A bowl (a = c, b = 0) costs the lip nothing, it only sits deeper; a cylinder of radius R costs r² / 4R.
    """
    columns = np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)], axis=-1)
    a, b, c = _least_squares(columns, residual, under, 1e-6)[:, :3].T
    amplitude: Float64[np.ndarray, "n"] = np.hypot((a - c) / 2, b / 2)
    return amplitude


def _quantile(values: Float64[np.ndarray, "n k"], of: Bool[np.ndarray, "n k"], share: float) -> Float64[np.ndarray, "n"]:
    """The quantile over each row's selected values; inf where a row has none."""
    ordered = np.sort(np.where(of, values, np.inf), axis=1)
    count = of.sum(axis=1)
    index = np.maximum(np.ceil(share * count).astype(int) - 1, 0)
    picked: Float64[np.ndarray, "n"] = np.take_along_axis(ordered, index[:, None], axis=1)[:, 0]
    return picked


def _long_axis(points: Float32[np.ndarray, "n 3"]) -> geometry.Vector:
    """The direction of the longest extent of a part, bin frame, sign fixed (first non-zero component positive)."""
    some = points[::max(1, len(points) // 400)].astype(np.float64)
    x, y, z = (some - some.mean(axis=0)).T
    # sums of products by numpy itself: BLAS would wake threads for so little
    xx, yy, zz, xy, xz, yz = ((a * b).sum() for a, b in ((x, x), (y, y), (z, z), (x, y), (x, z), (y, z)))
    _, vectors = np.linalg.eigh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    axis: geometry.Vector = vectors[:, 2]
    return axis if axis[np.flatnonzero(np.abs(axis) > 1e-9)[0]] > 0 else -axis


def _grasps(chosen: Int64[np.ndarray, "n"], segments: Segments, spots: Int32[np.ndarray, "n 2"], seal: Seal,
            normal: Float64[np.ndarray, "n 3"], T_bin_spot: Float64[np.ndarray, "n 4 4"], tool: SuctionTool,
            sigma_z_m: Float32[np.ndarray, "h w"]) -> list[Grasp]:
    """The chosen spots as grasps; all but the seal holds the chosen only."""
    part = segments.parts[spots[:, 0], spots[:, 1]]
    labels, whose = np.unique(part, return_inverse=True)
    axes = np.array([_long_axis(segments.part_points[label]) for label in labels.tolist()]).reshape(-1, 3)
    # on a curved part the lip's middle lies on the surface, not on the plane through its rim
    origin = T_bin_spot[:, :3, 3] + T_bin_spot[:, :3, 2] * (seal.level_m + seal.centre_m)[chosen, None]
    T_bin_tcp = _frames(-normal, axes[whose], origin)
    sigma_px_m = sigma_z_m[spots[:, 0], spots[:, 1]].astype(np.float64)
    noise_m = sigma_px_m / np.sqrt(np.maximum(1.0, seal.support[chosen] / CORRELATED_PX))
    radius_m = tool.cups[0].radius_m
    return [
        Grasp(T_bin_tcp=T_bin_tcp[n], tool=tool.number, part_id=label, open_m=0.0, close_m=0.0, quality=0.0,
              seal_m=float(seal.bend_m[i]), room=float(seal.room[i]), sigma_xy_m=float(sigma_px_m[n] / 2),
              sigma_z_m=float(SHARED * sigma_px_m[n]), sigma_tilt_rad=float(2 * noise_m[n] / radius_m))
        for n, (i, label) in enumerate(zip(chosen.tolist(), part.tolist(), strict=True))]
