"""Drift: what rows and marks say cycle by cycle, until it is enough to warn, or to stop trusting the calibration."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from binpick.rigcheck.marks import MarksCheck
from binpick.rigcheck.rows import Rows

KEPT = 64
"""Readings that a trend is drawn through."""
RECENT, FEWEST = 7, 3
"""The verdict is of the median of so many of the last readings, once there are so few."""


class Level(StrEnum):
    """Of a verdict."""

    OK = "ok"
    WARN = "warn"
    FAULT = "fault"


@dataclass(frozen=True, slots=True)
class Limits:
    """`px`: of rows (`Rows.off_px`); `m`: of the marks' shift and of what the right camera's turn does to depth."""

    warn_px: float = 0.3
    fault_px: float = 1.0
    warn_m: float = 0.0007
    fault_m: float = 0.003


@dataclass(frozen=True, slots=True)
class Watch:
    """The state: readings so far, newest last, and what they amount to.

    `row_px` is signed, `off_px` counts for the limits, as do `shift_m` (length) and `depth_m` (signed); NaN while too few
    cycles told. `trend_px` is the change of `row_px` over 100 cycles. `rotation_rad` is the turn (pitch, yaw, roll) for
    `correction.corrected`: of the marks where there are some, else of rows, yaw then 0. `cycles` counts all steps, also those
    in which nothing was seen.
    """

    level: Level = Level.OK
    sentence: str = "No cycle has been looked at yet."
    cycles: int = 0
    row_px: float = float("nan")
    off_px: float = float("nan")
    trend_px: float = float("nan")
    shift_m: float = float("nan")
    depth_m: float = float("nan")
    rotation_rad: tuple[float, float, float] = (float("nan"),) * 3
    rows: tuple[tuple[int, Rows], ...] = ()
    marks: tuple[tuple[int, MarksCheck], ...] = ()


def step(watch: Watch, rows: Rows | None, marks: MarksCheck | None = None, limits: Limits = Limits()) -> Watch:
    """The state after one more cycle; None: not looked at. Start with `Watch()`, and again after a correction."""
    return replace(watch, cycles=watch.cycles + 1)


def unseen(marks: bool) -> tuple[str, ...]:
    """What drift cannot be told by what is looked at: sentences for reports and health."""
    return ()
