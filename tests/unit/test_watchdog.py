"""The watchdog's laws: when a correction is taken, what another rig file ends, and what a verdict does to a cycle."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from binpick import watchdog
from binpick.cycle import CycleInput, CycleResult
from binpick.data import Frame, StereoPair
from binpick.errors import Code, NotApplicable
from binpick.message import Verify
from binpick.outcomes import NO_MEMORY
from binpick.result import (
    GraspMessage,
    PoseMessage,
    Request,
    Result,
    ReturnCode,
    Sigma,
    ToolMessage,
)
from binpick.rig import Rig
from binpick.rigcheck import guard as guards
from binpick.rigcheck.drift import FEWEST, Level, Watch
from binpick.rigcheck.guard import Guard
from binpick.rigcheck.marks import Reference
from binpick.rigcheck.rows import Rows
from binpick.settings import Job
from binpick.settings.cell import ReferenceMarks, Watchdog
from binpick.watchdog import Look

PITCH = (0.0003, 0.0, 0.0)
CORRECTING = Watchdog(self_correct=True)
WARNED = Watch(level=Level.WARN, sentence="Rows are off.", cycles=9, off_px=0.5, rotation_rad=PITCH)
NAN = float("nan")


def guard(rig: Rig, **changes: object) -> Guard:
    return Guard(rig_sha256=rig.sha256).model_copy(update=changes)


def test_a_drift_is_taken_out_only_where_that_is_allowed(rig: Rig) -> None:
    assert guard(rig).seen(WARNED, rig).correction is None
    after = guard(rig, watchdog=CORRECTING).seen(WARNED, rig)
    assert after.correction is not None
    assert after.correction.rotation_rad == PITCH
    assert (after.watch, after.level) == (Watch(cycles=9), "warn")
    assert after.rig(rig).sha256 == after.correction.corrected_sha256 != rig.sha256


@pytest.mark.parametrize(("watch", "taken"), [
    (WARNED, True),
    (replace(WARNED, off_px=0.29), False),                                              # it is the mount that warns
    (replace(WARNED, level=Level.OK), False),
    (replace(WARNED, level=Level.FAULT, off_px=1.2), False),                            # rows alone, beyond a drift
    (replace(WARNED, level=Level.FAULT, off_px=1.2, depth_m=0.001), True),              # marks see yaw, too
    (replace(WARNED, level=Level.WARN, off_px=0.0, depth_m=-0.001), True),
    (replace(WARNED, rotation_rad=(NAN, NAN, NAN)), False),
    (replace(WARNED, rotation_rad=(0.0021, 0.0, 0.0)), False),                          # beyond what is corrected at all
])
def test_only_what_is_proved_and_small_is_taken_out(rig: Rig, watch: Watch, taken: bool) -> None:
    after = guard(rig, watchdog=CORRECTING).seen(watch, rig)
    assert (after.correction is not None) is taken
    assert after.watch == (Watch(cycles=9) if taken else watch)


def test_corrections_add_up_within_their_bound(rig: Rig) -> None:
    now = guard(rig, watchdog=CORRECTING)
    for _ in range(20):
        now = now.seen(WARNED, rig)
    assert now.correction is not None
    assert now.correction.number == 6
    assert np.linalg.norm(now.correction.rotation_rad) <= 0.002
    assert now.watch == WARNED                                                          # the verdict stands


def test_another_rig_file_ends_a_correction_and_the_marks(rig: Rig) -> None:
    other = rig.model_copy(update={"board": "another"})
    square = ((0.0, 0.0, 1.0), (0.1, 0.0, 1.0), (0.1, 0.1, 1.0), (0.0, 0.1, 1.0))
    reference = Reference(family="apriltag_36h11", marks=dict.fromkeys(range(3), square), rig_sha256=rig.sha256)
    now = guard(rig, watchdog=CORRECTING, marks=ReferenceMarks(), reference=reference).seen(WARNED, rig)
    assert (now.unusable, now.for_rig(rig)) == ("", now)
    moved = now.for_rig(other)
    assert (moved.correction, moved.watch) == (None, Watch())
    assert "stored with another rig file" in moved.unusable
    assert moved.for_rig(rig).unusable == ""                                            # one may go back
    kept = guards.started(rig, Watchdog(), ReferenceMarks(family="4x4_50"), now)
    assert kept.watchdog == Watchdog()
    assert "stored as apriltag_36h11, not 4x4_50" in kept.unusable


def test_a_guard_is_the_same_after_a_file(rig: Rig) -> None:
    watch = replace(WARNED, rows=((3, Rows(row_px=1 / 3, points=4)),), depth_m=NAN)
    now = guard(rig, watchdog=CORRECTING, watch=watch).seen(watch, rig)
    for kept in (now, guard(rig, watch=watch)):
        assert Guard.model_validate_json(kept.model_dump_json()).model_dump_json() == kept.model_dump_json()


@pytest.mark.parametrize("wrong", [{"warn_px": 1.0, "fault_px": 1.0}, {"warn_px": 0.05}, {"warn": 0.3}])
def test_limits_that_cannot_be_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValidationError):
        Watchdog.model_validate(wrong)


def test_two_marks_are_too_few() -> None:
    with pytest.raises(ValidationError, match="three different marks"):
        ReferenceMarks(ids=(1, 1, 2))


def cycle_input(rig: Rig, job: Job, watch: Watch, **changes: object) -> CycleInput:
    frame = Frame(np.zeros((8, 8), np.uint8), "left", 1, 1, 0, 0, 1, 6000.0, 0.0)
    pair = StereoPair(frame, frame, "2026-01-01T00:00:00Z", 0.0, 0.0, "simulated")
    return replace(CycleInput(1, pair, rig, job, Request()), guard=guard(rig, watch=watch), **changes)  # type: ignore[arg-type]


def answered(code: Code) -> CycleResult:
    pose = PoseMessage(position_m=(0.0, 0.0, 1.0), quaternion_xyzw=(0.0, 0.0, 0.0, 1.0))
    grasp = GraspMessage(
        id="1-1", rank=1, tool=ToolMessage(number=1, name="s", kind="suction"), frame="camera", T_frame_pregrasp=pose,
        approach_m=0.1, lift_m=0.1, open_m=0, close_m=0, quality=1, clearance_m=0.01, part_id=1,
        sigma=Sigma(xy_m=0, z_m=0, tilt_rad=0), **pose.model_dump())
    result = Result(cycle_id=1, request=Request(), captured_at=None, return_code=ReturnCode.of(code), bin=None,
                    grasps=(grasp,) if code.carries_poses else ())
    return CycleResult(result, memory=NO_MEMORY)


def looking(off_px: float) -> Look:
    return Look(Rows(row_px=off_px, sigma_px=0.01, points=90, off_px=abs(off_px), pitch_rad=off_px / 1740, roll_rad=0.0,
                     sigma_pitch_rad=1e-5, sigma_roll_rad=1e-5), None, None)


def watched(rig: Rig, job: Job, off_px: float, code: Code, cycles: int = FEWEST) -> CycleResult:
    inputs = cycle_input(rig, job, Watch())
    for _ in range(cycles):
        cycle = watchdog.judged(inputs, rig, answered(code), looking(off_px))
        inputs = replace(inputs, guard=cycle.guard)
    return cycle


@pytest.mark.parametrize(("off_px", "was", "becomes"), [
    (0.1, Code.OK, Code.OK), (0.1, Code.BIN_EMPTY, Code.BIN_EMPTY), (0.29, Code.OVERFILLED, Code.OVERFILLED),
    (0.31, Code.OK, Code.CALIBRATION_WARNING), (-0.31, Code.OVERFILLED, Code.CALIBRATION_WARNING),
    (0.31, Code.BIN_EMPTY, Code.BIN_EMPTY), (0.99, Code.OK, Code.CALIBRATION_WARNING),
    (1.01, Code.OK, Code.CALIBRATION_FAULT), (-1.01, Code.NO_DEPTH, Code.CALIBRATION_FAULT),
    (1.01, Code.BIN_EMPTY, Code.CALIBRATION_FAULT)])
def test_the_verdict_has_the_last_word(rig: Rig, job: Job, off_px: float, was: Code, becomes: Code) -> None:
    cycle = watched(rig, job, off_px, was)
    code = cycle.result.return_code
    assert code.code is becomes
    assert bool(cycle.result.grasps) is becomes.carries_poses
    assert (cycle.memory is None) is (becomes is Code.CALIBRATION_FAULT)
    assert cycle.result.calibration is not None
    assert cycle.result.calibration.off_px == abs(off_px)
    if code.code in (Code.CALIBRATION_WARNING, Code.CALIBRATION_FAULT):
        assert "px" in code.message
        assert ("above the rim" in code.message) is (was is Code.OVERFILLED)


def test_one_bin_alone_does_not_warn(rig: Rig, job: Job) -> None:
    assert watched(rig, job, 0.9, Code.OK, FEWEST - 1).result.return_code.code is Code.OK


def test_a_camera_that_was_knocked_stops_the_first_cycle(rig: Rig, job: Job) -> None:
    cycle = watched(rig, job, 1.5, Code.OK, 1)
    assert cycle.result.return_code.code is Code.CALIBRATION_FAULT
    assert not cycle.result.grasps


def test_a_verification_judges_what_it_sees(rig: Rig, job: Job) -> None:
    inputs = cycle_input(rig, job, Watch(), verify=Verify())
    cycle = watchdog.judged(inputs, rig, answered(Code.OK), looking(1.5))
    assert cycle.result.return_code.code is Code.CALIBRATION_FAULT
    with pytest.raises(NotApplicable, match="too dark"):
        watchdog.judged(inputs, rig, answered(Code.OK), Look(Rows(reason="too dark"), None, None))


def test_who_does_not_watch_changes_nothing(rig: Rig, job: Job) -> None:
    inputs = replace(cycle_input(rig, job, Watch()), guard=None)
    cycle = answered(Code.OK)
    assert watchdog.judged(inputs, rig, cycle, None) is cycle
    assert watchdog.rig(inputs) is rig
