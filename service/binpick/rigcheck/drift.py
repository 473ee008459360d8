"""Drift: what rows and marks say cycle by cycle, until it is enough to warn, or to stop trusting the calibration."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from binpick.rigcheck.carrier import CarrierCheck
from binpick.rigcheck.marks import MarksCheck
from binpick.rigcheck.rows import Rows

KEPT = 64
"""Readings that a trend is drawn through."""
RECENT, FEWEST = 9, 5
"""The verdict is of the median of so many of the last readings, once there are so few: no single bin warns."""
STALE = 50
"""Readings of so many cycles ago say nothing of now."""
VAGUE = 0.3
"""Rows or marks are not read when their sigma is above this share of the limit that warns."""
SURE = 2.0
"""Of a reading's own sigmas: it counts for nothing within them."""
SUDDEN = 5.0
"""A single reading beyond the limit of a fault by more of its own sigmas stops its own cycle: a camera that was knocked must
not cost five wrong picks until the median knows. Undrifted rows are off by 0.02 px, by 0.08 px without the pattern."""
TREND_CYCLES = 100
NOT_TOLD = float("nan")
Triple = tuple[float, float, float]


class Level(StrEnum):
    """Of a verdict."""

    OK = "ok"
    WARN = "warn"
    FAULT = "fault"


@dataclass(frozen=True, slots=True)
class Limits:
    """`px`: of rows (`Rows.off_px`); `m`: of the mount's shift at the marks, and of what the right camera's turn does to depth.

    `bin_m`: how much higher or lower a located bin may seem to stand; bins are no gauges, so beyond it is only a warning.
    """

    warn_px: float = 0.3
    fault_px: float = 1.0
    warn_m: float = 0.0007
    fault_m: float = 0.003
    bin_m: float = 0.004


DEFAULT = Limits()


@dataclass(frozen=True, slots=True)
class Watch:
    """The state: readings so far with the cycle they are of, newest last, and what they amount to.

    `row_px` is signed, `off_px` counts for the limits, as do `shift_m` (a length), `depth_m` and `bin_m` (how much higher the
    bin seems to stand), which are signed; NaN while too few cycles told. `trend_px` is the change of `row_px` over 100 cycles.
    `rotation_rad` is the turn (pitch, yaw, roll) for `correction.applied`: of the marks where they are read, else of rows, yaw
    then 0. `cycles` counts all steps, also those in which nothing was seen.
    """

    level: Level = Level.OK
    sentence: str = "Too few cycles have been looked at to tell whether the calibration has drifted."
    cycles: int = 0
    row_px: float = NOT_TOLD
    off_px: float = NOT_TOLD
    trend_px: float = NOT_TOLD
    shift_m: float = NOT_TOLD
    depth_m: float = NOT_TOLD
    bin_m: float = NOT_TOLD
    rotation_rad: Triple = (NOT_TOLD, NOT_TOLD, NOT_TOLD)
    rows: tuple[tuple[int, Rows], ...] = ()
    marks: tuple[tuple[int, MarksCheck], ...] = ()
    carriers: tuple[tuple[int, CarrierCheck], ...] = ()


def step(watch: Watch, rows: Rows | None, marks: MarksCheck | None = None, limits: Limits = DEFAULT,
         carrier: CarrierCheck | None = None) -> Watch:
    """The state after one more cycle; None: not looked at. Start with `Watch()`, and again after a correction.

    `carrier` is for cells without marks: a bin that stands where it always stands.
    """
    cycle = watch.cycles + 1
    read = rows is not None and rows.sigma_px < VAGUE * limits.warn_px
    clear = marks is not None and max(marks.sigma_shift_m, marks.sigma_depth_m) < VAGUE * limits.warn_m
    now = replace(watch, cycles=cycle,
                  rows=(*watch.rows, (cycle, rows))[-KEPT:] if rows is not None and read else watch.rows,
                  marks=(*watch.marks, (cycle, marks))[-KEPT:] if marks is not None and clear else watch.marks,
                  carriers=watch.carriers if carrier is None else (*watch.carriers, (cycle, carrier))[-KEPT:])
    return _judged(_measured(now), limits)


def _measured(watch: Watch) -> Watch:
    """With medians of the recent readings."""
    since = watch.cycles - STALE
    rows = [reading for cycle, reading in watch.rows[-RECENT:] if cycle > since]
    marks = [reading for cycle, reading in watch.marks[-RECENT:] if cycle > since]
    turns = [mark.rotation_rad for mark in marks] if len(marks) >= FEWEST else [row.rotation_rad for row in rows]
    return replace(watch, row_px=_median([row.row_px for row in rows]), off_px=_median([_certain(row) for row in rows]),
                   trend_px=_trend_px(watch.rows), depth_m=_median([mark.depth_m for mark in marks]),
                   shift_m=float(np.linalg.norm(_medians([mark.shift_m for mark in marks]))),
                   bin_m=_median([bin_.shift_m for cycle, bin_ in watch.carriers[-RECENT:] if cycle > since]),
                   rotation_rad=_medians(turns))


def _certain(rows: Rows) -> float:
    """`off_px`, unless that may be chance."""
    return rows.off_px if abs(rows.off_px) > SURE * rows.sigma_px else 0.0


def _median(values: Sequence[float]) -> float:
    """NaN of too few."""
    return float(np.median(values)) if len(values) >= FEWEST else NOT_TOLD


def _medians(values: Sequence[Triple]) -> Triple:
    """Of each component."""
    first, second, third = ([value[axis] for value in values] for axis in range(3))
    return _median(first), _median(second), _median(third)


def _trend_px(rows: tuple[tuple[int, Rows], ...]) -> float:
    """The median slope of lines through a reading of the first half and its peer in the second; NaN of fewer than 16."""
    if len(rows) < 16:
        return NOT_TOLD
    cycle, row_px = np.array([(number, reading.row_px) for number, reading in rows]).T
    half = len(rows) // 2
    slopes = (row_px[-half:] - row_px[:half]) / (cycle[-half:] - cycle[:half])
    return float(np.median(slopes) * TREND_CYCLES)


def _judged(watch: Watch, limits: Limits) -> Watch:
    """With the verdict: the worst of what is told."""
    asked = (
        (watch.off_px, limits.warn_px, limits.fault_px, f"the rows of the two cameras are off by {watch.off_px:.2f} px"),
        (abs(watch.depth_m), limits.warn_m, limits.fault_m, f"by the marks depths are off by {1000 * watch.depth_m:+.1f} mm"),
        (watch.shift_m, limits.warn_m, limits.fault_m, f"by the marks the mount has moved by {1000 * watch.shift_m:.1f} mm"),
        (abs(watch.bin_m), limits.bin_m, float("inf"), f"the bin seems to stand {1000 * watch.bin_m:+.1f} mm higher"))
    told = [question for question in asked if np.isfinite(question[0])]
    faults = [sentence for value, _, fault, sentence in told if value >= fault] or _sudden(watch, limits)
    if not told and not faults:
        if watch.level is not Level.OK:
            return watch            # that nothing is seen any more makes nothing better
        return replace(watch, sentence=Watch().sentence if watch.cycles < STALE else (
            f"Nothing has told in {STALE} cycles whether the calibration has drifted: verify it, or fix marks around the bin."))
    warnings = [sentence for value, warn, _, sentence in told if value >= warn]
    if faults:
        return replace(watch, level=Level.FAULT, sentence=_said(faults, "calibrate again"))
    if warnings:
        return replace(watch, level=Level.WARN, sentence=_said(warnings, "verify the calibration soon"))
    return replace(watch, level=Level.OK, sentence="No drift: " + "; ".join(sentence for *_, sentence in told) + ".")


def _sudden(watch: Watch, limits: Limits) -> list[str]:
    """What this cycle alone says beyond doubt."""
    rows = [each for cycle, each in watch.rows[-1:] if cycle == watch.cycles]
    marks = [each for cycle, each in watch.marks[-1:] if cycle == watch.cycles]
    said = [f"in this cycle the rows of the two cameras are off by {each.off_px:.2f} px"
            for each in rows if each.off_px - SUDDEN * each.sigma_px >= limits.fault_px]
    for each in marks:
        shift_m = float(np.linalg.norm(each.shift_m))
        if abs(each.depth_m) - SUDDEN * each.sigma_depth_m >= limits.fault_m:
            said.append(f"in this cycle depths are off by {1000 * each.depth_m:+.1f} mm by the marks")
        if shift_m - SUDDEN * each.sigma_shift_m >= limits.fault_m:
            said.append(f"in this cycle the mount has moved by {1000 * shift_m:.1f} mm by the marks")
    return said


def _said(what: Sequence[str], do: str) -> str:
    text = "; ".join(what)
    return f"{text[0].upper()}{text[1:]}: {do}."


def unseen(marks: bool, located: bool = False) -> tuple[str, ...]:
    """What drift is not told by what is looked at, as sentences for reports and health; `located`: the bin is looked for."""
    if marks:
        return ("Marks show a bumped mount and a turned camera; a lens or a baseline that changed looks like one of these.",)
    blind = ("The bin's rim shows a mount that moved up or down and depths that err, but not apart from another bin." if located
             else "Nothing shows a mount that was bumped: poses in the robot's base would be off by as much.")
    rows = ("Rows do not show cameras that turned towards or away from each other (yaw), a baseline or a focal length that "
            "changed, nor which of the two cameras turned: depths would err unseen.")
    return rows, blind, "Three tags or more fixed around the bin would show a bumped mount and any turn of a camera."
