"""Gauss-Newton on a distance field, for many rigid hypotheses at once."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64
from scipy.spatial.transform import Rotation

from binpick.grasp.field import Field

Cloud = Float32[np.ndarray, "n 3"]
Rotations = Float32[np.ndarray, "h 3 3"]
Steps = Float64[np.ndarray, "h 6"]


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Hypotheses: where the part's centre is, and how it is turned; `p = R q + t` for a point q of the part."""

    R: Rotations
    t: Float32[np.ndarray, "h 3"]

    def __len__(self) -> int:
        return len(self.t)

    def take(self, which: np.ndarray) -> "Poses":
        """Some of them."""
        return Poses(self.R[which], self.t[which])

    def local(self, points: Cloud) -> Float32[np.ndarray, "h n 3"]:
        """Points of the scene, in the frame of each hypothesis' part."""
        return np.asarray(np.matmul(points[None] - self.t[:, None], self.R))

    def placed(self, points: Cloud) -> Float32[np.ndarray, "h n 3"]:
        """Points of the part, in the scene."""
        return np.asarray(np.matmul(points[None], self.R.transpose(0, 2, 1)) + self.t[:, None])

    def stepped(self, steps: Steps) -> "Poses":
        """Each turned and moved in its own frame: T exp(step), step = rotation vector, translation."""
        R = np.matmul(self.R.astype(np.float64), Rotation.from_rotvec(steps[:, :3]).as_matrix())
        t = self.t + np.einsum("hij,hj->hi", self.R, steps[:, 3:])
        return Poses(R.astype(np.float32), t.astype(np.float32))


@dataclass(frozen=True, slots=True, eq=False)
class Normal:
    """The normal equations of residuals whose gradient in the part's frame is `way` at `place`."""

    left: Float64[np.ndarray, "h 6 6"]
    right: Steps

    @classmethod
    def of(cls, place: np.ndarray, way: np.ndarray, residual: np.ndarray, weight: np.ndarray) -> "Normal":
        """For residuals r(q + w x q + v) = r + way . (w x q + v)."""
        rows = np.concatenate([np.cross(place, way), way], axis=2)
        weighted = rows * weight[..., None]
        left = np.matmul(weighted.transpose(0, 2, 1), rows)
        return cls(left.astype(np.float64), -np.einsum("hni,hn->hi", weighted, residual).astype(np.float64))

    def __add__(self, other: "Normal") -> "Normal":
        return Normal(self.left + other.left, self.right + other.right)

    def solved(self, arm_m: float, damping: float) -> Steps:
        """The steps, at most 0.5 rad and half an arm; `arm_m` makes turns and shifts of one size."""
        scale = np.array([arm_m] * 3 + [1.0] * 3)
        left = self.left / np.outer(scale, scale)
        level = np.trace(left, axis1=1, axis2=2)[:, None, None] / 6 + 1e-9
        step = np.linalg.solve(left + damping * level * np.eye(6), (self.right / scale)[..., None])[..., 0]
        length = np.linalg.norm(step, axis=1, keepdims=True)
        return np.asarray(step * np.minimum(1, 0.5 * arm_m / np.maximum(length, 1e-12)) / scale)


def to_surface(poses: Poses, cloud: Cloud, field: Field, reach_m: float) -> Normal:
    """Pulls the part's surface onto measured points; those further than `reach_m` pull less and less (Geman-McClure)."""
    local = poses.local(cloud)
    distance, way = field.at(local)
    weight = 1 / (1 + (distance / np.float32(reach_m)) ** 2) ** 2
    # the part moves: a point q of the scene goes the other way in its frame
    return Normal.of(local, -way, distance, weight)


def rotations(points: Cloud, field: Field, starts: Float64[np.ndarray, "h 3 3"], rounds: int) -> Float64[np.ndarray, "h 3 3"]:
    """From each start the rotation about the field's origin that lays the part's own points onto its own surface."""
    poses = Poses(starts.astype(np.float32).transpose(0, 2, 1), np.zeros((len(starts), 3), dtype=np.float32))
    arm_m = float(np.linalg.norm(points, axis=1).mean())
    for _ in range(rounds):
        steps = to_surface(poses, points, field, 0.3 * arm_m).solved(arm_m, 0.05)
        steps[:, 3:] = 0
        poses = poses.stepped(steps)
    return poses.R.astype(np.float64).transpose(0, 2, 1)
