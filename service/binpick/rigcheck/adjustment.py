"""The adjustment of the loop of robot, rig and board: robot poses and images each weighed by what they err by."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from binpick import geometry
from binpick.geometry import Transform
from binpick.rigcheck import loop, places
from binpick.rigcheck.board import Board

ROUNDS = 6
"""Of weights and fit in turn; the weights stand after three or four."""
LEAST_RAD, LEAST_M, LEAST_PX = np.radians(0.005), 0.00003, 0.02
"""Nothing errs by less."""


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


class Errors(NamedTuple):
    """One deviation of the robot's poses, along and about each axis."""

    m: float
    rad: float


def corners(board: Board) -> Float[np.ndarray, "4 3"]:
    """The board's outer points; their middle is its own."""
    return board.points_m.astype(np.float64)[[0, board.columns - 1, -board.columns, -1]]


def apart(view: View, expected: Transform, middle: Float[np.ndarray, "3"]) -> Float[np.ndarray, "6"]:
    """Turn and way of the board's middle from where it is seen to where it is expected, in the rig's frame."""
    way = geometry.transform(expected, middle) - geometry.transform(view.T_rig_board, middle)
    return np.concatenate([loop.turn(expected[:3, :3] @ view.T_rig_board[:3, :3].T), way])


def adjusted(views: Sequence[View], start: Loop, board: Board, upright: bool) -> Loop:
    """The least squares over the samples' turns and ways, each weighed by how well its images and the robot tell it.

    What a corner errs by is read off the boards' own fits; what the robot errs by is what is left over, in turn with the fit.
    To first order that is the fit of every point in every image in which each robot pose may give way by its error; without
    it (tried), a robot off by 5 mm turned the rig by 2 degrees for the sake of pixels. `upright`: the board's height is held.
    """
    middle = corners(board).mean(0)
    free = [i for i in range(12) if not (upright and i == 11)]
    image_px = max(LEAST_PX, float(np.sqrt(np.mean([view.rms_px**2 for view in views]) / 2)))
    blur = [image_px**2 * np.linalg.inv(view.information) for view in views]
    found = start
    for _ in range(ROUNDS):
        errors = _errors(views, found, blur, middle, len(free))
        weights = [np.linalg.inv(np.linalg.cholesky(b + _robot(view, found, errors, middle)))
                   for view, b in zip(views, blur, strict=True)]
        found = _step(views, found, weights, middle, free)
    return found


def _errors(views: Sequence[View], found: Loop, blur: Sequence[Float[np.ndarray, "6 6"]], middle: Float[np.ndarray, "3"],
            unknowns: int) -> Errors:
    """The robot's, by moments: what is left over, less the images' share, and of the ways less the turns' by their lever."""
    off = np.array([apart(view, found.T_rig_board(view.T_carrier_mount), middle) for view in views])
    fair = off.size / max(1, off.size - unknowns)
    turn2 = fair * (off[:, :3]**2).sum(1).mean() - np.mean([np.trace(b[:3, :3]) for b in blur])
    robot_rad = float(np.sqrt(max(LEAST_RAD**2, turn2 / 3)))
    lever2 = np.mean([2 * (_lever(view, found, middle)**2).sum() for view in views]) * robot_rad**2
    way2 = fair * (off[:, 3:]**2).sum(1).mean() - np.mean([np.trace(b[3:, 3:]) for b in blur]) - lever2
    return Errors(float(np.sqrt(max(LEAST_M**2, way2 / 3))), robot_rad)


def _lever(view: View, found: Loop, middle: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """From the flange to the board's middle, in the rig's frame."""
    flange = geometry.inverse(found.T_mount_rig) @ view.T_mount_flange
    lever: Float[np.ndarray, "3"] = geometry.transform(view.T_rig_board, middle) - flange[:3, 3]
    return lever


def _robot(view: View, found: Loop, errors: Errors, middle: Float[np.ndarray, "3"]) -> Float[np.ndarray, "6 6"]:
    """What the robot's errors make of a board's turn and way: it turns about the flange."""
    x, y, z = _lever(view, found, middle)
    by_turn = np.vstack([np.eye(3), np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])])
    covariance: Float[np.ndarray, "6 6"] = errors.rad**2 * by_turn @ by_turn.T
    covariance[3:, 3:] += errors.m**2 * np.eye(3)
    return covariance


def _step(views: Sequence[View], start: Loop, weights: Sequence[Float[np.ndarray, "6 6"]], middle: Float[np.ndarray, "3"],
          free: Sequence[int]) -> Loop:
    def at(x: Float[np.ndarray, "u"]) -> Loop:
        step = np.zeros(12)
        step[list(free)] = x
        return Loop(places.moved(start.T_mount_rig, step[:6]), places.moved(start.T_carrier_board, step[6:]))

    def residuals(x: Float[np.ndarray, "u"]) -> Float[np.ndarray, "r"]:
        now = at(x)
        return np.concatenate([w @ apart(view, now.T_rig_board(view.T_carrier_mount), middle)
                               for view, w in zip(views, weights, strict=True)])

    return at(least_squares(residuals, np.zeros(len(free)), method="lm").x)
