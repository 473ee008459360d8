"""The cell's state machine under every order of events: ids, deadlines, what is published and for how long."""

from contextlib import nullcontext
from dataclasses import replace

import hypothesis.strategies as st
import pytest
from hypothesis import settings as hypothesis_settings
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from binpick import settings
from binpick.calibration import SampleRequest
from binpick.cell import installation, machine
from binpick.cell.machine import State
from binpick.data import CameraStatus
from binpick.errors import Busy, Code, InputError, NotApplicable, NotInControl, NotReady
from binpick.result import (
    Funnel,
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
UP = (CameraStatus("left", True), CameraStatus("right", True))
DOWN = (CameraStatus("left", True), CameraStatus("right", False, error="no answer"))
READY = State(max_age_ns=10 * S, cameras=UP)


def grasp(cycle_id: int, number: int = 1) -> GraspMessage:
    at, turn = (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0)
    return GraspMessage(
        id=f"{cycle_id}-{number}", rank=number, tool=ToolMessage(number=1, name="suction", kind="suction"), frame="camera",
        position_m=at, quaternion_xyzw=turn, T_frame_pregrasp=PoseMessage(position_m=at, quaternion_xyzw=turn), approach_m=0.1,
        lift_m=0.1, open_m=0, close_m=0, quality=1, sigma=Sigma(xy_m=0, z_m=0, tilt_rad=0), clearance_m=0.01, part_id=1)


def answer(cycle_id: int, at_ns: int, code: Code = Code.OK) -> Published:
    result = Result(cycle_id=cycle_id, request=Request(), captured_at=None, return_code=ReturnCode.of(code), bin=None,
                    grasps=(grasp(cycle_id),) if code.carries_poses else ())
    return Published(result, result.json_bytes(), triggered_ns=at_ns)


def started(state: State = READY, now_ns: int = 0, timeout_ns: int = S) -> State:
    return machine.start(state, Request(), JOB, now_ns, timeout_ns)


def test_a_cycle_passes_through_its_phases() -> None:
    state = started()
    assert (state.phase, state.last_id) == ("acquiring", 1)
    state = machine.acquired(state, 1)
    assert (state.phase, machine.snapshot(state, 7, "rest").acquired) == ("computing", True)
    state = machine.finish(state, 1, answer(1, 0))
    shown = machine.snapshot(state, 7, "rest")
    assert (shown.phase, shown.valid, shown.current, shown.boot_id, shown.owner) == ("ready", True, 0, 7, "rest")
    assert dict(shown.counts) == {"started": 1, "finished": 1}


def test_while_one_runs_the_next_is_refused() -> None:
    with pytest.raises(Busy, match="cycle 1 is running"):
        started(started())


@pytest.mark.parametrize(("state", "why"), [
    (replace(READY, stopping=True), "stopping"), (replace(READY, cameras=()), "being opened"),
    (replace(READY, cameras=DOWN), "camera right: no answer")])
def test_a_cell_that_is_not_ready_says_why(state: State, why: str) -> None:
    with pytest.raises(NotReady, match=why):
        started(state)


def test_the_deadline_publishes_a_timeout_and_the_worker_keeps_the_slot_until_it_is_back() -> None:
    state = started(timeout_ns=S)
    assert machine.due(state) == S
    assert machine.tick(state, S - 1) is state
    state = machine.tick(state, S)
    assert state.published is not None
    assert state.published.result.return_code.code is Code.TIMEOUT
    assert (state.valid, state.running, state.phase) == (True, None, "starting")
    with pytest.raises(Busy, match="withdrawn"):
        started(state)
    state = machine.finish(state, 1, answer(1, S))
    assert (state.phase, state.counts["late"], state.published.result.return_code.code) == ("ready", 1, Code.TIMEOUT)
    assert started(state).last_id == 2


def test_a_timed_out_result_is_as_young_as_its_publication() -> None:
    state = machine.tick(started(replace(READY, max_age_ns=S), timeout_ns=60 * S), 60 * S)
    assert state.valid
    assert machine.due(state) == 61 * S


def test_a_worker_that_saw_its_retirement_brings_nothing_and_nothing_is_counted() -> None:
    state = machine.abort(started(), 1, 0)
    state = machine.finish(state, 1, None)
    assert (state.phase, "late" in state.counts, state.counts["aborted"]) == ("ready", False, 1)


def test_what_the_last_gate_stopped_is_counted_and_an_alarm_until_a_cycle_ends_well() -> None:
    sound = answer(1, 0)
    funnel = Funnel(counts={"clear": 4, "gate_out_of_reach": 2, "gate_tilt": 1, "published": 1}, dominating="gate_out_of_reach")
    state = machine.finish(started(), 1, replace(sound, result=sound.result.model_copy(update={"funnel": funnel})))
    assert state.faults == ("the last gate stopped 2 out of reach, 1 tilt",)
    assert (state.counts["gate_stopped"], "internal_errors" in state.counts) == (3, False)
    assert machine.finish(started(state), 2, answer(2, 0)).faults == ()


def test_poses_exist_only_with_the_codes_that_carry_them() -> None:
    for code in Code:
        fields = {**answer(1, 0).result.model_dump(by_alias=True), "return_code": ReturnCode.of(code)}
        with nullcontext() if code.carries_poses else pytest.raises(ValueError, match="0 to 3"):
            Result.model_validate(fields)


def test_only_the_running_cycle_can_be_aborted() -> None:
    for state, cycle_id in ((READY, 1), (started(), 2), (machine.abort(started(), 1, 0), 1)):
        with pytest.raises(NotApplicable, match=f"cycle {cycle_id} is not running"):
            machine.abort(state, cycle_id, 0)


def test_a_result_lives_until_it_is_acknowledged() -> None:
    state = machine.finish(started(), 1, answer(1, 0))
    with pytest.raises(NotApplicable):
        machine.acknowledge(state, 2)
    state = machine.acknowledge(state, 1)
    assert (state.valid, state.withdrawn) == (False, "acknowledged")
    with pytest.raises(NotApplicable):
        machine.acknowledge(state, 1)


def test_a_result_lives_until_the_next_trigger() -> None:
    state = started(machine.finish(started(), 1, answer(1, 0)))
    assert (state.valid, state.withdrawn) == (False, "triggered again")


def test_a_result_lives_until_its_images_are_too_old() -> None:
    state = machine.finish(started(), 1, answer(1, at_ns=2 * S))
    assert machine.due(state) == 12 * S
    state = machine.tick(state, 12 * S)
    assert (state.valid, state.withdrawn, state.counts["expired"]) == (False, "older than 10000 ms", 1)
    assert machine.due(state) is None


def test_a_withdrawal_takes_back_what_runs_and_what_is_published() -> None:
    state = machine.withdraw(started(), "the controller went away", 0)
    assert (state.valid, state.withdrawn, state.running) == (False, "the controller went away", None)
    assert state.counts["aborted"] == 1
    assert state.finished[-1].result.return_code.code is Code.ABORTED
    state = machine.withdraw(machine.finish(started(), 1, answer(1, 0)), "gone", 0)
    assert (state.valid, state.counts["withdrawn"]) == (False, 1)
    assert machine.withdraw(state, "again", 0) is state


def test_a_fault_of_ours_stays_until_a_good_cycle() -> None:
    state = machine.finish(started(), 1, answer(1, 0, Code.NOT_READY), "internal error")
    assert (state.faults, state.counts["internal_errors"]) == (("internal error",), 1)
    state = machine.finish(started(state), 2, answer(2, 0, Code.CAMERAS))
    assert (state.faults, state.counts["camera_failures"]) == (("internal error",), 1)
    state = machine.finish(started(state), 3, answer(3, 0, Code.BIN_EMPTY))
    assert state.faults == ()
    assert machine.stumble(state, "odd").faults == ("odd",)


def test_outcomes_are_kept_for_the_last_sixteen_results() -> None:
    state = READY
    for cycle_id in range(1, 19):
        state = machine.finish(started(state), cycle_id, answer(cycle_id, 0))
    assert [p.result.cycle_id for p in state.finished] == list(range(3, 19))
    assert machine.find(state, 2) is None
    once = machine.report(state, 3, 1, 2)
    assert machine.report(once, 3, 1, 2) is once
    assert machine.report(once, 3, 1, 1).outcomes == {(3, 1): 1}
    for cycle_id, number in ((2, 1), (3, 2), (99, 1)):
        with pytest.raises(NotApplicable):
            machine.report(state, cycle_id, number, 1)
    for outcome in (0, 8):
        with pytest.raises(InputError):
            machine.report(state, 3, 1, outcome)
    later = machine.finish(started(once), 19, answer(19, 0))
    assert later.outcomes == {}


def test_stopping_withdraws_and_never_ends() -> None:
    state = machine.stop(started(), 0)
    assert (state.phase, state.running, state.valid) == ("stopping", None, False)
    assert machine.finish(state, 1, answer(1, 0)).phase == "stopping"


class AnyOrder(RuleBasedStateMachine):
    """Whatever happens in whatever order: an id ends exactly once, and nothing is offered that does not hold."""

    def __init__(self) -> None:
        super().__init__()
        self.state, self.now = READY, 0
        self.hand: int | None = None
        self.seen: list[int] = []

    def go(self, state: State) -> None:
        """Takes a step, and writes down what was finished by it."""
        new = [p.result.cycle_id for p in state.finished if p not in self.state.finished]
        assert len(new) <= 1
        self.seen += new
        self.state = state

    @rule(seconds=st.integers(0, 12))
    def time_passes(self, seconds: int) -> None:
        self.now += seconds * S
        self.go(machine.tick(self.state, self.now))
        due = machine.due(self.state)
        assert due is None or due > self.now

    @rule(timeout=st.integers(1, 5))
    def trigger(self, timeout: int) -> None:
        phase = self.state.phase
        try:
            self.go(machine.start(self.state, Request(), JOB, self.now, timeout * S))
        except (Busy, NotReady):
            assert phase != "ready"
        else:
            assert phase == "ready"
            assert not self.state.valid

    @rule(timeout=st.integers(1, 5))
    def somebody_else_looks_at_a_board(self, timeout: int) -> None:
        before = self.state
        try:
            self.go(installation.sample(self.state, Request(), JOB, self.now, timeout * S, SampleRequest(), "rest", "modbus"))
        except (Busy, NotReady, NotInControl):
            assert before.phase != "ready" or before.valid
        else:
            assert before.phase == "ready"
            assert (self.state.valid, self.state.withdrawn) == (False, before.withdrawn)

    @rule()
    def the_rig_is_held(self) -> None:
        idle = self.state.ticket is None
        try:
            self.go(installation.hold(self.state, "held", "modbus", "modbus"))
        except (Busy, NotReady):
            assert not idle or self.state.held
        else:
            assert idle
            assert self.state.phase != "ready"

    @precondition(lambda self: self.state.held)
    @rule()
    def the_rig_is_given_back(self) -> None:
        assert self.state.ticket is None      # nothing could start meanwhile
        self.go(installation.release(self.state))

    @precondition(lambda self: self.state.ticket is not None and self.hand is None)
    @rule()
    def worker_takes_the_ticket(self) -> None:
        assert self.state.ticket is not None
        self.hand = self.state.ticket.cycle_id

    @precondition(lambda self: self.hand is not None)
    @rule()
    def pair_accepted(self) -> None:
        assert self.hand is not None
        self.go(machine.acquired(self.state, self.hand))

    @precondition(lambda self: self.hand is not None)
    @rule(code=st.sampled_from([Code.OK, Code.BIN_EMPTY, Code.CAMERAS, Code.NOT_READY]), fault=st.sampled_from(["", "odd"]))
    def worker_returns(self, code: Code, fault: str) -> None:
        assert self.hand is not None
        counts = self.state.running is not None
        result = answer(self.hand, self.now, code)
        self.go(machine.finish(self.state, self.hand, result, fault))
        assert (self.state.finished[-1:] == (result,)) == counts
        assert self.state.ticket is None
        self.hand = None

    @precondition(lambda self: self.hand is not None and self.state.running is None)
    @rule()
    def worker_returns_with_nothing(self) -> None:
        assert self.hand is not None
        self.go(machine.finish(self.state, self.hand, None))
        self.hand = None

    @rule(back=st.integers(0, 2))
    def abort(self, back: int) -> None:
        running = self.state.running
        wanted = self.state.last_id - back
        try:
            self.go(machine.abort(self.state, wanted, self.now))
        except NotApplicable:
            assert running is None or running.cycle_id != wanted

    @rule()
    def acknowledge(self) -> None:
        if self.state.valid and self.state.published is not None:
            self.go(machine.acknowledge(self.state, self.state.published.result.cycle_id))
            assert not self.state.valid

    @rule()
    def controller_goes_away(self) -> None:
        self.go(machine.withdraw(self.state, "gone", self.now))
        assert self.state.running is None
        assert not self.state.valid

    @rule(cameras=st.sampled_from([UP, DOWN, ()]))
    def cameras_change(self, cameras: tuple[CameraStatus, ...]) -> None:
        self.go(machine.observe(self.state, cameras))

    @invariant()
    def every_id_ends_once_and_in_order(self) -> None:
        open_ids = [self.state.running.cycle_id] if self.state.running else []
        assert self.seen + open_ids == list(range(1, self.state.last_id + 1))

    @invariant()
    def what_is_valid_is_the_last_answer_and_nothing_runs_beside_it(self) -> None:
        if self.state.valid:
            assert self.state.published is self.state.finished[-1]
            assert self.state.running is None
            assert self.state.withdrawn == ""

    @invariant()
    def ready_means_a_trigger_would_be_taken(self) -> None:
        free = self.state.ticket is None and not self.state.held
        assert (self.state.phase == "ready") == (self.state.cameras_up and free)
        assert machine.snapshot(self.state, 1, "rest").current == (self.state.running.cycle_id if self.state.running else 0)


TestAnyOrder = AnyOrder.TestCase
TestAnyOrder.settings = hypothesis_settings(max_examples=60, stateful_step_count=40, deadline=None, derandomize=True)
