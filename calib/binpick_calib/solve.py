"""The solution: both cameras and the step between them, from the board's corners in many views."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from binpick import geometry
from binpick.errors import InputError
from binpick.rig import Quality, Rig, RigCamera
from binpick_calib.board import Board
from binpick_calib.views import Views

REFINE = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-9)


@dataclass(frozen=True, slots=True)
class Solution:
    """The rig, and how each view fits it: number of the view -> residual rms of the left and of the right image, px."""

    rig: Rig
    quality: Quality
    per_view_px: dict[int, tuple[float, float]]


def solve(views: Views, board: Board, created: str) -> Solution:
    """Each camera alone first, then both and the step between them together (Zhang's method, five distortion terms).

    Raises InputError when the views do not determine the cameras.
    """
    size, points = views.image_size_px, [board.points_m] * len(views.used)
    left, right = [v.left_px for v in views.used], [v.right_px for v in views.used]
    try:
        _, K_left, d_left, _, _ = cv2.calibrateCamera(points, left, size, None, None)
        _, K_right, d_right, _, _ = cv2.calibrateCamera(points, right, size, None, None)
        rms_px, K_left, d_left, K_right, d_right, R, t, _, _, _, _, residuals = cv2.stereoCalibrateExtended(
            points, left, right, K_left, d_left, K_right, d_right, size, np.eye(3), np.zeros((3, 1)),
            flags=cv2.CALIB_USE_INTRINSIC_GUESS, criteria=REFINE)
        row_error_px = _row_error_px(views, K_left, d_left, K_right, d_right, R, t)
    except cv2.error as error:
        raise InputError(f"the views do not determine the cameras: tilt the board more ({error.err})") from error
    if not np.isfinite([rms_px, row_error_px]).all():
        raise InputError("the views do not determine the cameras: tilt the board more, and fill the image with it")
    per_view_px = {v.number: (float(a), float(b)) for v, (a, b) in zip(views.used, residuals, strict=True)}
    quality = Quality(rms_px=float(rms_px), row_error_px=row_error_px, rejected=views.rejected, per_view_px={
        str(number): float(np.hypot(a, b) / np.sqrt(2)) for number, (a, b) in per_view_px.items()})
    rig = Rig(
        image_size_px=size,
        cameras=(_camera("left", K_left, d_left, np.eye(4)), _camera("right", K_right, d_right, geometry.make(R, t[:, 0]))),
        quality=quality, board=str(board), created=created)
    return Solution(rig, quality, per_view_px)


def _row_error_px(views: Views, K_left: Float[np.ndarray, "3 3"], d_left: Float[np.ndarray, "1 n"],
                  K_right: Float[np.ndarray, "3 3"], d_right: Float[np.ndarray, "1 n"],
                  R: Float[np.ndarray, "3 3"], t: Float[np.ndarray, "3 1"]) -> float:
    """Median row difference of a corner after rectification: what the matcher will suffer from."""
    R_left, R_right, P_left, P_right, *_ = cv2.stereoRectify(K_left, d_left, K_right, d_right, views.image_size_px, R, t)
    left = cv2.undistortPoints(np.concatenate([v.left_px for v in views.used]), K_left, d_left, R=R_left, P=P_left)
    right = cv2.undistortPoints(np.concatenate([v.right_px for v in views.used]), K_right, d_right, R=R_right, P=P_right)
    return float(np.median(np.abs(left[:, 0, 1] - right[:, 0, 1])))


def _camera(name: str, K: Float[np.ndarray, "3 3"], distortion: Float[np.ndarray, "1 n"],
            T_cam_rig: geometry.Transform) -> RigCamera:
    return RigCamera.model_validate({"name": name, "K": K.tolist(), "distortion": distortion.ravel().tolist(),
                                     "T_cam_rig": T_cam_rig.tolist()})
