"""Hand-eye: where the rig stands in the robot's base or rides on its flange, from robot poses and views of one board."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from binpick.geometry import Transform
from binpick.rig import Rig
from binpick.rigcheck.detection import Detection

Mounting = Literal["base", "flange"]
"""Where the rig is mounted: on the base (the board rides on the flange) or on the flange (the board stands in the cell)."""


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """One stand of the robot: its flange in its base, and what each camera of the rig, in its order, saw of the board."""

    name: str
    T_base_flange: Transform
    seen: tuple[Detection | None, ...]


@dataclass(frozen=True, slots=True)
class Residual:
    """How far a sample's board, as seen, lies from where the robot and the solution put it.

    `m`: distance of the board's middle; `rad`: angle; `px`: rms distance of its points in the images.
    """

    m: float
    rad: float
    px: float


@dataclass(frozen=True, slots=True, eq=False)
class HandEye:
    """The solution. Of `T_base_rig` and `T_flange_rig` one is given, the one of the mounting; the other is None.

    `T_carrier_board`: the board on what carries it: on the flange for a rig on the base, else in the base. `rms_m`, `rms_rad`
    and `rms_px` are of the samples used. `residuals` are of all samples in which the board was seen, by name; `outliers` say
    which were left out, and why.
    """

    mounting: Mounting
    T_base_rig: Transform | None
    T_flange_rig: Transform | None
    T_carrier_board: Transform
    rms_m: float
    rms_rad: float
    rms_px: float
    residuals: dict[str, Residual]
    outliers: dict[str, str] = field(default_factory=dict)


def solve(samples: Sequence[Sample], rig: Rig, mounting: Mounting, z_m: float | None = None) -> HandEye:
    """The transform under which the robot and the images of all cameras agree best.

    `z_m` is for robots that turn about one axis only, for which the height cannot be seen: the z of the board's first point, in
    the flange for a rig on the base, else in the base. Raises InputError that names what is missing (samples, turns of the
    flange about which axes), or says that too many samples contradict each other.
    """
    raise NotImplementedError
