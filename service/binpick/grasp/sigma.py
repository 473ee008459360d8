"""How far off a grasp may be: along the approach, across it and in its tilt, each within 1 sigma in about 7 of 10 cases.

What errs together under a lip errs with the surface (how it shines, how it is lit) and does not average out; the rest does,
the faster the more pixels there are. All shares were set on the exam's tuning seeds, both worlds, 95 % within 2 sigma.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int32

from binpick import geometry
from binpick.data import Grasp
from binpick.geometry import Transform
from binpick.rig import Rig
from binpick.settings.tool import Cup

Values = Float64[np.ndarray, "n"]

CORRELATED_PX = 20.0
"""Half-resolution pixels that share one independent error of depth: blocks of the matcher, and what its smoothness adds."""
SHARED = 0.225
"""Of a pixel's sigma, what all of a surface has in common."""
CURVED = 0.74
"""The same on curved surfaces, which come out too far away (glossy ones the most)."""
TILTED = 2.0
"""A plane over a disc tilts by twice its noise over the radius (exactly so for independent noise): over its points' spread."""
STEADY_RAD = np.radians(0.25)
"""Tilt that stays where nothing else errs: a surface's own unevenness."""
EDGE_M = 0.0004
"""How far off the border of what is seen around a lip is, where the lip was centred between borders."""
STEADY_M = 0.00006
"""Across the approach, what stays where nothing else errs: the pixels that a lip is centred by."""
ASLANT = 0.4
"""What a wrong depth moves across the approach, as a share of it: the surface is looked at up to 30° aslant."""
HELD = {"surface": 0.35, "angle_m": 0.0023}
"""Two fingers, along the approach: of the part's mean sigma, and metres per radian of the ends' angle."""
CLOSING = {"surface": 0.2, "angle_m": 0.0055, "border_m": 0.0002}
"""Two fingers, along the closing axis: also how far off the parts' borders are."""
CONTACT_RAD, ANGLE = 0.018, 0.85
"""Two fingers, contacts against the closing axis: what a square end has, and the share of the angle that was measured."""


@dataclass(frozen=True, slots=True, eq=False)
class Sigmas:
    """Of n grasps. `z_m`: along the approach, of the surface where the TCP stands (two fingers: of the part between them).

    `xy_m`: across the approach; two fingers: along the closing axis, of the middle between the contacts. `tilt_rad`: between
    the approach and the surface's normal; two fingers: between the closing axis and the contacts' normals.
    """

    xy_m: Values
    z_m: Values
    tilt_rad: Values


def of_cups(sigma_px_m: Values, rms_m: Values, support: Int32[np.ndarray, "n"], curved: Values, at_edge: Bool[np.ndarray, "n"],
            cups: tuple[Cup, ...]) -> Sigmas:
    """From the mean sigma of the pixels under the lips, what the plane leaves of them (rms), and how many there are.

    `curved`: 0 flat to 1 curved; `at_edge`: the part ends beside a lip. A row of cups tilts about itself as a single one does.
    """
    at = np.array([(cup.x_m, cup.y_m) for cup in cups])
    discs = np.mean([cup.radius_m**2 / 4 for cup in cups]) * np.eye(2)
    radius_m = 2 * float(np.sqrt(np.linalg.eigvalsh(at.T @ at / len(at) + discs)[0]))
    noise_m = np.sqrt((sigma_px_m**2 + rms_m**2) * CORRELATED_PX / np.maximum(support, CORRELATED_PX))
    z_m = np.sqrt(noise_m**2 + (SHARED * sigma_px_m) ** 2 + (CURVED * curved * sigma_px_m) ** 2)
    across_m = np.sqrt(STEADY_M**2 + (ASLANT * z_m) ** 2 + (EDGE_M * np.maximum(at_edge, curved)) ** 2)
    return Sigmas(xy_m=across_m, z_m=z_m,
                  tilt_rad=np.hypot(TILTED * noise_m / radius_m, STEADY_RAD))


def of_fingers(sigma_px_m: Values, angle_rad: Values) -> Sigmas:
    """From the mean sigma of the parts' pixels, and the largest angle between the slices' ends and the closing axis."""
    return Sigmas(
        xy_m=np.sqrt((CLOSING["surface"] * sigma_px_m) ** 2 + (CLOSING["angle_m"] * angle_rad) ** 2 + CLOSING["border_m"] ** 2),
        z_m=np.hypot(HELD["surface"] * sigma_px_m, HELD["angle_m"] * angle_rad),
        tilt_rad=np.hypot(CONTACT_RAD, ANGLE * angle_rad))


def calibrated(grasps: list[Grasp], rig: Rig, T_camera_bin: Transform) -> list[Grasp]:
    """With what the rig file knows of its own errors added in quadrature: for poses in the robot's base.

    Rows that still disagree after rectification stand for what columns disagree by, which is depth and cannot be seen. Without
    `quality` in the file nothing is added, and of the hand-eye transform only what the file says of it.
    """
    quality = rig.quality
    if quality is None or not grasps:
        return grasps
    away_m = geometry.transform(T_camera_bin, np.stack([grasp.T_bin_tcp[:3, 3] for grasp in grasps]))[:, 2]
    baseline_m = float(np.linalg.norm(rig.cameras[1].T_camera_rig[:3, 3]))
    depth_m = away_m**2 * quality.row_error_px / (rig.cameras[0].K_px[0, 0] * baseline_m)
    robot_m, robot_rad = quality.hand_eye_rms_m or 0.0, quality.hand_eye_rms_rad or 0.0
    return [replace(grasp, sigma_xy_m=float(np.linalg.norm([grasp.sigma_xy_m, ASLANT * deep, robot_m])),
                    sigma_z_m=float(np.linalg.norm([grasp.sigma_z_m, deep, robot_m])),
                    sigma_tilt_rad=float(np.hypot(grasp.sigma_tilt_rad, robot_rad)))
            for grasp, deep in zip(grasps, depth_m.tolist(), strict=True)]
