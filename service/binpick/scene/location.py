"""Where the bin really stands: looked for near where it is expected, and refused unless it is the bin of the model."""

from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from binpick import geometry
from binpick.data import Cloud
from binpick.errors import Code
from binpick.geometry import Transform, Vector
from binpick.scene.rim import Points, Rim, Seen, Shares
from binpick.settings import Bin

SHIFT_M, HEIGHT_M, YAW_RAD, TILT_RAD = 0.030, 0.010, np.radians(10.0), np.radians(3.0)
"""How far a bin may stand from where it is expected: along both of its sides, up or down, about z, and about x and y."""
SLACK = 1.18
"""What is refused lies this much beyond: 30 mm along both sides turned by 10° are 35 mm along one."""
BAND_M = 0.040
"""Points this far above or below the expected rim may show it: a tilted bin's is 30 mm off in a corner."""
ROW_STEP, COLUMN_STEP = 3, 2
"""One pixel in so many: a rim of 3 mm is still seen twice across at 2 px per mm."""
WELL_SEEN, LEAST_SEEN = 0.50, 0.10
"""Two sides at least must be seen so well for anything to be found, and each so well that it is known to be there."""
MOST_PASSED = 0.15
"""A side is not there if its content goes on beyond it along more than this share of what is seen of it."""
SIDES = ("-x", "+x", "-y", "+y")
FLOOR_WITHIN_M = 0.005
"""A floor further from the model's is another bin's."""
FLOOR_SHARE, FLOOR_GLIMPSE = 0.15, 0.01
"""Shares of what is seen inside: that make a plane, and that prove a floor between parts."""
FLOOR_STEP, FLOOR_POINTS = 16, 300
"""One point in so many tells the floor, and so many are needed."""
FLOOR_MARGIN_M = 0.008
"""Points this near a wall do not tell the floor."""


@dataclass(frozen=True, slots=True, eq=False)
class Location:
    """A bin as located, and how good the evidence is.

    `fault` is None when this is the bin of the model, within the tolerances; else `message` says what is wrong.
    """

    T_expected_bin: Transform
    seen: Seen
    fault: Code | None = None
    message: str = ""

    @property
    def yaw_rad(self) -> float:
        """Turned about z from where it is expected."""
        return float(np.arctan2(self.T_expected_bin[1, 0], self.T_expected_bin[0, 0]))

    @property
    def tilt_rad(self) -> float:
        """Angle between its z axis and the expected one."""
        return float(np.arccos(np.clip(self.T_expected_bin[2, 2], -1, 1)))


def tolerated_box(low: Vector, high: Vector) -> tuple[Vector, Vector]:
    """The box, in the expected bin's frame, that holds a box of the bin's own frame wherever the bin may stand."""
    corners = geometry.box_corners(low, high)
    turned = []
    for yaw, about_x, about_y in product((-YAW_RAD, 0.0, YAW_RAD), (-TILT_RAD, TILT_RAD), (-TILT_RAD, TILT_RAD)):
        R = Rotation.from_euler("z", yaw) * Rotation.from_rotvec([about_x, about_y, 0.0])
        turned.append(geometry.rotate(geometry.make(R.as_matrix(), np.zeros(3)), corners))
    shift = np.array([SHIFT_M, SHIFT_M, HEIGHT_M])
    return np.min(turned, axis=(0, 1)) - shift, np.max(turned, axis=(0, 1)) + shift


def locate(xyz_camera: Cloud, model: Bin, T_camera_expected: Transform) -> Location:
    """Finds the bin in a cloud (frame `camera`, NaN = not measured) near its expected pose."""
    T_expected_camera = geometry.inverse(T_camera_expected)
    cloud = np.ascontiguousarray(xyz_camera[::ROW_STEP, ::COLUMN_STEP]).reshape(-1, 3)
    height = cv2.transform(cloud.reshape(-1, 1, 3), T_expected_camera[2:3]).ravel()
    points = geometry.transform(T_expected_camera, cloud[np.abs(height - np.float32(model.inner_size_m[2])) < BAND_M])
    rim = Rim.of(model, T_expected_camera[:3, 3])
    best = Location(np.eye(4), Seen(np.zeros(4), np.zeros(4), 0.0))
    for start in rim.starts(points, SHIFT_M, YAW_RAD):
        T_expected_bin = rim.fit(points, start)
        found = Location(T_expected_bin, rim.seen(points, T_expected_bin))
        if found.seen.there.sum() > best.seen.there.sum():
            best = found
        if found.seen.there.min() >= LEAST_SEEN and not (found.seen.passed > MOST_PASSED * found.seen.there).any():
            break
    T_bin_camera = geometry.inverse(best.T_expected_bin) @ T_expected_camera
    fault, message = _fault(best) or _floor_fault(cloud[::FLOOR_STEP], model, T_bin_camera) or (None, "")
    return replace(best, fault=fault, message=message)


def _fault(found: Location) -> tuple[Code, str] | None:
    """What speaks against the bin of the model standing there, within the tolerances."""
    there, passed = found.seen.there, found.seen.passed
    if (there >= WELL_SEEN).sum() < 2:
        return Code.BIN_NOT_FOUND, f"No rim was seen where the bin is expected: {_told(there)}."
    if there.min() < LEAST_SEEN:
        return Code.BIN_MISMATCH, f"The rim is not where the bin's model has it: {_told(there)}."
    if (passed > MOST_PASSED * there).any():
        return Code.BIN_MISMATCH, ("Things as high as the rim go on beyond it: the bin is larger than its model, or something "
                                   f"stands against it: {_told(passed)}.")
    if found.tilt_rad > SLACK * np.sqrt(2) * TILT_RAD:
        return Code.BIN_MISMATCH, f"The bin is tilted by {np.degrees(found.tilt_rad):.1f} degrees."
    x, y, z = found.T_expected_bin[:3, 3]
    if (max(abs(x), abs(y)) > SLACK * SHIFT_M or abs(z) > HEIGHT_M + np.sqrt(2) * SHIFT_M * TILT_RAD
            or abs(found.yaw_rad) > SLACK * YAW_RAD):
        mm, degrees = [round(1000 * shift) for shift in (x, y, z)], round(np.degrees(found.yaw_rad))
        return Code.BIN_NOT_FOUND, (f"The bin stands too far from where it is expected: by {mm[0]}, {mm[1]} and {mm[2]} mm, "
                                    f"turned by {degrees} degrees.")
    return None


def _told(shares: Shares) -> str:
    return ", ".join(f"{100 * share:.0f} % at {side}" for side, share in zip(SIDES, shares, strict=True))


def _floor_fault(xyz_camera: Points, model: Bin, T_bin_camera: Transform) -> tuple[Code, str] | None:
    """Whether the lowest plane that was seen cannot be the model's floor; a floor hidden by parts tells nothing.

    Flat parts side by side are such a plane too, but between them something of the floor is seen.
    """
    length, width, height = model.inner_size_m
    q = geometry.transform(T_bin_camera, xyz_camera)
    inside = (np.abs(q[:, 0]) < length / 2 - FLOOR_MARGIN_M) & (np.abs(q[:, 1]) < width / 2 - FLOOR_MARGIN_M)
    z = q[inside, 2]
    if len(z) < FLOOR_POINTS:
        return None
    edges = np.arange(-height / 4, height / 4, FLOOR_WITHIN_M / 2)
    shares = np.convolve(np.histogram(z, edges)[0], [1, 1], "valid") / len(z)
    planes = np.flatnonzero(shares > FLOOR_SHARE)
    if not len(planes):
        return None
    level = float(np.median(z[np.abs(z - edges[planes[0] + 1]) < FLOOR_WITHIN_M]))
    glimpsed = float(np.mean(np.abs(z) < FLOOR_WITHIN_M)) > FLOOR_GLIMPSE
    if -FLOOR_WITHIN_M <= level <= FLOOR_WITHIN_M or (level > 0 and glimpsed):
        return None
    return Code.BIN_MISMATCH, (f"The bin's floor lies {1000 * (height - level):.0f} mm below its rim, the model's "
                               f"{1000 * height:.0f} mm.")
