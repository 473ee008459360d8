"""The adjustment of the loop of robot, rig and board: robot poses and images each weighed by what they err by."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from binpick import geometry
from binpick.geometry import Transform, Vector
from binpick.rigcheck import places
from binpick.rigcheck.board import Board

ROUNDS = 6
"""Of weights and fit in turn; the weights stand after three or four."""
LEAST_RAD, LEAST_M, LEAST_PX = np.radians(0.005), 0.00003, 0.02
"""Nothing errs by less."""
MOST_BY_LEVER = 0.9
"""Of the square of what is left over of the ways, the share that may be laid to turns of the flange."""

Turns = Float[np.ndarray, "n 3 3"]
Ways = Float[np.ndarray, "n 3"]


class Loop(NamedTuple):
    """What is looked for."""

    T_mount_rig: Transform
    T_carrier_board: Transform

    def T_rig_board(self, T_carrier_mount: Transform) -> Transform:
        """Where the robot puts the board."""
        T: Transform = geometry.inverse(T_carrier_mount @ self.T_mount_rig) @ self.T_carrier_board
        return T


class View(NamedTuple):
    """One sample: where the mount stands by the robot, where the board by the images, and how well these tell it.

    `T_mount_flange` is the identity where the rig rides on the flange, else the robot's pose. `information` is that of
    `places`, `rms_px` what is left over of the points at the board's best place.
    """

    name: str
    T_carrier_mount: Transform
    T_mount_flange: Transform
    T_rig_board: Transform
    information: Float[np.ndarray, "6 6"]
    rms_px: float


class Adjusted(NamedTuple):
    """The answer, and the covariance of T_mount_rig: turn about its origin and way, in the mount's frame."""

    loop: Loop
    covariance: Float[np.ndarray, "6 6"]

    def sigma(self, there: Vector) -> tuple[float, float]:
        """One deviation, over all axes together, of the place of a point of the rig's frame, m, and of its turn, rad."""
        x, y, z = geometry.rotate(self.loop.T_mount_rig, there)
        moves = np.hstack([np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]]), np.eye(3)])
        return (float(np.sqrt(np.trace(moves @ self.covariance @ moves.T))), float(np.sqrt(np.trace(self.covariance[:3, :3]))))


def corners(board: Board) -> Float[np.ndarray, "4 3"]:
    """The board's outer points; their middle is its own."""
    return board.points_m.astype(np.float64)[[0, board.columns - 1, -board.columns, -1]]


def apart(views: Sequence[View], found: Loop, middle: Vector) -> Float[np.ndarray, "n 6"]:
    """Turn and way of the board's middle from where it is seen to where the robot puts it, in the rig's frame."""
    seen = np.array([view.T_rig_board for view in views])
    T_carrier_rig = np.array([view.T_carrier_mount for view in views]) @ found.T_mount_rig
    R_rig_carrier = T_carrier_rig[:, :3, :3].transpose(0, 2, 1)
    ahead = geometry.transform(found.T_carrier_board, middle) - T_carrier_rig[:, :3, 3]
    way = np.einsum("nij,nj->ni", R_rig_carrier, ahead) - (seen[:, :3, :3] @ middle + seen[:, :3, 3])
    turn = Rotation.from_matrix(R_rig_carrier @ found.T_carrier_board[:3, :3] @ seen[:, :3, :3].transpose(0, 2, 1)).as_rotvec()
    return np.hstack([turn, way])


def adjusted(views: Sequence[View], start: Loop, board: Board, upright: bool) -> Adjusted:
    """The least squares over the samples' turns and ways, each weighed by how well its images and the robot tell it.

    What a corner errs by is read off the boards' own fits; what all else errs by is what is left over, in turn with the fit.
    To first order that is the fit of every point in every image in which each robot pose may give way by its error; without
    it (tried), a robot off by 5 mm turned the rig by 2 degrees for the sake of pixels. `upright`: the board's height is held.
    """
    middle = corners(board).mean(0)
    free = [i for i in range(12) if not (upright and i == 11)]
    image_px = max(LEAST_PX, float(np.sqrt(np.mean([view.rms_px**2 for view in views]) / 2)))
    blur = image_px**2 * np.linalg.inv(np.array([view.information for view in views]))
    found, covariance = start, np.zeros((6, 6))
    for _ in range(ROUNDS):
        weights = np.linalg.inv(np.linalg.cholesky(blur + _left_over(views, found, blur, middle, len(free))))
        found, covariance = _step(views, found, weights, middle, free)
    return Adjusted(found, covariance)


def _left_over(views: Sequence[View], found: Loop, blur: Float[np.ndarray, "n 6 6"], middle: Vector,
               unknowns: int) -> Float[np.ndarray, "n 6 6"]:
    """Covariances of the boards' turns and ways that the images do not account for: the robot's, the lens's, the board's own.

    A flange that errs in its turn moves a board at arm's length with it. Only as much of the turns is laid to that as the ways
    bear out: without the limit (tried) a robot and a lens of 2 degrees (RCT's set) were fitted 90 mm off, for then large turns
    made ways cost nothing; without the lever the exam's rig on a flange came out half again as far off.
    """
    off = apart(views, found, middle)
    fair = off.size / max(1, off.size - unknowns)
    turn2, way2 = (max(3 * least**2, fair * (off[:, part]**2).sum(1).mean()
                       - np.trace(blur[:, part, part], axis1=1, axis2=2).mean())
                   for part, least in ((slice(3), LEAST_RAD), (slice(3, 6), LEAST_M)))
    T_rig_mount = geometry.inverse(found.T_mount_rig)
    lever = np.array([geometry.transform(view.T_rig_board, middle) - (T_rig_mount @ view.T_mount_flange)[:3, 3]
                      for view in views])
    by_turn = np.zeros((len(views), 6, 3))
    by_turn[:, :3] = np.eye(3)
    by_turn[:, 3:] = np.cross(np.eye(3)[None], lever[:, None]).transpose(0, 2, 1)
    lever2 = 2 * float((lever**2).sum(1).mean())
    robot = min(turn2 / 3, MOST_BY_LEVER * way2 / lever2)
    covariance: Float[np.ndarray, "n 6 6"] = robot * by_turn @ by_turn.transpose(0, 2, 1)
    return covariance + np.diag([turn2 / 3 - robot] * 3 + [(way2 - robot * lever2) / 3] * 3)


def _step(views: Sequence[View], start: Loop, weights: Float[np.ndarray, "n 6 6"], middle: Vector,
          free: Sequence[int]) -> Adjusted:
    def at(x: Float[np.ndarray, "u"]) -> Loop:
        step = np.zeros(12)
        step[list(free)] = x
        return Loop(places.moved(start.T_mount_rig, step[:6]), places.moved(start.T_carrier_board, step[6:]))

    fit = least_squares(lambda x: np.einsum("nij,nj->ni", weights, apart(views, at(x), middle)).ravel(), np.zeros(len(free)),
                        method="lm")
    return Adjusted(at(fit.x), np.linalg.inv(fit.jac.T @ fit.jac)[:6, :6])
