"""The places of a board: where it may stand before the rig, by what all cameras see of it at one moment."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from binpick import geometry
from binpick.geometry import Transform
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
    rows = []
    for detection, camera in zip(seen, rig.cameras, strict=False):
        if detection is not None:
            T = camera.T_camera_rig @ T_rig_board
            px = cv2.projectPoints(detection.points_m.astype(np.float64), cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], camera.K_px,
                                   camera.distortion_coefficients)[0][:, 0]
            rows.append(px - detection.corners_px)
    return np.concatenate(rows)


def rms_px(seen: Seen, rig: Rig, T_rig_board: Transform) -> float:
    """Root mean square of the distances of `misplaced_px`."""
    return float(np.sqrt((misplaced_px(seen, rig, T_rig_board)**2).sum(axis=1).mean()))


def moved(T: Transform, by: Float[np.ndarray, "6"]) -> Transform:
    """Turned by a rotation vector about its own origin, and shifted; both in the outer frame."""
    return geometry.make(cv2.Rodrigues(by[:3])[0] @ T[:3, :3], T[:3, 3] + by[3:])


def refined(seen: Seen, rig: Rig, T_rig_board: Transform) -> Transform:
    """The place near a guess where the points of all cameras fit best."""
    step = least_squares(lambda x: misplaced_px(seen, rig, moved(T_rig_board, x)).ravel(), np.zeros(6), method="lm",
                         x_scale=np.array([0.1, 0.1, 0.1, 0.01, 0.01, 0.01])).x
    return moved(T_rig_board, step)


def information(seen: Seen, rig: Rig, T_rig_board: Transform, middle: Float[np.ndarray, "3"]) -> Float[np.ndarray, "6 6"]:
    """How well the images tell the board's turn (about its middle) and way, in the rig's frame: the inverse covariance for
    points that err by 1 px along each axis."""
    to_middle = geometry.make(np.eye(3), middle)
    columns = []
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-5
        both = [misplaced_px(seen, rig, moved(T_rig_board @ to_middle, sign * step) @ geometry.inverse(to_middle)).ravel()
                for sign in (1, -1)]
        columns.append((both[0] - both[1]) / 2e-5)
    slopes = np.column_stack(columns)
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
