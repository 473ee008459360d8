"""Marks: tags fixed to the cell, whose places tell a bumped mount and a turned camera, also where rows stay as they were."""

from collections.abc import Mapping, Sequence
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Float32
from pydantic import BaseModel, ConfigDict, Field
from dataclasses import dataclass

from binpick.data import Image
from binpick.rig import Rig

Corners: TypeAlias = Float32[np.ndarray, "4 2"]
Sighting: TypeAlias = tuple[Mapping[int, Corners], Mapping[int, Corners]]
"""What the rig's first two cameras see of the marks in one cycle."""
Triple: TypeAlias = tuple[float, float, float]
FEWEST = 3


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

    `shift_m` is how far things in the marks' middle seem to have moved, in the rig's frame, because the mount has: what a pick
    there is off by; `turn_rad` the mount's turn. `rotation_rad`: (pitch, yaw, roll) of the right camera against the rig file,
    as in `rows.Rows`; `depth_m` what these do to a depth in the marks' middle. The sigmas are of one such check.
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


def detect(image: Image, family: str) -> dict[int, Corners]:
    """Corners of each tag of a family ("apriltag_36h11", "4x4_50", ...) in an image as taken, px. Raises InputError."""
    return {}


def store(sightings: Sequence[Sighting], rig: Rig, family: str) -> Reference:
    """The reference of some cycles' sightings. Raises InputError when fewer than three marks are seen by both cameras."""
    raise NotImplementedError


def compare(reference: Reference, sightings: Sequence[Sighting], rig: Rig) -> MarksCheck:
    """The marks of one cycle, or of some cycles together, against the reference."""
    return MarksCheck(reason="marks are not looked at yet")
