"""Rectification: the turns after which partners lie in one row, from the epipole, in closed form, and by OpenCV."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from binpick import geometry
from binpick.errors import InputError
from binpick.geometry.epipolar import Matrix

Projection = Float[np.ndarray, "3 4"]


@dataclass(frozen=True, slots=True, eq=False)
class Rectification:
    """`R_left` and `R_right` turn each camera's axes to the common ones; `P_left` and `P_right` project from the left's.

    P_left = K [I 0] and P_right = K [I (−baseline 0 0)] in the rectified left camera's frame.
    """

    R_left: Matrix
    R_right: Matrix
    P_left: Projection
    P_right: Projection

    def homographies(self, K_left: Matrix, K_right: Matrix) -> tuple[Matrix, Matrix]:
        """What maps each undistorted image to its rectified one."""
        return (self.P_left[:, :3] @ self.R_left @ np.linalg.inv(K_left),
                self.P_right[:, :3] @ self.R_right @ np.linalg.inv(K_right))


def from_epipole(T_right_left: geometry.Transform) -> tuple[Matrix, Matrix]:
    """R_left and R_right: x along the baseline, y square to it and to the left optical axis, which turns the least.

    Trucco and Verri, Introductory Techniques for 3-D Computer Vision (1998), 7.3.7. Raises InputError when the baseline lies
    along the optical axis: the epipole is then in the image, and no turn makes rows of its lines.
    """
    R, t = T_right_left[:3, :3], T_right_left[:3, 3]
    centre = -R.T @ t    # of the right camera, in the left one's frame: the direction of the left epipole
    across = np.hypot(centre[0], centre[1])
    if not across > 1e-9 * max(1.0, abs(centre[2])):
        raise InputError("the cameras stand behind each other: such a pair cannot be rectified")
    x = centre / np.linalg.norm(centre)
    y = np.array([-centre[1], centre[0], 0.0]) / across
    R_left = np.stack([x, y, np.cross(x, y)])
    return R_left, R_left @ R.T


def fusiello(K_left: Matrix, K_right: Matrix, T_right_left: geometry.Transform) -> Rectification:
    """In closed form from the two projections: y square to the baseline and to the left camera's old axis, K their mean.

    Fusiello, Trucco and Verri, A compact algorithm for rectification of stereo pairs (2000). Raises InputError as
    `from_epipole`.
    """
    R_left, R_right = from_epipole(T_right_left)
    K = (K_left + K_right) / 2
    K[0, 1] = 0.0
    return _of(K, R_left, R_right, T_right_left)


def opencv(K_left: Matrix, K_right: Matrix, T_right_left: geometry.Transform, image_size_px: tuple[int, int]) -> Rectification:
    """OpenCV's way (after Bouguet): each camera takes half of the turn between them, so that both images lose alike."""
    R_left, R_right, P_left, P_right, *_ = cv2.stereoRectify(
        K_left, None, K_right, None, image_size_px, T_right_left[:3, :3], T_right_left[:3, 3], flags=cv2.CALIB_ZERO_DISPARITY,
        alpha=-1)
    return Rectification(R_left, R_right, P_left, P_right)


def _of(K: Matrix, R_left: Matrix, R_right: Matrix, T_right_left: geometry.Transform) -> Rectification:
    baseline = float(np.linalg.norm(T_right_left[:3, 3]))
    P_left, P_right = (K @ np.column_stack([np.eye(3), [-along, 0.0, 0.0]]) for along in (0.0, baseline))
    return Rectification(R_left, R_right, P_left, P_right)
