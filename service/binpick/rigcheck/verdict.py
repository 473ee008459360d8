"""The verdict on a rig file: figures of one look at a board, a flat or a sphere, against limits, in sentences."""

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np

from binpick.rigcheck.rows import Rows

Level = Literal["ok", "warn", "fault"]
LEVELS: tuple[Level, ...] = ("ok", "warn", "fault")
SURE = 3.0
"""Sigmas that a figure must lie from zero before it counts."""
UNKNOWN = float("nan")


@dataclass(frozen=True, slots=True)
class Limits:
    """Each as (warn, fault): rows px, scale per mille, bend or unevenness m, offset of the expected pose m and rad.

    5 mm at a distance of 1 m are 5 per mille. A gauge is no proof against the rig: its bend never is more than a warning.
    """

    off_px: tuple[float, float] = (0.3, 1.0)
    scale_permille: tuple[float, float] = (1.5, 4.0)
    bend_m: tuple[float, float] = (0.0005, np.inf)
    offset_m: tuple[float, float] = (0.002, 0.005)
    offset_rad: tuple[float, float] = (0.004, 0.010)


LIMITS = Limits()


@dataclass(frozen=True, slots=True)
class Verdict:
    """What one look says; NaN: this gauge does not tell it.

    `rows`: the right camera's row error and turn. `planarity_m`: rms distance from the gauge's true shape (plane, sphere);
    `bend_m`: of a flat gauge, from its deepest to its highest place, of its smooth part alone. `scale_permille`: how much too
    large distances come out, with its sigma. `offset_m`, `offset_rad`: of the pose against the expected one, `pose` being the
    board's in the rig frame (None: the gauge has none). `sentence` says it all; `findings` one by one, the worst first.
    """

    gauge: str
    points: int
    distance_m: float
    rows: Rows
    planarity_m: float = UNKNOWN
    bend_m: float = UNKNOWN
    sigma_bend_m: float = UNKNOWN
    scale_permille: float = UNKNOWN
    sigma_permille: float = UNKNOWN
    offset_m: float = UNKNOWN
    offset_rad: float = UNKNOWN
    pose: tuple[tuple[float, ...], ...] | None = None
    level: Level = "ok"
    findings: tuple[str, ...] = ()
    sentence: str = ""

    @property
    def document(self) -> dict[str, Any]:
        """As JSON: NaN is null, the rows' figures stand beside the others."""
        told = asdict(self)
        rows = told.pop("rows")
        told |= {key: rows[key] for key in ("row_px", "off_px", "pitch_rad", "roll_rad")}
        return {key: None if isinstance(value, float) and not np.isfinite(value) else value for key, value in told.items()}


def judged(seen: Verdict, limits: Limits = LIMITS) -> Verdict:
    """The verdict with its level and sentences, the worst first."""
    found = sorted((finding for finding in (_of_rows(seen, limits), _of_scale(seen, limits), _of_shape(seen, limits),
                                            _of_pose(seen, limits)) if finding), key=lambda finding: -finding[0])
    level = max((worst for worst, _ in found), default=0)
    said = tuple(sentence for _, sentence in found)
    whole = "; ".join(said) or _well(seen)
    sentence = f"{whole[0].upper()}{whole[1:]}. {_advice(seen, level, said, limits)}"
    return replace(seen, level=LEVELS[level], findings=said, sentence=sentence)


def _advice(seen: Verdict, level: int, said: tuple[str, ...], limits: Limits) -> str:
    if not level:
        coarse = SURE * seen.sigma_permille > limits.scale_permille[1]
        return f"Nothing is wrong, but this {_what(seen)} is too small to tell the scale." if coarse else "The rig is good."
    if " is bent by " in said[0]:
        return "Verify with a flat one."
    if " from where it is expected: " in said[0] and len(said) == 1:
        return "Bring the rig back, or calibrate where it stands."
    return "Calibrate again." if level > 1 else "Watch it, and verify again soon."


Finding = tuple[int, str] | None


def _beyond(value: float, limits: tuple[float, float], sigma: float = 0.0) -> int:
    """0, 1 warn, 2 fault: NaN and what may be noise are neither."""
    size = abs(value)
    if not size > SURE * (0.0 if np.isnan(sigma) else sigma):
        return 0
    return int(size > limits[0]) + int(size > limits[1])


def _of_rows(seen: Verdict, limits: Limits) -> Finding:
    rows = seen.rows
    worst = _beyond(rows.off_px, limits.off_px, rows.sigma_px)
    if not worst:
        return None
    turns = [f"{name} by {1000 * angle:+.2f} mrad" for name, angle, sigma in (
        ("pitched", rows.pitch_rad, rows.sigma_pitch_rad), ("rolled", rows.roll_rad, rows.sigma_roll_rad))
        if abs(angle) > SURE * sigma]
    return worst, (f"partners lie {rows.off_px:.2f} px from their rows ({rows.row_px:+.2f} px in the middle): the right camera "
                   f"has {' and '.join(turns) or 'turned'} against the left one")


def _of_scale(seen: Verdict, limits: Limits) -> Finding:
    worst = _beyond(seen.scale_permille, limits.scale_permille, seen.sigma_permille)
    if not worst:
        return None
    way = "large" if seen.scale_permille > 0 else "small"
    off_mm = abs(seen.scale_permille) * seen.distance_m
    return worst, (f"the scale is off: distances come out {abs(seen.scale_permille):.1f} per mille too {way} ({off_mm:.1f} mm "
                   f"at {seen.distance_m:.2f} m): the baseline or the cameras' angle to each other (yaw) has changed, or the "
                   f"{_what(seen)} is not of the size given")


def _of_shape(seen: Verdict, limits: Limits) -> Finding:
    if _beyond(seen.bend_m, limits.bend_m, seen.sigma_bend_m):
        return 1, (f"the {_what(seen)} is bent by {1000 * seen.bend_m:.1f} mm, or, if another shows the same, the lenses "
                   "have changed")
    return None


def _of_pose(seen: Verdict, limits: Limits) -> Finding:
    worst = max(_beyond(seen.offset_m, limits.offset_m), _beyond(seen.offset_rad, limits.offset_rad))
    if not worst:
        return None
    return worst, (f"the {_what(seen)} is {1000 * seen.offset_m:.1f} mm and {np.degrees(seen.offset_rad):.2f}° from where it "
                   "is expected: the rig has moved in the cell, or the board has")


def _what(seen: Verdict) -> str:
    return seen.gauge if seen.gauge in ("flat", "sphere") else "board"


def _well(seen: Verdict) -> str:
    scale = f"scale off by {seen.scale_permille:+.1f} ± {seen.sigma_permille:.1f} per mille"
    told = [f"rows off by {seen.rows.off_px:.2f} px" if np.isfinite(seen.rows.off_px) else "",
            scale if np.isfinite(seen.scale_permille) else "",
            f"{_what(seen)} true to {1000 * seen.planarity_m:.2f} mm" if np.isfinite(seen.planarity_m) else "",
            f"{1000 * seen.offset_m:.1f} mm from where it is expected" if np.isfinite(seen.offset_m) else ""]
    return ", ".join(word for word in told if word)
