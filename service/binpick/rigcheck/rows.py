"""Rows: how far partners of a production pair lie from their common row, and which small turn of a camera explains it."""

from dataclasses import dataclass

from binpick.data import Rectified


@dataclass(frozen=True, slots=True)
class Rows:
    """What a rectified pair without a board says of the calibration; NaN with a `reason` where too little was seen.

    `row_px`: median row of the right view minus that of the left, of `points` places; `sigma_px` its noise. `pitch_rad` and
    `roll_rad`: the turn of the right camera against the rig file, about the rows and about the optical axis of the
    rectified view (x along the rows, y down, z forward), with their sigmas. `off_px`: root mean square over the places of the
    rows that these turns explain, which no roll can hide in.
    """

    row_px: float = float("nan")
    sigma_px: float = float("nan")
    points: int = 0
    off_px: float = float("nan")
    pitch_rad: float = float("nan")
    roll_rad: float = float("nan")
    sigma_pitch_rad: float = float("nan")
    sigma_roll_rad: float = float("nan")
    reason: str = ""

    @property
    def rotation_rad(self) -> tuple[float, float, float]:
        """The turn (pitch, yaw, roll) for `correction.corrected`: rows do not see yaw, which stays 0."""
        return self.pitch_rad, 0.0, self.roll_rad


def check(pair: Rectified) -> Rows:
    """The rows of one shot of a cycle, as rectified for matching. Best with the pattern on."""
    return Rows(reason=f"a window of {pair.window.width} px is not looked at yet")
