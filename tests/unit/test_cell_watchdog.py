"""What the cell knows of its calibration, as transitions: from cycle to cycle, over a restart, with another rig file."""

from dataclasses import replace

import pytest

import staged
from binpick import settings
from binpick.cell import machine, watchdog
from binpick.cell.machine import State
from binpick.data import CameraStatus
from binpick.errors import Busy, Code, NotInControl, NotReady
from binpick.message import CalibrationMessage, Level, Verify
from binpick.result import Published, Request, Result, ReturnCode
from binpick.rigcheck import correction
from binpick.rigcheck.drift import Level as DriftLevel
from binpick.rigcheck.drift import Watch
from binpick.rigcheck.guard import Guard
from binpick.settings import Bin, Pose
from binpick.settings.cell import ReferenceMarks, Watchdog

S = 1_000_000_000
JOB = settings.resolve(settings.Cell(bins=(Bin(inner_size_m=(0.6, 0.4, 0.18), pose=Pose()),)))
READY = State(max_age_ns=10 * S, cameras=(CameraStatus("left", True),))
RIG = staged.rig((1000, 600), 1000.0)
_, CORRECTION = correction.applied(RIG, (0.001, 0.0, 0.0))
FRESH = Guard(rig_sha256=RIG.sha256)
WATCHED = watchdog.watching(READY, FRESH)


def said(level: Level, row_px: float | None = 0.05) -> CalibrationMessage:
    return CalibrationMessage(level=level, sentence=f"rows: {level}", row_px=row_px, row_sigma_px=0.01, points=900, off_px=0.05,
                              change_px=None)


def seen(level: Level, cycles: int = 1) -> Guard:
    return FRESH.model_copy(update={"watch": Watch(level=DriftLevel(level), sentence=f"rows: {level}", cycles=cycles)})


def published(cycle_id: int, code: Code = Code.OK) -> Published:
    return Published(Result(cycle_id=cycle_id, request=Request(), captured_at=None, return_code=ReturnCode.of(code), bin=None),
                     b"", 0)


def test_a_cycle_starts_from_what_the_last_one_left() -> None:
    assert watchdog.recall(READY, RIG) is None
    assert watchdog.recall(WATCHED, RIG) is FRESH
    state = watchdog.keep(WATCHED, 7, FRESH, seen("warn"), said("warn", 0.4))
    assert watchdog.recall(state, RIG) == seen("warn")
    assert state.drift is not None
    assert (state.drift.level, state.drift.attention) == ("warn", ("rows: warn",))
    assert (state.drift.row_px, state.drift.cycle_ids) == ((0.4,), (7,))
    assert machine.snapshot(state, 1, "rest").drift is state.drift


def test_what_was_not_measured_leaves_no_point_on_the_curve() -> None:
    state = watchdog.keep(WATCHED, 1, FRESH, seen("ok"), said("ok", None))
    assert state.drift is not None
    assert state.drift.row_px == ()
    assert state.drift.attention == ()


def test_the_curve_has_an_end() -> None:
    state = WATCHED
    for cycle_id in range(1, watchdog.TREND + 10):
        state = watchdog.keep(state, cycle_id, FRESH, seen("ok", cycle_id), said("ok", cycle_id / 1000))
    assert state.drift is not None
    assert len(state.drift.row_px) == len(state.drift.cycle_ids) == watchdog.TREND
    assert state.drift.cycle_ids[-1] == watchdog.TREND + 9


def test_where_nobody_watches_nothing_is_kept() -> None:
    assert watchdog.keep(READY, 1, None, FRESH, said("fault")) is READY
    assert watchdog.keep(WATCHED, 1, None, FRESH, said("fault")) is WATCHED


def test_another_rig_file_starts_anew() -> None:
    other = staged.rig((1000, 600), 1010.0)
    state = watchdog.keep(WATCHED, 1, FRESH, seen("fault"), said("fault", 2.0))
    assert state.guard is not None
    corrected = replace(state, guard=state.guard.model_copy(update={"correction": CORRECTION}))
    guard = watchdog.recall(corrected, other)
    assert guard is not None
    assert (guard.rig_sha256, guard.watch, guard.correction) == (other.sha256, Watch(), None)
    after = watchdog.keep(corrected, 2, guard, guard, said("ok", 0.01))
    assert after.drift is not None
    assert (after.drift.row_px, after.drift.level) == ((0.01,), "ok")


@pytest.mark.parametrize(("guard", "level"), [
    (seen("fault"), "fault"), (seen("warn"), "warn"), (seen("ok"), "ok"),
    (FRESH.model_copy(update={"correction": CORRECTION}), "warn")])
def test_a_restart_forgets_no_verdict(guard: Guard, level: str) -> None:
    state = watchdog.watching(READY, Guard.model_validate_json(guard.model_dump_json()))
    assert state.drift is not None
    assert state.drift.level == level
    assert bool(state.drift.attention) is (level != "ok")


def test_marks_that_are_configured_ask_to_be_stored() -> None:
    state = watchdog.watching(READY, FRESH.model_copy(update={"marks": ReferenceMarks(), "watchdog": Watchdog(warn_px=0.2)}))
    assert state.drift is not None
    assert (state.drift.marks, state.drift.warn_px) == ("to be stored", 0.2)
    assert "store_marks" in state.drift.attention[0]
    assert watchdog.watching(READY, FRESH).drift.marks == "none"      # type: ignore[union-attr]


def verifying(state: State, aside: bool) -> State:
    return watchdog.verify(state, Request(), JOB, 0, S, Verify(), "rest" if aside else "modbus", "modbus")


def test_the_controller_verifies_like_it_picks() -> None:
    state = verifying(WATCHED, aside=False)
    assert state.ticket is not None
    assert state.ticket.verify == Verify()
    with pytest.raises(Busy):
        verifying(state, aside=False)
    state = machine.finish(state, 1, published(1))
    assert (state.valid, state.published) == (True, state.finished[-1])


def test_aside_of_the_controller_only_while_the_cell_is_idle() -> None:
    running = machine.start(WATCHED, Request(), JOB, 0, S)
    with pytest.raises(NotInControl, match="controlled by modbus, not by rest, and modbus runs a cycle"):
        verifying(running, aside=True)
    unread = machine.finish(running, 1, published(1))
    with pytest.raises(NotInControl, match="has a result to read"):
        verifying(unread, aside=True)
    read = machine.acknowledge(unread, 1)
    state = verifying(read, aside=True)
    assert state.last_id == 2
    with pytest.raises(NotReady):
        verifying(machine.stop(read, 0), aside=True)


@pytest.mark.parametrize("end", ["finished", "timed out"])
def test_a_look_aside_leaves_what_is_published_alone(end: str) -> None:
    read = machine.acknowledge(machine.finish(machine.start(WATCHED, Request(), JOB, 0, S), 1, published(1)), 1)
    state = verifying(read, aside=True)
    state = machine.finish(state, 2, published(2)) if end == "finished" else machine.tick(state, S)
    assert (state.published, state.valid, state.withdrawn) == (read.published, False, read.withdrawn)
    found = machine.find(state, 2)
    assert found is not None
    assert found.result.return_code.code is (Code.OK if end == "finished" else Code.TIMEOUT)
    assert machine.snapshot(state, 1, "modbus").latest is found
