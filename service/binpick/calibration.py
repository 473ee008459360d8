"""The rig in use and its versions, and samples of a board: as the cell keeps them and every interface tells them."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from binpick import geometry
from binpick.errors import Code
from binpick.geometry import Transform
from binpick.message import PoseMessage, Wire
from binpick.rig import Quality, Rig, digest

Mounting = Literal["base", "flange"]
MOST_VERSIONS = 9999
REACH_M = 10.0
"""No flange is further from its base: a position in millimetres is."""


class SampleRequest(Wire):
    """One pair of images of a board, taken without the pattern."""

    board: Annotated[str, Field(max_length=64)] = ""
    """As `charuco:9x6:0.025`; "": the cell file's `calibration.board`, else the one the rig was calibrated with."""
    T_base_flange: PoseMessage | None = None
    """The flange in the robot's base while the images are taken; null: the sample is of no use to the hand-eye calibration."""
    recipe: Annotated[int, Field(ge=0, le=65535)] = 0
    """The recipe whose exposure and gain are used; 0: the first."""
    timeout_ms: Annotated[int, Field(ge=0, le=60000)] = 0
    """Time limit, ms; 0: the cell's."""


class Sighting(Wire):
    """What one camera saw of the board; `reason` says why it was not found, "" when it was."""

    camera: str
    found: bool
    points: int
    reason: str = ""


class Sample(Wire):
    """One pair of images of a board, as stored. `cameras_sha256` names the part of the rig that the images depend on."""

    id: Annotated[int, Field(ge=1)]
    captured_at: str
    board: str
    simulated: bool
    rig_sha256: str
    cameras_sha256: str
    T_base_flange: PoseMessage | None
    sightings: tuple[Sighting, ...]
    useful: bool
    """Whether it shows something that earlier samples do not."""
    reason: str
    """What is new about it, or why it is of no use."""

    @property
    def found(self) -> int:
        """How many cameras saw the board."""
        return sum(sighting.found for sighting in self.sightings)

    @property
    def code(self) -> Code:
        """Of the cycle that took it."""
        return Code.OK if self.found == len(self.sightings) else Code.BOARD_NOT_FOUND

    @property
    def sentence(self) -> str:
        """For people."""
        blind = "; ".join(f"{one.camera}: {one.reason}" for one in self.sightings if not one.found)
        return f"Sample {self.id}: {blind or self.reason}."


class Progress(Wire):
    """Where the samples stand: `missing` says in sentences what the next ones should show; empty: they are `enough`."""

    enough: bool
    missing: tuple[str, ...]
    coverage: dict[str, Any]
    """Views, cells of each image, distances and tilts, for displays."""


class SampleAnswer(Wire):
    """A sample that was taken, and where all of them stand now."""

    sample: Sample
    progress: Progress


class Samples(Wire):
    """All samples, the oldest first; at most `most` are kept. `damaged`: folders that cannot be read, and why."""

    samples: tuple[Sample, ...]
    most: int
    progress: Progress
    damaged: dict[str, str]


class RigVersion(Wire):
    """One version of the rig, by its number; `hand_eye` says which transform it has."""

    version: Annotated[int, Field(ge=1)]
    active: bool
    sha256: str
    file: str
    """Where it is stored."""
    created: str | None
    board: str | None
    hand_eye: Mounting | None
    T_hand_eye: PoseMessage | None
    """T_base_rig or T_flange_rig, as `hand_eye` says."""
    quality: Quality | None


class CalibrationState(Wire):
    """What the cell runs on: the active version, and those that can be activated."""

    active: RigVersion
    note: str
    """What somebody should know of the choice of this version, or ""."""
    versions: tuple[RigVersion, ...]
    damaged: dict[int, str]
    """Versions that cannot be read, and why."""
    samples: int


class HandEyeRequest(Wire):
    """Asks for a hand-eye calibration from the samples."""

    mounting: Mounting
    """base: the rig stands fast and the board rides on the flange; flange: the rig rides on the flange and the board stands."""
    z_m: Annotated[float, Field(ge=-10, le=10)] | None = None
    """For robots that turn about one axis only: z of the board's first point, in the flange (base: in the base), metres."""


class HandEyeResidual(Wire):
    """How far a sample's board, as seen, lies from where the robot says: metres and radians, and px in the images."""

    m: float
    rad: float
    px: float


class HandEyeAnswer(Wire):
    """The hand-eye calibration: a new version of the rig, stored and not active."""

    version: RigVersion
    T_carrier_board: PoseMessage
    """The board in the flange (rig on the base) or in the base (rig on the flange)."""
    rms_m: float
    rms_rad: float
    rms_px: float
    sigma_m: float
    """One standard deviation of the transform, metres where the boards were."""
    sigma_rad: float
    residuals: dict[str, HandEyeResidual]
    """By sample."""
    outliers: dict[str, str]
    """Samples that were not used, and why."""


class Activation(Wire):
    """Names the version that the cell shall run on."""

    version: Annotated[int, Field(ge=1, le=MOST_VERSIONS)]


def message(T: Transform) -> PoseMessage:
    """The pose of a transform."""
    x, y, z = (float(value) for value in T[:3, 3])
    qx, qy, qz, qw = (float(value) for value in geometry.quaternion(T))
    return PoseMessage(position_m=(x, y, z), quaternion_xyzw=(qx, qy, qz, qw))


def transform(pose: PoseMessage) -> Transform:
    """The transform of a pose."""
    return geometry.from_quaternion(np.array(pose.position_m), np.array(pose.quaternion_xyzw))


def of_rig(rig: Rig, version: int, file: str, *, active: bool) -> RigVersion:
    """A rig as the interfaces tell it."""
    T = rig.T_base_rig or rig.T_flange_rig
    hand_eye: Mounting | None = "base" if rig.T_base_rig is not None else "flange" if rig.T_flange_rig is not None else None
    return RigVersion(version=version, active=active, sha256=rig.sha256, file=file, created=rig.created, board=rig.board,
                      hand_eye=hand_eye, T_hand_eye=None if T is None else message(np.array(T)), quality=rig.quality)


@dataclass(frozen=True, slots=True)
class Installed:
    """The rig that the cell runs on, as told to people, and what somebody should know of the choice of it, or ""."""

    rig: Rig
    told: RigVersion
    note: str = ""


def cameras_sha256(rig: Rig) -> str:
    """Names what a view of a board depends on: lenses, and where the cameras stand to each other. Hand-eye is not in it."""
    return digest(rig.model_dump(mode="json", include={"image_size_px", "cameras"}))
