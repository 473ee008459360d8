"""What the camera says of a part that is thought to lie somewhere: measured there, seen through, hidden, or not measured."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from binpick import geometry
from binpick.data import Labels, Rectified, Segments
from binpick.geometry import Transform, Vector
from binpick.grasp.align import Cloud, Normal, Poses
from binpick.grasp.shape import Shape

BEHIND_M = 0.002
"""Further behind a point than this, the camera sees through it; further in front, it is hidden."""
STEP_M = 0.0025
"""What lies further behind the nearest pixel of a segment than this is background."""
DEEP_M = 0.0015
"""What is seen through further inside the background than this is no blur of an edge."""
GRAZING = 0.25
"""Surfaces seen at a smaller cosine than this are not asked for: stereo does not measure them."""


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """Depth in the rectified view at half resolution (NaN: not measured), the parts there, and where the eye is.

    A point at (x, y, z) of frame `rect` shows at pixel `focal_px * (x, y) / z + centre_px`.
    """

    depth: Float32[np.ndarray, "h w"]
    parts: Labels
    T_rect_bin: Transform
    focal_px: float
    centre_px: tuple[float, float]

    @classmethod
    def of(cls, segments: Segments, rectified: Rectified, T_bin_camera: Transform) -> "Sight":
        """The sight of segmented points."""
        T_rect_bin = geometry.inverse(T_bin_camera @ rectified.T_camera_rect)
        depth = geometry.transform(T_rect_bin, segments.xyz)[..., 2]
        view = rectified.window
        # the centre of half-resolution pixel j lies at full-resolution 2 j + 0.5
        centre = ((rectified.cx_px - view.x - 0.5) / 2, (rectified.cy_px - view.y - 0.5) / 2)
        return cls(np.ascontiguousarray(depth), segments.parts, T_rect_bin, rectified.focal_px / 2, centre)

    @property
    def eye(self) -> Vector:
        """Where the camera is, frame `bin`."""
        return geometry.inverse(self.T_rect_bin)[:3, 3]


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """One segment: its points and normals (frame `bin`), and the picture around it.

    `beyond_m` is how far a pixel lies within the background (0: it does not), along the image at the segment's distance, and
    `away` its slope along columns and rows.
    """

    label: int
    cloud: Cloud
    normals: Cloud
    corner: tuple[int, int]
    depth: Float32[np.ndarray, "h w"]
    parts: Labels
    beyond_m: Float32[np.ndarray, "h w"]
    away: Float32[np.ndarray, "h w 2"]


def target(sight: Sight, segments: Segments, label: int, size_m: float) -> Target:
    """The segment of a label and what is around it, as far as a part of that size may reach."""
    rows, cols = np.nonzero(segments.parts == label)
    z = float(np.median(sight.depth[rows, cols]))
    reach = int(np.ceil(size_m * sight.focal_px / z)) + 2
    box = (slice(max(0, int(rows.min()) - reach), int(rows.max()) + reach + 1),
           slice(max(0, int(cols.min()) - reach), int(cols.max()) + reach + 1))
    depth, parts = sight.depth[box], sight.parts[box]
    beyond = _background(depth, parts == label)
    metres = (cv2.distanceTransform(beyond, cv2.DIST_L2, 5) * np.float32(z / sight.focal_px)).astype(np.float32)
    down, right = np.gradient(cv2.GaussianBlur(metres, (0, 0), 1.0) * np.float32(sight.focal_px / z))
    return Target(label, segments.xyz[rows, cols], segments.normal[rows, cols], (box[0].start, box[1].start), depth, parts,
                  metres, np.stack([right, down], axis=-1).astype(np.float32))


def _background(depth: Float32[np.ndarray, "h w"], mine: Bool[np.ndarray, "h w"]) -> np.ndarray:
    """1 where something is measured that lies behind the nearest pixel of the segment."""
    _, nearest = cv2.distanceTransformWithLabels((~mine).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    at = np.zeros(int(nearest.max()) + 1, dtype=np.float32)
    at[nearest[mine]] = depth[mine]
    with np.errstate(invalid="ignore"):
        return np.asarray(~mine & (depth > at[nearest] + STEP_M)).astype(np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """For each hypothesis and point of the shape: its pixel in the target, its depth, and how much of the picture it stands

    for: 0 when the part itself hides it, the cosine of its surface else.
    """

    row: Int64[np.ndarray, "h n"]
    col: Int64[np.ndarray, "h n"]
    z: Float32[np.ndarray, "h n"]
    weight: Float32[np.ndarray, "h n"]


def shown(poses: Poses, shape: Shape, sight: Sight, target: Target, every: int = 1) -> Shown:
    """Where the points of a shape appear, every so many of them."""
    towards = sight.eye.astype(np.float32) - poses.t
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    local = np.einsum("hi,hij->hj", towards, poses.R)
    nearest = (local @ shape.directions.T).argmax(axis=1)
    cosine = local @ shape.normals[::every].T
    weight = np.where(shape.seen[nearest][:, ::every] & (cosine > GRAZING), cosine, np.float32(0))
    R, t = sight.T_rect_bin[:3, :3].astype(np.float32), sight.T_rect_bin[:3, 3].astype(np.float32)
    there = np.matmul(poses.placed(shape.points[::every]), R.T) + t
    pixel = np.rint(there[..., :2] * (np.float32(sight.focal_px) / there[..., 2:])
                    + np.array(sight.centre_px, np.float32) - np.array(target.corner[::-1], np.float32)).astype(np.int64)
    rows, cols = target.depth.shape
    return Shown(np.clip(pixel[..., 1], 0, rows - 1), np.clip(pixel[..., 0], 0, cols - 1), there[..., 2], weight)


def outline(poses: Poses, shape: Shape, sight: Sight, target: Target, every: int) -> Normal:
    """Pulls what the camera sees through back to where the segment is."""
    there = shown(poses, shape, sight, target, every)
    with np.errstate(invalid="ignore"):
        through = target.depth[there.row, there.col] > there.z + BEHIND_M
    beyond = target.beyond_m[there.row, there.col]
    weight = there.weight * through * (beyond > 0)
    slope = target.away[there.row, there.col]
    way = np.matmul(np.matmul(slope, sight.T_rect_bin[:2, :3].astype(np.float32)), poses.R)
    place = np.broadcast_to(shape.points[::every], way.shape)
    return Normal.of(place, way, beyond, weight)


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What speaks for each hypothesis, as shares.

    Of the segment's points: `fits`, those on the part's surface with its normal there. Of what the camera should see of the
    part: `there` it measured it, on this segment; `other` as well, but on another one; `through` it saw something behind,
    `deep` likewise, but away from the segment's edge; `before` this very segment lies in front of it; `hidden` something else
    does; the rest is not measured. Of all of the part: `outside`, what would lie in the bin's floor or walls.
    """

    fits: Float64[np.ndarray, "h"]
    there: Float64[np.ndarray, "h"]
    other: Float64[np.ndarray, "h"]
    through: Float64[np.ndarray, "h"]
    deep: Float64[np.ndarray, "h"]
    before: Float64[np.ndarray, "h"]
    hidden: Float64[np.ndarray, "h"]
    outside: Float64[np.ndarray, "h"]

    @property
    def against(self) -> Float64[np.ndarray, "h"]:
        """What should not be so."""
        return np.asarray(self.through + self.before)

    @property
    def unmeasured(self) -> Float64[np.ndarray, "h"]:
        """What nothing is known of."""
        return np.asarray(np.maximum(1 - self.there - self.other - self.against - self.hidden, 0))


def evidence(poses: Poses, shape: Shape, sight: Sight, target: Target, inside: tuple[Vector, Vector]) -> Evidence:
    """The evidence for hypotheses; `inside` are the lowest and highest corner of the bin's inside."""
    step = max(1, len(target.cloud) // 400)
    cloud, normals = target.cloud[::step], target.normals[::step]
    distance, way = shape.field.at(poses.local(cloud))
    agree = np.einsum("hni,hni->hn", np.matmul(normals[None], poses.R), way)
    fit = (np.abs(distance) < BEHIND_M) & (agree > 0.4)
    spots = shown(poses, shape, sight, target)
    measured, owner = target.depth[spots.row, spots.col], target.parts[spots.row, spots.col]
    total = np.maximum(spots.weight.sum(axis=1), 1e-6)

    def share(which: np.ndarray) -> Float64[np.ndarray, "h"]:
        return np.asarray(((spots.weight * which).sum(axis=1) / total).astype(np.float64))

    with np.errstate(invalid="ignore"):
        off = measured - spots.z
        near, behind, front = np.abs(off) <= BEHIND_M, off > BEHIND_M, off < -BEHIND_M
    mine = owner == target.label
    placed = poses.placed(shape.points)
    low, high = (corner.astype(np.float32) for corner in inside)
    outside = ((placed < low) | (placed > high)).any(axis=2).mean(axis=1)
    deep = behind & (target.beyond_m[spots.row, spots.col] > DEEP_M)
    return Evidence(fits=fit.mean(axis=1).astype(np.float64), there=share(near & mine), other=share(near & ~mine & (owner > 0)),
                    through=share(behind), deep=share(deep), before=share(front & mine), hidden=share(front & ~mine),
                    outside=outside.astype(np.float64))
