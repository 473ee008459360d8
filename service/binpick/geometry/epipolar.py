"""Two views of one scene: F and E, epipoles and lines, and the step between the cameras that they tell.

Points are pixels of undistorted images; `F` satisfies right^T F left = 0 and `E` the same for rays (x/z, y/z, 1).
"""

from typing import TypeAlias

import cv2
import numpy as np
from jaxtyping import Float

from binpick import geometry
from binpick.errors import InputError

Matrix: TypeAlias = Float[np.ndarray, "3 3"]
Pixels: TypeAlias = Float[np.ndarray, "n 2"]

_DEGENERATE = 1e-9
"""Ratio of the equations' eighth singular value to the first: below, points on a plane or a ruled quadric leave F open."""


def cross(t: geometry.Vector) -> Matrix:
    """The matrix of the cross product: cross(t) @ p = t × p."""
    x, y, z = t
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=float)


def essential(T_right_left: geometry.Transform) -> Matrix:
    """E of a known step between the cameras: cross(t) R."""
    return np.asarray(cross(T_right_left[:3, 3]) @ T_right_left[:3, :3])


def fundamental(E: Matrix, K_left: Matrix, K_right: Matrix) -> Matrix:
    """F of unit norm for cameras whose E is known."""
    F = np.linalg.inv(K_right).T @ E @ np.linalg.inv(K_left)
    return np.asarray(F / np.linalg.norm(F))


def from_fundamental(F: Matrix, K_left: Matrix, K_right: Matrix) -> Matrix:
    """E of cameras whose F was measured: the nearest to K_right^T F K_left with two equal singular values and none beside."""
    u, _, vt = np.linalg.svd(K_right.T @ F @ K_left)
    return np.asarray(u @ np.diag([1.0, 1.0, 0.0]) @ vt)


def eight_point(left_px: Pixels, right_px: Pixels) -> Matrix:
    """F of unit norm and rank two by least squares over eight or more matches, of points scaled to their spread.

    Hartley, In Defense of the Eight-Point Algorithm (1997). Every match counts: outliers are the caller's to remove. Raises
    InputError for fewer than eight matches, and for points that leave F open (all on one plane, or too few apart).
    """
    if len(left_px) != len(right_px) or len(left_px) < 8:
        raise InputError(f"{min(len(left_px), len(right_px))} matches of points; the eight-point method needs eight")
    scale_left, scale_right = _scaling(left_px), _scaling(right_px)
    left, right = _rays(left_px) @ scale_left.T, _rays(right_px) @ scale_right.T
    equations = np.einsum("ni,nj->nij", right, left).reshape(-1, 9)
    _, strengths, vt = np.linalg.svd(np.linalg.qr(equations, mode="r"))     # the same null space, of nine rows
    if strengths[7] < _DEGENERATE * strengths[0]:
        raise InputError("the matches lie on one plane or repeat each other: they do not determine the cameras' step")
    u, values, wt = np.linalg.svd(vt[8].reshape(3, 3))
    F = scale_right.T @ (u @ np.diag([values[0], values[1], 0.0]) @ wt) @ scale_left
    return np.asarray(F / np.linalg.norm(F))


def _rays(points: Pixels) -> Float[np.ndarray, "n 3"]:
    return np.column_stack([points, np.ones(len(points))])


def _scaling(points: Pixels) -> Matrix:
    """Moves the points' middle to 0 and their mean distance from it to the square root of 2."""
    middle = points.mean(0)
    spread = np.linalg.norm(points - middle, axis=1).mean()
    if not spread > 0:
        raise InputError("the matches repeat one point: they do not determine the cameras' step")
    scale = np.sqrt(2) / spread
    return np.array([[scale, 0, -scale * middle[0]], [0, scale, -scale * middle[1]], [0, 0, 1]])


def epipoles(F: Matrix) -> tuple[geometry.Vector, geometry.Vector]:
    """Where each camera's image would show the other: F @ left = 0 and right @ F = 0, of unit norm; 0 last: at infinity."""
    u, _, vt = np.linalg.svd(F)
    return vt[2], u[:, 2]


def lines(F: Matrix, left_px: Pixels) -> Float[np.ndarray, "n 3"]:
    """Lines (a, b, c) of the right image that hold the left points' partners: a x + b y + c = 0 with a² + b² = 1.

    With F.T and right points: those of the left image.
    """
    found = _rays(left_px) @ F.T
    return np.asarray(found / np.linalg.norm(found[:, :2], axis=1, keepdims=True))


def distances(F: Matrix, left_px: Pixels, right_px: Pixels) -> Float[np.ndarray, "n"]:
    """How far each right point lies from the line of its left partner, px; negative on the line's other side."""
    return np.asarray((lines(F, left_px) * _rays(right_px)).sum(1))


def steps(E: Matrix) -> tuple[geometry.Transform, ...]:
    """The four T_right_left that have this E, with translations of length one: E tells neither length nor side."""
    R_one, R_other, t = cv2.decomposeEssentialMat(E)
    return tuple(geometry.make(R, sign * t[:, 0]) for R in (R_one, R_other) for sign in (1.0, -1.0))


def step(E: Matrix, left: Pixels, right: Pixels) -> geometry.Transform:
    """T_right_left, of length one, of the four that has the points in front of both cameras (cheirality).

    `left` and `right` are rays (x/z, y/z). Raises InputError when not even three quarters of the points agree on one.
    """
    candidates = steps(E)
    in_front = [_in_front(T, left, right) for T in candidates]
    best = int(np.argmax(in_front))
    if in_front[best] < 0.75:
        raise InputError(f"only {in_front[best]:.0%} of the matches lie in front of both cameras: "
                         "they are not of one rigid scene")
    return candidates[best]


def _in_front(T_right_left: geometry.Transform, left: Pixels, right: Pixels) -> float:
    """The share of rays that meet in front of both cameras: depths a, b with b * right = a * R left + t, by least squares."""
    turned, right_rays = _rays(left) @ T_right_left[:3, :3].T, _rays(right)
    t = T_right_left[:3, 3]
    aa, ab, bb = (turned**2).sum(1), (turned * right_rays).sum(1), (right_rays**2).sum(1)
    at, bt = turned @ t, right_rays @ t
    # both depths over the same determinant, which is positive: their signs are all that is asked
    return float(np.mean((ab * bt - bb * at > 0) & (aa * bt - ab * at > 0)))
