"""Marks: tags fixed to the cell, whose places tell a bumped mount and a turned camera, also where rows stay as they were."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import cv2
import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from binpick import geometry
from binpick.errors import InputError
from binpick.geometry import Transform, triangulation
from binpick.rig import Rig
from binpick.rigcheck import sighting
from binpick.rigcheck.correction import T_second_rig, axes
from binpick.rigcheck.sighting import Corners

Sighting: TypeAlias = tuple[Mapping[int, Corners], Mapping[int, Corners]]
"""What the rig's first two cameras see of the marks in one cycle."""
Triple: TypeAlias = tuple[float, float, float]
Points: TypeAlias = Float[np.ndarray, "n 3"]
Pixels: TypeAlias = Float[np.ndarray, "n 2"]
FEWEST = 3
LOOSE_PX = 0.5
"""Corners further off count less and less: a mark may be half hidden, or have been moved."""
ROUNDS = 2
NEARLY_SQUARE = 0.03
"""A tag whose sides differ by more than this share is half hidden."""

detect = sighting.detect


class Reference(BaseModel):
    """The marks as they were seen at commissioning: the corners of each in the rig's frame, metres. Saved as JSON."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    format: Literal["binpick-marks"] = "binpick-marks"
    version: Literal[1] = 1
    family: str
    marks: dict[int, tuple[Triple, Triple, Triple, Triple]] = Field(min_length=FEWEST)
    rig_sha256: str


@dataclass(frozen=True, slots=True)
class MarksCheck:
    """What the marks say of the rig now, against the reference; NaN with a `reason` where too few are seen.

    `shift_m` is how far the mount has moved, in the rig's frame and as seen in the marks' middle, where its turn moves it
    too: so far a thing there is off, the other way. `turn_rad` is the mount's turn (a rotation vector). `rotation_rad`:
    (pitch, yaw, roll) of the right camera against the rig file, as in `rows.Rows`; `depth_m` is what these make a depth in the
    marks' middle err by. The sigmas are of one such check.
    """

    marks: int = 0
    shift_m: Triple = (float("nan"),) * 3
    turn_rad: Triple = (float("nan"),) * 3
    rotation_rad: Triple = (float("nan"),) * 3
    depth_m: float = float("nan")
    sigma_shift_m: float = float("nan")
    sigma_turn_rad: float = float("nan")
    sigma_rotation_rad: Triple = (float("nan"),) * 3
    sigma_depth_m: float = float("nan")
    residual_px: float = float("nan")
    missing: tuple[int, ...] = ()
    reason: str = ""


def store(sightings: Sequence[Sighting], rig: Rig, family: str) -> Reference:
    """The reference of some cycles' sightings. Raises InputError when fewer than three marks are seen by both cameras."""
    seen = {number for left, right in sightings for number in set(left) & set(right)}
    marks = {}
    for number in sorted(seen):
        views = [np.median([sight[camera][number] for sight in sightings if number in sight[0] and number in sight[1]], axis=0)
                 for camera in (0, 1)]
        points = _triangulated(views[0].astype(float), views[1].astype(float), rig)
        sides = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)
        if np.ptp(sides) < NEARLY_SQUARE * sides.mean():
            marks[number] = tuple(tuple(point) for point in points.tolist())
    if len(marks) < FEWEST:
        raise InputError(f"{len(marks)} marks of {family} are seen whole by both cameras, {FEWEST} are needed: "
                         "fix them around the bin, where nothing hides them")
    return Reference.model_validate({"family": family, "marks": marks, "rig_sha256": rig.sha256})


def compare(reference: Reference, sightings: Sequence[Sighting], rig: Rig) -> MarksCheck:
    """The marks of one cycle, or of some cycles together, against the reference.

    Nine unknowns, the mount's motion and the right camera's turn, by least squares over the corners in both images; corners
    that are off count little. `rig` as in the file that the reference was made with; with a corrected one the turn found is
    what is left. What lenses or the baseline's length do looks like one of these, and shows in `residual_px`.
    """
    views = tuple(_gathered(reference, sightings, camera) for camera in (0, 1))
    common = set(views[0][2]) & set(views[1][2])
    either = set(views[0][2]) | set(views[1][2])
    missing = tuple(sorted(set(reference.marks) - either))
    if len(common) < FEWEST:
        return MarksCheck(marks=len(common), missing=missing, reason=(
            f"only {len(common)} of {len(reference.marks)} marks are seen by both cameras, {FEWEST} are needed"))
    return _solved(reference, views, rig, len(common), missing)


_View: TypeAlias = tuple[Float[np.ndarray, "_ 3"], Float[np.ndarray, "_ 2"], tuple[int, ...]]
"""What one camera sees: points, their places, the marks; each camera sees as many as it does."""


def _gathered(reference: Reference, sightings: Sequence[Sighting], camera: int) -> _View:
    """Points, where they are seen (their median over the sightings), and the marks they belong to."""
    numbers = sorted({number for sight in sightings for number in sight[camera] if number in reference.marks})
    if not numbers:
        return np.zeros((0, 3)), np.zeros((0, 2)), ()
    points = np.concatenate([np.array(reference.marks[number]) for number in numbers])
    pixels = np.concatenate([np.median([sight[camera][number] for sight in sightings if number in sight[camera]], axis=0)
                             for number in numbers]).astype(float)
    return points, pixels, tuple(numbers)


def _solved(reference: Reference, views: tuple[_View, ...], rig: Rig, count: int, missing: tuple[int, ...]) -> MarksCheck:
    middle = np.mean([np.mean(corners, axis=0) for corners in reference.marks.values()], axis=0)
    R_rect_second = axes(rig)

    def residuals(x: Float[np.ndarray, "9"]) -> Float[np.ndarray, "n"]:
        poses = (rig.cameras[0].T_camera_rig, T_second_rig(rig, R_rect_second, x[6:]))
        return np.concatenate([pixels - _projected(points, rig, camera, T @ _moved(x, middle))
                               for camera, ((points, pixels, _), T) in enumerate(zip(views, poses, strict=True))]).ravel()

    # metres and radians are alike in size at a working distance of about one metre
    found = least_squares(residuals, np.zeros(9), loss="soft_l1", f_scale=LOOSE_PX, x_scale=1e-3, ftol=1e-6)
    for _ in range(ROUNDS):     # from there on what is far off counts for next to nothing
        loose_px = min(LOOSE_PX, 2 * _spread(residuals(found.x)))
        found = least_squares(residuals, found.x, loss="cauchy", f_scale=loose_px, x_scale=1e-3, ftol=1e-6)
    spread = _spread(residuals(found.x))
    covariance = spread**2 * np.linalg.inv(found.jac.T @ found.jac)
    sigma = np.sqrt(np.diag(covariance))
    rotation = tuple(found.x[6:].tolist())
    slope = np.array([_depth_m(rig, middle, np.eye(3)[axis] * 1e-4) / 1e-4 for axis in range(3)])
    return MarksCheck(
        marks=count, shift_m=tuple(found.x[:3].tolist()), turn_rad=tuple(found.x[3:6].tolist()), rotation_rad=rotation,
        depth_m=_depth_m(rig, middle, found.x[6:]), sigma_shift_m=float(np.linalg.norm(sigma[:3])),
        sigma_turn_rad=float(np.linalg.norm(sigma[3:6])), sigma_rotation_rad=tuple(sigma[6:].tolist()),
        sigma_depth_m=float(np.sqrt(slope @ covariance[6:, 6:] @ slope)), residual_px=spread, missing=missing)


def _spread(residual: Float[np.ndarray, "n"]) -> float:
    """The sigma of what is not far off."""
    return 1.4826 * float(np.median(np.abs(residual))) + 1e-3


def _moved(x: Float[np.ndarray, "n"], middle: Float[np.ndarray, "3"]) -> Transform:
    """T_now_reference of points: turned back about the marks' middle, and shifted back, as the mount moved the other way."""
    R = Rotation.from_rotvec(-x[3:6]).as_matrix()
    return geometry.make(R, middle - R @ middle - x[:3])


def _projected(points: Points, rig: Rig, index: int, T_camera_points: Transform) -> Pixels:
    """Where a camera of the rig, wherever it stands, sees points."""
    camera = rig.cameras[index]
    seen: Pixels = cv2.projectPoints(geometry.transform(T_camera_points, points), np.zeros(3), np.zeros(3), camera.K_px,
                                     camera.distortion_coefficients)[0].reshape(-1, 2)
    return seen


def _triangulated(left_px: Pixels, right_px: Pixels, rig: Rig) -> Points:
    left, right = (cv2.undistortPoints(pixels.reshape(-1, 1, 2), camera.K_px, camera.distortion_coefficients).reshape(-1, 2)
                   for pixels, camera in zip((left_px, right_px), rig.cameras[:2], strict=True))
    return triangulation.triangulate(np.eye(4)[:3], rig.cameras[1].T_camera_rig[:3], left, right)


def _depth_m(rig: Rig, middle: Float[np.ndarray, "3"], rotation_rad: Float[np.ndarray, "3"]) -> float:
    """What a turned right camera makes the depth of a point err by, when the rig file is still believed."""
    point = middle[None]
    poses = (rig.cameras[0].T_camera_rig, T_second_rig(rig, axes(rig), rotation_rad))
    left, right = (_projected(point, rig, index, T) for index, T in enumerate(poses))
    return float(_triangulated(left, right, rig)[0, 2] - middle[2])
