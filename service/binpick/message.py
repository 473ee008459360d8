"""What the parts of a result share, and its bin: frozen messages, metres and radians, unknown keys and NaN refused."""

import math
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

Triple = tuple[float, float, float]
Xyzw = tuple[float, float, float, float]
Metering = Literal["", "settled", "too_dark", "too_bright", "unsteady"]
Level = Literal["ok", "warn", "fault"]


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


class MarksMessage(Wire):
    """What the reference marks say of the rig; null, with a reason, where too few were seen.

    `shift_m` and `turn_rad`: of the cameras against the cell since the marks were stored; pitch, yaw, roll: of the second
    camera against the first since the calibration; `depth_m`: what that does to depth in the marks' middle.
    """

    seen: int
    """Marks that both cameras saw."""
    missing: tuple[int, ...] = ()
    """Numbers of those that not both saw."""
    reason: str = ""
    shift_m: float | None
    turn_rad: float | None
    pitch_rad: float | None
    yaw_rad: float | None
    roll_rad: float | None
    depth_m: float | None


class CorrectionMessage(Wire):
    """The rig file's calibration was corrected for this cycle."""

    rotation_rad: Triple
    """Pitch, yaw and roll of the second camera, about x, y and z of the rectified view."""
    rig_sha256: str
    """The rig as it was used; `inputs` names the file's."""
    number: int = 1
    """How many turns the sum is of."""


class BoardMessage(Wire):
    """A calibration board that was in view of a verification."""

    board: str
    points: int
    """Of the board, seen by both cameras."""
    level: Level
    sentence: str
    row_px: float | None
    scale_permille: float | None
    """Lengths on the board as seen, too long by so much."""
    planarity_m: float | None
    """Rms distance of its points from a plane."""


class CalibrationMessage(Wire):
    """How well the rig file still describes the cameras; null where too little was seen to say."""

    level: Level
    """warn: poses exist, with return code 2; fault: none do, return code -24."""
    sentence: str
    """What was measured, and what to do."""
    reason: str = ""
    """Why this cycle's rows are not told."""
    row_px: float | None
    """Rows of the right image below those of the left, median, px."""
    row_sigma_px: float | None
    points: int
    """Places that the row error rests on."""
    off_px: float | None
    """What counts for the limits: rows over the whole view and the last cycles, px."""
    change_px: float | None
    """Change of the row error over 100 cycles, px."""
    bin_m: float | None = None
    """How much higher than expected a located bin seems to stand, over the last cycles."""
    marks: MarksMessage | None = None
    correction: CorrectionMessage | None = None
    board: BoardMessage | None = None


class Verify(Wire):
    """What a verification of the calibration is to do beside looking at rows and reference marks."""

    store_marks: bool = False
    """Store where the reference marks are seen now: at commissioning, with a calibration that is trusted."""
    board: Annotated[str, Field(max_length=64)] = ""
    """A calibration board in view of both cameras, as for `binpick-calib` (charuco:9x6:0.025); "": none."""


class RecipeMessage(Wire):
    """The recipe a cycle worked by."""

    number: int
    name: str
    sha256: str
