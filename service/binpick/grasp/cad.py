"""The pose of a part whose shape is known: many hypotheses laid onto a segment's points, and what the camera says of each."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64

from binpick import geometry
from binpick.data import PartPose, Segments
from binpick.geometry import Transform, Vector
from binpick.grasp import align, sight
from binpick.grasp.align import Poses
from binpick.grasp.shape import Shape
from binpick.grasp.sight import Evidence, Sight, Target

FIRST, SECOND = 100, 20
"""How many hypotheses the first and the second look leave."""
LEAST_SCORE, LEAST_LEAD, LEAST_FIT = 0.62, 0.12, 0.88
"""What a pose needs: its score, by which share of it it leads the next one, and the share of the points it explains."""
MOST_AGAINST, MOST_DEEP, MOST_UNMEASURED, MOST_OUTSIDE = 0.10, 0.02, 0.20, 0.05
"""What it may have: of what should be seen of the part, what speaks against it, is seen through away from edges, or is not
measured; of all of it, what lies in the floor."""
LEAST_POINTS = 250
"""A smaller segment may be the end of many things."""
RIVAL_M = 0.0015
"""Hypotheses whose surfaces are further apart are different ones."""
MORE_OF_IT = 0.8
"""A segment of which this share lies on a part that was found is more of that part."""
INTO_M = 0.003
"""Parts may go this deep into each other: twice the error of a pose."""


def search(shape: Shape, seen: Sight, segments: Segments, label: int, inside: tuple[Vector, Vector]) -> tuple[Poses, Evidence]:
    """Hypotheses for a segment, with their evidence."""
    target = sight.target(seen, segments, label, shape.size_m)
    poses = _starts(shape, seen, target)
    few = target.cloud[_spread(len(target.cloud), 40)]
    for _ in range(3):
        poses = poses.stepped(align.to_surface(poses, few, shape.field, 0.15 * shape.size_m).solved(shape.size_m / 3, 0.01))
    poses = poses.take(_best(_misfit(poses, shape, target, 40), FIRST))
    few = target.cloud[_spread(len(target.cloud), 80)]
    for reach in (0.1, 0.07, 0.05, 0.05):
        poses = _step(poses, shape, seen, target, few, reach * shape.size_m, 8)
    poses = poses.take(_best(_misfit(poses, shape, target, 80) + _through(poses, shape, seen, target), SECOND))
    few = target.cloud[_spread(len(target.cloud), 160)]
    for reach in (0.004, 0.003, 0.003, 0.002, 0.002, 0.0015, 0.0015, 0.0015):
        poses = _step(poses, shape, seen, target, few, reach, 4)
    return poses, sight.evidence(poses, shape, seen, target, inside)


def _starts(shape: Shape, seen: Sight, target: Target) -> Poses:
    """Every rotation to begin with, what would be seen of it centred on what is seen."""
    R = shape.starts.astype(np.float32)
    middle = target.cloud.mean(axis=0)
    towards = seen.eye.astype(np.float32) - middle
    local = np.einsum("i,hij->hj", towards / np.linalg.norm(towards), R)
    centre = shape.middles[(local @ shape.directions.T).argmax(axis=1)]
    return Poses(R, (middle - np.einsum("hij,hj->hi", R, centre)).astype(np.float32))


def _step(poses: Poses, shape: Shape, seen: Sight, target: Target, cloud: align.Cloud, reach_m: float, every: int) -> Poses:
    """One Gauss-Newton step by points and outline."""
    pulls = align.to_surface(poses, cloud, shape.field, reach_m) + sight.outline(poses, shape, seen, target, every)
    return poses.stepped(pulls.solved(shape.size_m / 3, 0.003))


def _misfit(poses: Poses, shape: Shape, target: Target, count: int) -> Float64[np.ndarray, "h"]:
    """How badly points and normals fit, 0 to 1."""
    which = _spread(len(target.cloud), count)
    distance, way = shape.field.at(poses.local(target.cloud[which]))
    agree = np.einsum("hni,hni->hn", np.matmul(target.normals[which][None], poses.R), way)
    off = np.minimum(np.abs(distance) / np.float32(0.05 * shape.size_m), 1)
    return np.asarray((off + 0.5 * np.clip(1 - agree, 0, 1)).mean(axis=1) / 1.5, dtype=np.float64)


def _through(poses: Poses, shape: Shape, seen: Sight, target: Target) -> Float64[np.ndarray, "h"]:
    """The share of what should be seen that the camera sees through."""
    spots = sight.shown(poses, shape, seen, target, 4)
    with np.errstate(invalid="ignore"):
        behind = target.depth[spots.row, spots.col] > spots.z + 2 * sight.BEHIND_M
    return np.asarray((spots.weight * behind).sum(axis=1) / np.maximum(spots.weight.sum(axis=1), 1e-6), dtype=np.float64)


def _spread(length: int, count: int) -> np.ndarray:
    """At most so many indices, evenly."""
    return np.unique(np.linspace(0, length - 1, min(count, length)).astype(np.int64))


def _best(cost: Float64[np.ndarray, "h"], count: int) -> np.ndarray:
    return np.argsort(np.round(cost, 6), kind="stable")[:count]


def locate(shape: Shape, seen: Sight, segments: Segments, order: Iterable[int], most: int, inside: tuple[Vector, Vector],
           ) -> tuple[PartPose, ...]:
    """What the first `most` segments of an order are, in that order; `inside` are the corners of the bin's inside.

    A segment that lies on the surface of a part found before is more of that part. Of two parts in each other's place only
    the likelier one has a pose.
    """
    found: list[_Found] = []
    for label in order:
        points = segments.part_points[label]
        owner = next((i for i, part in enumerate(found)
                      if part.sure and _share_on(part.pose, points, shape) > MORE_OF_IT), None)
        if owner is not None:
            found[owner] = replace(found[owner], labels=(*found[owner].labels, label))
        elif len(found) < most:
            found.append(_found(shape, seen, segments, label, inside))
    kept = [replace(part, sure=part.sure and not any(_beats(other, part) and _collide(part.pose, other.pose, shape)
                                                     for other in found)) for part in found]
    return tuple(PartPose(part.labels, _canonical(shape, part.pose) if part.sure else None, part.score) for part in kept)


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """The best hypothesis for a segment, and whether it is good enough."""

    labels: tuple[int, ...]
    pose: Poses
    score: float
    sure: bool


def _found(shape: Shape, seen: Sight, segments: Segments, label: int, inside: tuple[Vector, Vector]) -> _Found:
    poses, evidence = search(shape, seen, segments, label, inside)
    scores = score(evidence)
    best = int(np.round(scores, 6).argmax())
    pose = poses.take(np.array([best]))
    rivals = scores[_distance(pose, poses, shape) > RIVAL_M]
    lead = float(scores[best] - rivals.max(initial=0)) / max(float(scores[best]), 1e-9)
    sure = (len(segments.part_points[label]) >= LEAST_POINTS and lead >= LEAST_LEAD and bool(_sound(evidence, scores)[best]))
    return _Found((label,), pose, round(float(scores[best]), 3), sure)


def _sound(evidence: Evidence, scores: Float64[np.ndarray, "h"]) -> Bool[np.ndarray, "h"]:
    """Which hypotheses hold by themselves, rivals aside."""
    e = evidence
    return np.asarray((scores >= LEAST_SCORE) & (e.fits >= LEAST_FIT) & (e.against <= MOST_AGAINST)
                      & (e.deep <= MOST_DEEP) & (e.unmeasured <= MOST_UNMEASURED) & (e.outside <= MOST_OUTSIDE))


def score(evidence: Evidence) -> Float64[np.ndarray, "h"]:
    """How well each hypothesis explains the segment, and the segment it: 0 to 1."""
    e = evidence
    explained = e.there + e.other
    doubt = 2 * e.against + 0.25 * e.unmeasured + 0.5 * e.hidden
    return np.asarray(e.fits * explained / (explained + doubt + 1e-6) * (1 - e.outside) ** 2)


def _distance(one: Poses, others: Poses, shape: Shape) -> Float64[np.ndarray, "h"]:
    """How far the surface of one is from that of the others, mean: parts that look alike where they lie are the same."""
    distance, _ = shape.field.at(others.local(one.placed(shape.points[::6])[0]))
    return np.asarray(np.abs(distance).mean(axis=1), dtype=np.float64)


def _share_on(pose: Poses, points: align.Cloud, shape: Shape) -> float:
    distance, _ = shape.field.at(pose.local(points[_spread(len(points), 200)]))
    return float((np.abs(distance) < sight.BEHIND_M).mean())


def _beats(one: _Found, other: _Found) -> bool:
    return one.sure and (one.score, -one.labels[0]) > (other.score, -other.labels[0])


def _collide(one: Poses, other: Poses, shape: Shape) -> bool:
    """Whether one's surface is inside the other by more than pose errors make it."""
    distance, _ = shape.field.at(other.local(one.placed(shape.points[::3])[0]))
    return float((distance < -INTO_M).mean()) > 0.05


def _canonical(shape: Shape, pose: Poses) -> Transform:
    """T_bin_part in the mesh's frame: of the poses that look alike the least turned one."""
    left, _, right = np.linalg.svd(pose.R[0].astype(np.float64))
    T_bin_centre = geometry.make(shape.symmetry.canonical(left @ right), pose.t[0].astype(np.float64))
    return np.asarray(T_bin_centre @ geometry.translation(*-shape.centre))
