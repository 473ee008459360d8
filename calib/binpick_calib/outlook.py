"""The outlook: what depth errors to expect of a rig at each distance: from the matching, and from the calibration's doubt."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from binpick import geometry
from binpick_calib import bundle as bundles
from binpick_calib.bundle import Bundle, Lens

MATCHED_PX = 0.1
"""One sigma of a disparity where the parts have texture: 0.05 px in the median of plane faces, 0.1 to 0.2 on round ones."""
PLACES = tuple(tenth / 10 for tenth in range(1, 10))
"""Where in the image the calibration's share is asked for, of width and height."""


@dataclass(frozen=True, slots=True, eq=False)
class Outlook:
    """One sigma of depth at each distance, m: of the matching, and of the calibration in the image's middle and worst place.

    Places that the second camera does not see do not count; NaN: it sees none.
    """

    distance_m: Float[np.ndarray, "n"]
    matching_m: Float[np.ndarray, "n"]
    middle_m: Float[np.ndarray, "n"]
    worst_m: Float[np.ndarray, "n"]

    @property
    def total_m(self) -> Float[np.ndarray, "n"]:
        """Matching and calibration in the middle of the image, in quadrature."""
        return np.asarray(np.hypot(self.matching_m, self.middle_m))


def of(fitted: Bundle, image_size_px: tuple[int, int], distance_m: Float[np.ndarray, "n"]) -> Outlook:
    """Matching: sigma_Z = Z² sigma_d / (f b) (Gallup et al., Variable Baseline/Resolution Stereo, CVPR 2008).

    Calibration: the covariance of all parameters of the first two cameras together, through the slope of the triangulated depth
    (Hartley and Zisserman, Multiple View Geometry, 2003, 5.2): one by one they would be counted several times, for focal
    length, principal point and turn make up for each other.
    """
    assert fitted.covariance is not None
    unknowns = np.concatenate([*(own.values for own in fitted.lenses), *(bundles.pose(T) for T in fitted.T_cam_rig[1:])])
    moving = [*range(24), *range(12 * len(fitted.lenses), 12 * len(fitted.lenses) + 6)]
    deviations = fitted.covariance.deviations(np.eye(len(unknowns)))
    pairs = [_seen(fitted, image_size_px, z) for z in distance_m]
    left, right = (np.concatenate([pair[side] for pair in pairs]) for side in (0, 1))
    slopes = np.zeros((len(left), len(unknowns)))
    for place in moving:
        step = np.zeros(len(unknowns))
        step[place] = 0.1 * deviations[place]
        if step[place]:
            slopes[:, place] = (_depth(unknowns + step, moving, left, right) - _depth(unknowns - step, moving, left, right)
                                ) / (2 * step[place])
    inside = ((right >= 0) & (right < image_size_px)).all(axis=1)
    share = np.where(inside, fitted.covariance.deviations(slopes), np.nan).reshape(len(distance_m), -1)
    baseline_m = np.linalg.norm(fitted.T_cam_rig[1][:3, 3])
    return Outlook(distance_m, np.asarray(distance_m**2 * MATCHED_PX / (fitted.lenses[0].values[0] * baseline_m)),
                   share[:, share.shape[1] // 2], np.fmax.reduce(share, axis=1))


def _seen(fitted: Bundle, image_size_px: tuple[int, int], z: float) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of both cameras that show points at one distance, in the places of the left image."""
    left, right = fitted.lenses[:2]
    px = np.array([(x * image_size_px[0], y * image_size_px[1]) for y in PLACES for x in PLACES])
    points = cv2.convertPointsToHomogeneous(_rays(left, px))[:, 0] * z
    six = bundles.pose(fitted.T_cam_rig[1])
    return px, cv2.projectPoints(points, six[:3], six[3:], right.K, right.distortion)[0][:, 0]


def _rays(lens: Lens, px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    # many steps: the slopes are differences of neighbours
    rays: Float[np.ndarray, "n 2"] = cv2.undistortPointsIter(
        px, lens.K, lens.distortion, None, None, (cv2.TERM_CRITERIA_COUNT, 60, 0))[:, 0]
    return rays


def _depth(unknowns: Float[np.ndarray, "u"], moving: list[int], left_px: Float[np.ndarray, "n 2"],
           right_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
    """Depth along the left axis at which the left rays pass the right ones best."""
    values = unknowns[moving]
    R, t = cv2.Rodrigues(values[24:27])[0], values[27:30]
    left, right = (np.column_stack([_rays(Lens(part), px), np.ones(len(px))])
                   for part, px in ((values[:12], left_px), (values[12:24], right_px)))
    across, along = np.cross(right, left @ R.T), np.cross(right, t)
    return np.asarray(-(across * along).sum(axis=1) / (across**2).sum(axis=1))


def blind_m(fitted: Bundle, distance_m: float, turn_rad: float) -> float:
    """How far depth is off when the second camera turned about its vertical axis, which no row shows: Z² turn / b."""
    centre = geometry.inverse(fitted.T_cam_rig[1])[:3, 3]
    return distance_m**2 * turn_rad / float(np.linalg.norm(centre))
