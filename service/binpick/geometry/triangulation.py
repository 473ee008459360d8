"""Triangulation: the point that two cameras see, from their projections, or from the angles of a verged pair."""

import cv2
import numpy as np
from jaxtyping import Float

from binpick.geometry.epipolar import Pixels


def triangulate(P_left: Float[np.ndarray, "3 4"], P_right: Float[np.ndarray, "3 4"], left_px: Pixels,
                right_px: Pixels) -> Float[np.ndarray, "n 3"]:
    """Points in the frame that both projections start from, by linear least squares; NaN where the rays are parallel."""
    points: Float[np.ndarray, "4 n"] = cv2.triangulatePoints(P_left, P_right, np.ascontiguousarray(left_px.T, dtype=float),
                                                             np.ascontiguousarray(right_px.T, dtype=float))
    scale = np.where(np.abs(points[3]) > 1e-12 * np.linalg.norm(points, axis=0), points[3], np.nan)
    return np.asarray((points[:3] / scale).T)


def verged(left: Pixels, right: Pixels, baseline_m: float, yaw_left: float, yaw_right: float) -> Float[np.ndarray, "n 3"]:
    """Points seen by two cameras in one plane that are turned about y alone, in the unturned left camera's frame, metres.

    `left` and `right` are rays (x/z, y/z) in each camera; a yaw is positive towards +x, so that a pair that looks inward has
    yaw_left > 0 > yaw_right. With the angle of each ray to the baseline's normal, z = baseline / (tan left − tan right);
    without yaw that is the parallel pair's f b / d. NaN where the rays do not meet in front.
    """
    tan_left, tan_right = (np.tan(yaw + np.arctan(rays[:, 0])) for yaw, rays in ((yaw_left, left), (yaw_right, right)))
    apart = tan_left - tan_right
    z = baseline_m / np.where(apart > 1e-12, apart, np.nan)
    x = z * tan_left
    return np.column_stack([x, left[:, 1] * (x * np.sin(yaw_left) + z * np.cos(yaw_left)), z])
