"""The places of a board: where it may stand before the rig, by what all cameras see of it at one moment."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from binpick import geometry
from binpick.geometry import Transform, Vector
from binpick.rig import Rig
from binpick.rigcheck.board import Board
from binpick.rigcheck.detection import Detection

Seen = Sequence[Detection | None]
"""What each camera of the rig sees, in its order."""
AS_GOOD = 3.0
"""A flat board seen from afar may be tilted either way: a second place counts while it misses by less than so many times as
much as the first."""


def misplaced_px(seen: Seen, rig: Rig, T_rig_board: Transform) -> Float[np.ndarray, "n 2"]:
    """Where the cameras would see the board's points, less where they saw them; one row for each point and camera."""
    return _misplaced(seen, rig, T_rig_board, T_rig_board[:3, 3])[0]


def _misplaced(seen: Seen, rig: Rig, T_rig_board: Transform, about: Vector) -> tuple[Float[np.ndarray, "n 2"],
                                                                                    Float[np.ndarray, "m 6"]]:
    """And the slopes of its numbers over a turn about a point and a way, both in the rig's frame."""
    rows, slopes = [], []
    for detection, camera in zip(seen, rig.cameras, strict=False):
        if detection is not None:
            T = camera.T_camera_rig
            in_rig = detection.points_m.astype(np.float64) @ T_rig_board[:3, :3].T + T_rig_board[:3, 3]
            px, by = cv2.projectPoints(in_rig @ T[:3, :3].T + T[:3, 3], np.zeros(3), np.zeros(3), camera.K_px,
                                       camera.distortion_coefficients)
            rows.append(px[:, 0] - detection.corners_px)
            by_way = by[:, 3:6] @ T[:3, :3]
            slopes.append(np.hstack([np.cross(np.repeat(in_rig - about, 2, axis=0), by_way), by_way]))
    return np.concatenate(rows), np.concatenate(slopes)


def rms_px(seen: Seen, rig: Rig, T_rig_board: Transform) -> float:
    """Root mean square of the distances of `misplaced_px`."""
    return float(np.sqrt((misplaced_px(seen, rig, T_rig_board)**2).sum(axis=1).mean()))


def moved(T: Transform, by: Float[np.ndarray, "6"]) -> Transform:
    """Turned by a rotation vector about its own origin, and shifted; both in the outer frame."""
    return geometry.make(cv2.Rodrigues(by[:3])[0] @ T[:3, :3], T[:3, 3] + by[3:])


def refined(seen: Seen, rig: Rig, T_rig_board: Transform) -> Transform:
    """The place near a guess where the points of all cameras fit best."""
    def residuals(x: Float[np.ndarray, "6"]) -> Float[np.ndarray, "r"]:
        return misplaced_px(seen, rig, moved(T_rig_board, x)).ravel()

    def slopes(x: Float[np.ndarray, "6"]) -> Float[np.ndarray, "r 6"]:
        # a turn vector's slopes are those of a small turn only where it begins: near enough for so small steps
        now = moved(T_rig_board, x)
        return _misplaced(seen, rig, now, now[:3, 3])[1]

    return moved(T_rig_board, least_squares(residuals, np.zeros(6), slopes, method="lm", x_scale="jac").x)


def information(seen: Seen, rig: Rig, T_rig_board: Transform, middle: Vector) -> Float[np.ndarray, "6 6"]:
    """How well the images tell the board's turn (about its middle) and way, in the rig's frame: the inverse covariance for
    points that err by 1 px along each axis."""
    slopes = _misplaced(seen, rig, T_rig_board, geometry.transform(T_rig_board, middle))[1]
    told: Float[np.ndarray, "6 6"] = slopes.T @ slopes
    return told


def places(seen: Seen, rig: Rig) -> list[Transform]:
    """T_rig_board of every place that explains the points, the best first; at least one camera sees the board.

    There are two when the board may be tilted either way; the first camera that sees it tells them. Turns of a board whose ends
    look alike are not among them.
    """
    found: list[tuple[float, Transform]] = []
    for detection, camera in zip(seen, rig.cameras, strict=False):
        if detection is None or found:
            continue
        points, px = detection.points_m.astype(np.float64), detection.corners_px.astype(np.float64)
        _, turns, shifts, _ = cv2.solvePnPGeneric(points, px, camera.K_px, camera.distortion_coefficients,
                                                  flags=cv2.SOLVEPNP_IPPE)
        for r, t in zip(turns, shifts, strict=True):
            T = refined(seen, rig, geometry.inverse(camera.T_camera_rig) @ geometry.make(cv2.Rodrigues(r)[0], t[:, 0]))
            if all(np.abs(T[:3, :3] - other[:3, :3]).max() > 0.01 for _, other in found):
                found.append((rms_px(seen, rig, T), T))
    found.sort(key=lambda each: each[0])
    return [T for rms, T in found if rms <= AS_GOOD * found[0][0]][:2]


def turned(board: Board) -> list[Transform]:
    """T_board_turned of each way in which the board looks the same, the plain one first."""
    points = board.points_m.astype(np.float64)
    ways = [np.eye(4)]
    for ids in board.turns:
        a, b = points - points.mean(0), points[ids] - points[ids].mean(0)
        cos, sin = (a[:, :2] * b[:, :2]).sum(), (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()
        R = cv2.Rodrigues(np.array([0.0, 0.0, np.arctan2(sin, cos)]))[0]
        ways.append(geometry.make(R, points.mean(0) - R @ points.mean(0)))
    return ways
