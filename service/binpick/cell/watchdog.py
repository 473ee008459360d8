"""What the cell knows of its calibration: transitions of its state from the look of each cycle, like the memory's own."""

from dataclasses import replace
from typing import Literal

from binpick.cell import installation, machine
from binpick.cell.machine import State
from binpick.message import CalibrationMessage, Verify
from binpick.result import Drift, Owner, Request, Source
from binpick.rig import Rig
from binpick.rigcheck import drift
from binpick.rigcheck.guard import Guard
from binpick.settings import Job

Marks = Literal["none", "to be stored", "stored"]
TREND = 120
"""Cycles whose row errors are kept for people: some minutes of a busy cell."""


def watching(state: State, guard: Guard) -> State:
    """From here on the calibration is watched."""
    return replace(state, guard=guard, drift=told(Drift(), guard))


def recall(state: State, rig: Rig) -> Guard | None:
    """What the watchdog starts a cycle with this rig from: of another rig's drift nothing is left but the marks to look for."""
    guard = state.guard
    return guard.for_rig(rig) if guard is not None else None


def keep(state: State, cycle_id: int, before: Guard | None, after: Guard, seen: CalibrationMessage) -> State:
    """A cycle that started from `before` left `after`. With another rig file than the last cycle's the curve begins anew."""
    if state.guard is None or before is None:
        return state
    was = state.drift or Drift()
    if before.rig_sha256 != state.guard.rig_sha256:
        was = Drift()
    if seen.row_px is not None:
        was = replace(was, row_px=(*was.row_px, seen.row_px)[-TREND:], cycle_ids=(*was.cycle_ids, cycle_id)[-TREND:])
    return replace(state, guard=after, drift=told(replace(was, latest=seen), after, seen.bin_m is not None))


def told(known: Drift, guard: Guard, located: bool = False) -> Drift:
    """With the level and the sentences that follow from it; before the first cycle they are those of an earlier daemon's."""
    latest = known.latest
    level, sentence = (latest.level, latest.sentence) if latest is not None else (guard.level, guard.watch.sentence)
    marks: Marks = "none" if guard.marks is None else "to be stored" if guard.unusable else "stored"
    return replace(known, level=level, warn_px=guard.watchdog.warn_px, fault_px=guard.watchdog.fault_px, marks=marks,
                   attention=tuple(each for each in (sentence if level != "ok" else "", guard.unusable) if each),
                   unseen=drift.unseen(marks == "stored", located))


def verify(state: State, request: Request, job: Job, now_ns: int, timeout_ns: int, wanted: Verify, source: Source,
           owner: Owner) -> State:
    """Starts a look at the calibration. Raises NotInControl, and like `machine.start`."""
    installation.admit(state, source, owner)
    return machine.start(state, request, job, now_ns, timeout_ns, verify=wanted, aside=source != owner)
