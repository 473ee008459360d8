"""What the parts of a result share, and its bin: frozen messages, metres and radians, unknown keys and NaN refused."""

import math
from typing import Literal

from pydantic import BaseModel, ConfigDict, field_validator

Triple = tuple[float, float, float]
Xyzw = tuple[float, float, float, float]
Metering = Literal["", "settled", "too_dark", "too_bright", "unsteady"]


class Wire(BaseModel):
    """Frozen; unknown keys and NaN are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


class PoseMessage(Wire):
    """A pose: position in metres and a unit quaternion."""

    position_m: Triple
    quaternion_xyzw: Xyzw

    @field_validator("quaternion_xyzw")
    @classmethod
    def _unit(cls, turn: Xyzw) -> Xyzw:
        if abs(math.hypot(*turn) - 1) > 1e-3:     # what rounding to three digits leaves
            raise ValueError("a quaternion must have length 1 (within 0.001)")
        return turn


class RimMessage(Wire):
    """How a bin was located: the shares of its sides (at −x, +x, −y, +y) seen where its model has them, the rms distance of

    the points that show them, and where it stands from where it is expected: shift along the expected axes, yaw, tilt.
    """

    seen: tuple[float, float, float, float]
    rms_m: float
    shift_m: Triple
    yaw_rad: float
    tilt_rad: float


class FillCellMessage(Wire):
    """The fill of a rectangle of the bin's floor: middle and size in its frame; level null where nothing was measured."""

    x_m: float
    y_m: float
    size_m: tuple[float, float]
    level: float | None
    coverage: float


class BinMessage(Wire):
    """The bin as used: its pose in the camera frame, and how full it is (0 to 1 of its height, mean over measured cells).

    `found` is false, and there is no pose, when it was to be located and was not, or is not the bin of its model; `rim` says
    how well it was located, null when its pose is configured.
    """

    found: bool
    number: int
    T_camera_bin: PoseMessage | None
    fill_level: float | None
    coverage: float | None
    cells: tuple[FillCellMessage, ...] = ()
    rim: RimMessage | None = None


class ShotMessage(Wire):
    """What the left and the right camera really exposed one shot with, as read back from them."""

    projector: bool
    pattern: int
    exposure_us: tuple[float, float]
    gain_db: tuple[float, float]


class SyncMessage(Wire):
    """How well the images are proved to show one instant, and what they were taken with.

    `proof` is ptp, latch (device clocks compared with the host's), interval (the host's times alone) or none; `arrival_ms` is
    from the trigger until all images were here. `metering` says what auto exposure came to, "" without it: settled; too_dark or
    too_bright, when the limits of exposure and gain did not let it; unsteady, when the brightness changed from one test shot to
    the next.
    """

    skew_us: float
    sigma_us: float
    proof: str
    resends: int
    missing: int
    exposure_us: float = 0.0
    gain_db: float = 0.0
    arrival_ms: float = 0.0
    metering: Metering = ""
    shots: tuple[ShotMessage, ...] = ()


class RecipeMessage(Wire):
    """The recipe a cycle worked by."""

    number: int
    name: str
    sha256: str
