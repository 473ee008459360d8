"""Rigid transforms: `T_a_b` maps coordinates in b to a, so `p_a = T_a_b @ p_b` and neighbours must match."""

from typing import TypeAlias

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

Transform: TypeAlias = Float[np.ndarray, "4 4"]
Points: TypeAlias = Float[np.ndarray, "*batch 3"]
Vector: TypeAlias = Float[np.ndarray, "3"]
Quaternion: TypeAlias = Float[np.ndarray, "4"]


def make(R: Float[np.ndarray, "3 3"], t: Vector) -> Transform:
    """The transform of a rotation and a translation in metres."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def inverse(T_a_b: Transform) -> Transform:
    """T_b_a, exactly orthonormal when T_a_b is."""
    R = T_a_b[:3, :3]
    return make(R.T, -R.T @ T_a_b[:3, 3])


def translation(x: float, y: float, z: float) -> Transform:
    """A pure translation in metres."""
    return make(np.eye(3), np.array([x, y, z], dtype=float))


def transform(T_a_b: Transform, points_b: Points) -> Points:
    """Points of frame b in frame a; keeps the points' float width, NaN stays NaN."""
    return _affine(T_a_b[:3], points_b)


def rotate(T_a_b: Transform, vectors_b: Points) -> Points:
    """Directions of frame b in frame a (no translation)."""
    return _affine(T_a_b[:3, :3], vectors_b)


def _affine(matrix: Float[np.ndarray, "3 n"], points: Points) -> Points:
    """One pass by OpenCV: numpy would hand a million tiny products to BLAS, whose threads then wait for each other."""
    if not points.size:
        return points.copy()
    moved: Points = cv2.transform(np.ascontiguousarray(points).reshape(-1, 1, 3), matrix).reshape(points.shape)
    return moved


def from_quaternion(position_m: Vector, quaternion_xyzw: Quaternion) -> Transform:
    """The transform of a position and a quaternion; the quaternion is normalised."""
    return make(Rotation.from_quat(quaternion_xyzw).as_matrix(), np.asarray(position_m, dtype=float))


def quaternion(T_a_b: Transform) -> Quaternion:
    """The rotation as xyzw with w >= 0 (for w = 0 the first non-zero component is positive)."""
    q: Quaternion = Rotation.from_matrix(T_a_b[:3, :3]).as_quat(canonical=True)
    return q


def is_rigid(T: Transform, tolerance: float = 1e-6) -> bool:
    """Finite, right-handed and orthonormal to `tolerance` (1e-6: seven decimal digits in a text file)."""
    if T.shape != (4, 4) or not np.isfinite(T).all() or not np.allclose(T[3], [0, 0, 0, 1], atol=tolerance):
        return False
    R = T[:3, :3]
    return bool(np.allclose(R @ R.T, np.eye(3), atol=tolerance) and np.linalg.det(R) > 0)


def frame_of_axes(z: Vector, x_hint: Vector, origin: Vector) -> Transform:
    """T_a_local with local z along `z` and local x the part of `x_hint` square to it.

    When the hint is (nearly) parallel to z, any square direction is taken, always the same one.
    """
    z = z / np.linalg.norm(z)
    x = x_hint - (x_hint @ z) * z
    if np.linalg.norm(x) < 1e-9:
        x = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
    x = x / np.linalg.norm(x)
    return make(np.column_stack([x, np.cross(z, x), z]), np.asarray(origin, dtype=float))


def hull_planes(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "k 4"]:
    """Outward unit normals n and levels h of planes around the points' convex hull: n · p <= h for each of the points.

    Of sides within about 12° of each other one stands for all, moved out until it holds the points: round shapes have
    thousands, and become a little larger.
    """
    normals = ConvexHull(points).equations[:, :3]
    _, first = np.unique(np.round(5 * normals), axis=0, return_index=True)
    chosen = normals[np.sort(first)]
    return np.column_stack([chosen, (chosen @ points.T).max(axis=1)])


def box_corners(low: Vector, high: Vector) -> Float[np.ndarray, "8 3"]:
    """The eight corners of an axis-parallel box."""
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    return np.array([[(low, high)[i][0], (low, high)[j][1], (low, high)[k][2]]
                     for i in (0, 1) for j in (0, 1) for k in (0, 1)])
