"""Correction: the rig with its second camera turned by the small angle that production pairs and marks show."""

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict
from scipy.spatial.transform import Rotation

from binpick import geometry
from binpick.errors import InputError
from binpick.geometry import Transform, rectification
from binpick.rig import Rig

Triple = tuple[float, float, float]
MOST_RAD = 0.002
"""A larger turn is no drift but a bump: calibrate again. 3.5 px with a 6 mm lens of 1740 px, 7 px with 12 mm."""


class Correction(BaseModel):
    """What was applied to a rig: the sum of all turns since its file, (pitch, yaw, roll), and which rig came of it."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    rotation_rad: Triple
    rig_sha256: str
    corrected_sha256: str
    number: int = 1
    """How many turns the sum is of."""


def corrected(rig: Rig, rotation_rad: Triple) -> Rig:
    """The rig as it is after its second camera turned by (pitch, yaw, roll), as in `rows.Rows` and `marks.MarksCheck`.

    Give the rig of the file and the sum of all turns found since, so that the bound holds for them all; `applied` does.
    Raises InputError beyond `MOST_RAD`, or when an angle is not finite.
    """
    turn = np.array(rotation_rad)
    if not np.isfinite(turn).all():
        raise InputError("the cameras' relative turn is not known, so the rig cannot be corrected by it")
    if (size := float(np.linalg.norm(turn))) > MOST_RAD:
        raise InputError(f"the second camera has turned by {1000 * size:.2f} mrad; beyond {1000 * MOST_RAD:g} mrad a rig is "
                         "not corrected: calibrate it again")
    return turned(rig, rotation_rad)


def applied(rig: Rig, rotation_rad: Triple, before: Correction | None = None) -> tuple[Rig, Correction]:
    """The file's rig corrected by a turn found with the correction `before` in force, and the record of it.

    Raises InputError as `corrected`, or when `before` is of another rig file.
    """
    if before is not None and before.rig_sha256 != rig.sha256:
        raise InputError("the correction in force belongs to another rig file: start again without it")
    first = (0.0, 0.0, 0.0) if before is None else before.rotation_rad
    # turns this small add up: their order matters by a millionth
    total = (first[0] + rotation_rad[0], first[1] + rotation_rad[1], first[2] + rotation_rad[2])
    now = corrected(rig, total)
    number = 1 if before is None else before.number + 1
    return now, Correction(rotation_rad=total, rig_sha256=rig.sha256, corrected_sha256=now.sha256, number=number)


def turned(rig: Rig, rotation_rad: Triple) -> Rig:
    """The rig with its second camera turned about the axes of its rectified view; unbounded, all else as it was."""
    second = rig.cameras[1]
    T_cam_rig = T_second_rig(rig, axes(rig), np.array(rotation_rad))
    second = second.model_copy(update={"T_cam_rig": tuple(map(tuple, T_cam_rig.tolist()))})
    return rig.model_copy(update={"cameras": (rig.cameras[0], second, *rig.cameras[2:])})


def axes(rig: Rig) -> Float[np.ndarray, "3 3"]:
    """What turns the second camera's directions into its rectified view: the axes that turns are about."""
    left, right = rig.cameras[:2]
    return rectification.opencv(left.K_px, right.K_px, right.T_camera_rig, rig.image_size_px).R_right


def T_second_rig(rig: Rig, R_rect_second: Float[np.ndarray, "3 3"], rotation_rad: Float[np.ndarray, "3"]) -> Transform:
    """Where the rig lies to its second camera once that has turned about these axes."""
    turn = R_rect_second.T @ Rotation.from_rotvec(rotation_rad).as_matrix() @ R_rect_second
    T: Transform = geometry.make(turn.T, np.zeros(3)) @ rig.cameras[1].T_camera_rig
    return T
