"""The cell's memory of its bins as transitions: what a cycle starts from, what it leaves, what reports and exchanges do."""

from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pytest

from binpick import settings
from binpick.cell import machine
from binpick.cell import memory as memories
from binpick.cell.machine import State
from binpick.data import CameraStatus
from binpick.errors import Busy, Code, InputError, NotApplicable
from binpick.outcomes import MISSED, OK, Attempt, Grid, Look, Memory
from binpick.result import (
    BinMessage,
    GraspMessage,
    PoseMessage,
    Published,
    Request,
    Result,
    ReturnCode,
    Sigma,
    ToolMessage,
)
from binpick.settings import Bin, Pose

S = 1_000_000_000
JOB = settings.resolve(settings.Cell(bins=(Bin(inner_size_m=(0.6, 0.4, 0.18), pose=Pose()),)))
READY = State(max_age_ns=10 * S, cameras=(CameraStatus("left", True),))
PATCH = Grid.of(np.zeros((20, 20), dtype=np.int16))


def attempt(cycle_id: int, number: int = 1, outcome: int = 0) -> Attempt:
    return Attempt(captured_at="2026-01-01T00:00:00Z", cycle_id=cycle_id, grasp=number, tool=1, position_m=(0.0, 0.0, 0.1),
                   approach=(0.0, 0.0, -1.0), reach_m=0.02, patch=PATCH, outcome=outcome)


def seen(cycle_id: int, *attempts: Attempt) -> Memory:
    """What a cycle with two grasps leaves."""
    return Memory(attempts=attempts, look=Look(heights=PATCH, parts=PATCH, attempts=(attempt(cycle_id), attempt(cycle_id, 2))))


def published(cycle_id: int, bin_number: int = 1, code: Code = Code.OK) -> Published:
    pose = PoseMessage(position_m=(0.0, 0.0, 1.0), quaternion_xyzw=(0.0, 0.0, 0.0, 1.0))
    grasps = [GraspMessage(
        id=f"{cycle_id}-{n}", rank=n, tool=ToolMessage(number=1, name="s", kind="suction"), frame="camera",
        T_frame_pregrasp=pose, approach_m=0.1, lift_m=0.1, open_m=0, close_m=0, quality=1, clearance_m=0.01, part_id=1,
        sigma=Sigma(xy_m=0, z_m=0, tilt_rad=0), **pose.model_dump()) for n in (1, 2)]
    result = Result(cycle_id=cycle_id, request=Request(), captured_at=None, return_code=ReturnCode.of(code),
                    bin=BinMessage(found=True, number=bin_number, T_camera_bin=None, fill_level=None, coverage=None),
                    grasps=tuple(grasps) if code.carries_poses else ())
    return Published(result, b"", 0, seen(cycle_id).look.attempts if code.carries_poses else ())  # type: ignore[union-attr]


def cycled(state: State = READY, bin_number: int = 1, *attempts: Attempt) -> State:
    """One more cycle with two grasps, on top of what the bin remembers."""
    state = machine.start(state, Request(), JOB, 0, S)
    before = memories.recall(state, bin_number)
    state = machine.finish(state, state.last_id, published(state.last_id, bin_number))
    return memories.remember(state, state.last_id, bin_number, before, seen(state.last_id, *before.attempts, *attempts))


def remembered(state: State, bin_number: int = 1) -> dict[tuple[int, int], int]:
    memory = state.memories.get(bin_number, Memory())
    return {(a.cycle_id, a.grasp): a.outcome for a in memory.attempts}


def test_a_report_is_remembered_by_its_own_bin_and_corrected_by_a_later_one() -> None:
    state = cycled(cycled(), 2)
    once = memories.report(state, 1, 2, MISSED)
    assert remembered(once, 1) == {(1, 2): MISSED}
    assert remembered(once, 2) == {}
    assert memories.report(once, 1, 2, MISSED) is once
    assert remembered(memories.report(once, 1, 2, OK)) == {(1, 2): OK}
    assert once.outcomes == {(1, 2): MISSED}


def test_what_the_machine_refuses_is_not_remembered() -> None:
    state = cycled()
    for cycle_id, number, outcome, fault in ((1, 3, 1, NotApplicable), (2, 1, 1, NotApplicable), (1, 1, 8, InputError)):
        with pytest.raises(fault):
            memories.report(state, cycle_id, number, outcome)


def test_a_report_on_one_of_the_last_sixteen_results_still_counts() -> None:
    state = READY
    for _ in range(machine.KEPT):
        state = cycled(state)
    assert remembered(memories.report(state, 1, 1, MISSED)) == {(1, 1): MISSED}
    with pytest.raises(NotApplicable):
        memories.report(cycled(state), 1, 1, MISSED)


def test_a_report_while_the_next_cycle_runs_is_not_lost() -> None:
    state = machine.start(cycled(), Request(), JOB, 0, S)
    before = memories.recall(state, 1)
    state = memories.report(state, 1, 1, MISSED)
    state = machine.finish(state, 2, published(2))
    state = memories.remember(state, 2, 1, before, seen(2))
    assert remembered(state) == {(1, 1): MISSED}
    assert state.memories[1].look == seen(2).look


@pytest.mark.parametrize("end", [machine.ACKNOWLEDGED, machine.TRIGGERED_AGAIN])
def test_what_was_seen_is_compared_when_the_robot_may_have_acted(end: str) -> None:
    state = replace(cycled(), valid=False, withdrawn=end)
    assert memories.recall(state, 1).look is not None


@pytest.mark.parametrize("change", [
    {"valid": True}, {"valid": False, "withdrawn": "older than 10000 ms"}, {"valid": False, "withdrawn": "TRIG fell"},
    {"valid": False, "withdrawn": "acknowledged", "published": None},
    {"valid": False, "withdrawn": "acknowledged", "published": published(7, code=Code.BIN_EMPTY)}])
def test_else_it_is_not(change: dict[str, object]) -> None:
    state = memories.report(cycled(cycled()), 1, 1, MISSED)
    recalled = memories.recall(replace(state, **change), 1)  # type: ignore[arg-type]
    assert recalled == Memory(attempts=state.memories[1].attempts)


def test_a_controller_that_speaks_needs_no_comparison() -> None:
    state = machine.acknowledge(memories.report(cycled(), 1, 2, OK), 1)
    assert memories.recall(state, 1).look is None


def test_an_exchanged_bin_is_unknown_and_its_poses_hold_no_longer() -> None:
    state = memories.report(cycled(cycled(), 2), 1, 1, MISSED)
    assert state.valid
    fresh = memories.forget(state, 1)
    assert (remembered(fresh, 1), fresh.memories[1]) == ({}, Memory())
    assert fresh.memories[2] == state.memories[2]
    assert (fresh.valid, fresh.withdrawn) == (False, "bin 1 was exchanged")
    late = memories.report(fresh, 1, 2, MISSED)                   # of a part that is gone with its bin
    assert (late.outcomes[1, 2], remembered(late)) == (MISSED, {})
    assert remembered(memories.report(cycled(late), 3, 1, MISSED)) == {(3, 1): MISSED}


def test_a_cycle_that_saw_the_old_bin_leaves_nothing() -> None:
    state = machine.finish(machine.start(READY, Request(), JOB, 0, S), 1, published(1))
    fresh = memories.forget(state, 1)
    assert memories.remember(fresh, 1, 1, Memory(), seen(1)) is fresh


def test_no_bin_is_exchanged_while_a_cycle_runs() -> None:
    state = machine.start(replace(READY, memories=MappingProxyType({1: seen(1)})), Request(), JOB, 0, S)
    with pytest.raises(Busy):
        memories.forget(state, 1)
