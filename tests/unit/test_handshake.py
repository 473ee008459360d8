"""The handshake alone: every arrow of the contract, and random controllers against a random cell."""

from dataclasses import dataclass, field, replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from binpick.data import CameraStatus
from binpick.errors import Code
from binpick.publish import handshake
from binpick.publish.exchange import NO_CTRL, Abort, Acknowledge, Action, Facts, Forget, Inputs, Report, Start, Withdraw
from binpick.publish.handshake import Phase, State
from binpick.publish.image import Echo
from binpick.publish.registers import Ctrl, Detail, Status
from binpick.result import Published, Request, Snapshot, failure

MS = 1_000_000
ENABLE, TRIG, RES_ACK, NEXT_PAGE = Ctrl.ENABLE, Ctrl.TRIG, Ctrl.RES_ACK, Ctrl.NEXT_PAGE
ECHO = Echo(recipe=1, bin=1, frame=3, pose_format=1, tool=1)


@dataclass
class Bench:
    """A controller's words, a cell's facts and a clock, driven by hand."""

    state: State = field(default_factory=State)
    inputs: Inputs = field(default_factory=lambda: Inputs(now_ns=0))
    actions: list[Action] = field(default_factory=list)
    cycle_id: int = 0
    refuse_with: Code | None = None
    timeout_ms: int = 5000

    def plc(self, ctrl: Ctrl, cmd_seq: int | None = None, command: int = 1, after_ms: int = 1, **levels: object) -> Status:
        """The controller writes; returns the status it reads next."""
        self.inputs = replace(self.inputs, ctrl=ctrl, written=True, command=command, now_ns=self.inputs.now_ns + after_ms * MS,
                              cmd_seq=self.inputs.cmd_seq if cmd_seq is None else cmd_seq, **levels)  # type: ignore[arg-type]
        return self.look()

    def cell(self, after_ms: int = 1, **facts: object) -> Status:
        """The cell changes."""
        self.inputs = replace(self.inputs, facts=replace(self.inputs.facts, **facts),  # type: ignore[arg-type]
                              now_ns=self.inputs.now_ns + after_ms * MS)
        return self.look()

    def look(self) -> Status:
        self.state, actions = handshake.step(self.state, self.inputs)
        for action in actions:
            self.actions.append(action)
            self.obey(action)
        return self.status

    def obey(self, action: Action) -> None:
        facts = self.inputs.facts
        match action:
            case Start() if self.refuse_with:
                self.state = handshake.refused(self.state, self.inputs, self.refuse_with)
            case Start():
                self.cycle_id += 1
                facts = replace(facts, current=self.cycle_id, acquired=False, valid=False)
                self.state = handshake.started(self.state, self.inputs, self.cycle_id, ECHO,
                                               self.inputs.now_ns + self.timeout_ms * MS)
            case Forget() if self.refuse_with:
                self.state = handshake.refused(self.state, self.inputs, self.refuse_with)
            case Forget():
                facts = replace(facts, valid=False)
                self.state = handshake.done(self.state, self.inputs, ECHO)
            case Abort(cycle_id):
                facts = replace(facts, current=0, finished=cycle_id, code=-26, valid=True, grasps=0)
            case Acknowledge():
                facts = replace(facts, valid=False)
            case Withdraw():
                facts = replace(facts, current=0, finished=facts.current or facts.finished, valid=False, grasps=0)
        self.inputs = replace(self.inputs, facts=facts)

    def finish(self, code: int = 0, grasps: int = 3) -> Status:
        return self.cell(current=0, finished=self.cycle_id, code=code, valid=True, grasps=grasps)

    @property
    def shown(self) -> handshake.Signals:
        return handshake.signals(self.state, self.inputs)

    @property
    def status(self) -> Status:
        return self.shown.status

    def taken(self) -> list[Action]:
        actions, self.actions = self.actions, []
        return actions


@pytest.fixture
def ready() -> Bench:
    bench = Bench()
    assert bench.plc(ENABLE) == Status.READY
    return bench


@pytest.fixture
def busy(ready: Bench) -> Bench:
    ready.plc(ENABLE | TRIG, cmd_seq=10)
    assert ready.taken() == [Start()]
    return ready


@pytest.fixture
def done(busy: Bench) -> Bench:
    busy.finish()
    assert Status.VALID in busy.status
    return busy


def test_one_cycle_from_ready_to_ready(ready: Bench) -> None:
    ready.plc(ENABLE, cmd_seq=10)
    assert ready.status == Status.READY
    assert ready.plc(ENABLE | TRIG) == Status.ACK | Status.BUSY
    assert (ready.shown.cmd_seq, ready.shown.cycle_id, ready.shown.echo, ready.shown.code) == (10, 1, ECHO, Code.BUSY)
    assert ready.cell(acquired=True) == Status.ACK | Status.BUSY | Status.ACQ_DONE
    assert ready.finish() == Status.ACK | Status.ACQ_DONE | Status.VALID | Status.LAST_PAGE
    assert (ready.shown.code, ready.shown.cmd_seq) == (0, 10)
    assert ready.plc(ENABLE | TRIG | RES_ACK) == Status.ACK
    assert ready.plc(ENABLE | RES_ACK) == Status(0)
    assert ready.plc(ENABLE) == Status.READY
    assert ready.taken() == [Start(), Acknowledge(1)]


def test_before_the_control_word_was_written_nothing_is_ready() -> None:
    bench = Bench()
    assert bench.look() == Status(0)
    assert bench.shown.latched == Code.NOT_READY
    assert bench.plc(ENABLE) == Status.READY


@pytest.mark.parametrize("levels", [TRIG, RES_ACK, TRIG | RES_ACK])
def test_after_start_ready_waits_for_trig_and_res_ack_to_fall(levels: Ctrl) -> None:
    bench = Bench()
    bench.look()
    assert bench.plc(ENABLE | levels, cmd_seq=3) == Status(0)
    assert bench.plc(ENABLE) == Status.READY
    assert bench.taken() == []


def test_the_same_cmd_seq_is_ignored_however_often_it_is_written(ready: Bench) -> None:
    for _ in range(3):
        ready.plc(ENABLE | TRIG, cmd_seq=10)
    ready.finish()
    for _ in range(3):
        ready.plc(ENABLE | TRIG | RES_ACK, cmd_seq=10)
    for _ in range(3):
        assert ready.plc(ENABLE) == Status.READY
        assert ready.plc(ENABLE | TRIG, cmd_seq=10) == Status.READY
    assert ready.taken() == [Start(), Acknowledge(1)]


def test_cmd_seq_zero_is_no_command(ready: Bench) -> None:
    assert ready.plc(ENABLE | TRIG, cmd_seq=0) == Status.READY
    assert ready.taken() == []


def test_trig_before_cmd_seq_latches_when_the_number_comes(ready: Bench) -> None:
    ready.plc(ENABLE | TRIG)
    ready.plc(ENABLE | TRIG, cmd_seq=11)
    assert ready.taken() == [Start()]


def test_a_trigger_while_busy_is_refused_and_the_cycle_goes_on(busy: Bench) -> None:
    status = busy.plc(ENABLE | TRIG, cmd_seq=11)
    assert status == Status.ACK | Status.BUSY | Status.NACK
    assert (busy.shown.latched, busy.shown.cmd_seq) == (Code.BUSY, 10)
    assert Status.VALID in busy.finish()
    assert busy.shown.cmd_seq == 10
    busy.look()
    assert busy.taken() == []


def test_an_exchanged_bin_is_a_command_without_a_cycle(ready: Bench) -> None:
    assert ready.plc(ENABLE | TRIG, cmd_seq=10, command=8) == Status.ACK | Status.VALID | Status.LAST_PAGE
    assert ready.taken() == [Forget()]
    assert (ready.shown.command, ready.shown.cmd_seq, ready.shown.cycle_id, ready.shown.code) == (8, 10, 0, Code.OK)
    assert ready.shown.echo == ECHO
    assert ready.plc(ENABLE | TRIG, cmd_seq=10, command=8) & Status.VALID        # written again by a cyclic writer
    assert ready.taken() == []
    ready.plc(ENABLE | TRIG | RES_ACK, command=8)
    assert ready.plc(ENABLE, command=8) == Status.READY


def test_an_unknown_bin_is_not_exchanged_and_a_busy_cell_exchanges_none(ready: Bench) -> None:
    ready.refuse_with = Code.UNKNOWN_ITEM
    assert ready.plc(ENABLE | TRIG, cmd_seq=10, command=8) == Status.NACK
    assert ready.shown.latched == Code.UNKNOWN_ITEM
    assert ready.plc(ENABLE) == Status.READY
    ready.refuse_with = None
    ready.plc(ENABLE | TRIG, cmd_seq=11)
    ready.taken()
    assert ready.plc(ENABLE | TRIG, cmd_seq=12, command=8) & Status.NACK
    assert ready.taken() == []
    assert ready.shown.latched == Code.BUSY


@pytest.mark.parametrize(("command", "code"), [
    (0, Code.BAD_ARGUMENT), (10, Code.BAD_ARGUMENT), *((c, Code.NOT_APPLICABLE) for c in (2, 3, 4, 6))])
def test_commands_that_do_not_exist(ready: Bench, command: int, code: Code) -> None:
    assert ready.plc(ENABLE | TRIG, cmd_seq=10, command=command) == Status.NACK
    assert (ready.shown.code, ready.shown.latched, ready.shown.cmd_seq) == (code, code, 10)
    assert ready.plc(ENABLE) == Status.READY
    assert ready.taken() == []


@pytest.mark.parametrize("code", [Code.UNKNOWN_ITEM, Code.BAD_ARGUMENT, Code.FRAME_UNAVAILABLE, Code.NO_FLANGE_POSE])
def test_what_the_cell_refuses_is_answered_and_may_be_repeated(ready: Bench, code: Code) -> None:
    ready.refuse_with = code
    assert ready.plc(ENABLE | TRIG, cmd_seq=10) == Status.NACK
    assert (ready.shown.code, ready.shown.latched) == (code, code)
    ready.look()
    assert ready.taken() == [Start()]
    ready.refuse_with = None
    assert ready.plc(ENABLE) == Status.READY
    assert Status.BUSY in ready.plc(ENABLE | TRIG)


@pytest.mark.parametrize(("facts", "ctrl", "code"), [
    ({"controlled": False, "fault": -23}, ENABLE, Code.NOT_IN_CONTROL), ({"fault": -4}, ENABLE, Code.CAMERAS),
    ({"fault": -11}, ENABLE, Code.NOT_READY), ({}, NO_CTRL, Code.NOT_READY), ({}, ENABLE | RES_ACK, Code.NOT_READY)])
def test_not_ready_is_named_and_refuses(ready: Bench, facts: dict[str, int], ctrl: Ctrl, code: Code) -> None:
    ready.cell(**facts)
    assert ready.plc(ctrl) == Status(0)
    assert ready.shown.latched == code
    assert ready.plc(ctrl | TRIG, cmd_seq=10) == Status.NACK
    assert ready.shown.code == code
    assert ready.taken() == []


def test_trig_falling_while_busy_aborts(busy: Bench) -> None:
    assert busy.plc(ENABLE) == Status.READY | Status.ERROR
    assert (busy.shown.code, busy.shown.detail, busy.shown.latched) == (-26, Detail.TRIG_FELL, -26)
    assert busy.taken() == [Withdraw("TRIG fell")]
    busy.plc(ENABLE | TRIG, cmd_seq=11)
    assert busy.status == Status.ACK | Status.BUSY


def test_trig_falling_on_an_unread_result_withdraws_it(done: Bench) -> None:
    assert done.plc(ENABLE) == Status.READY | Status.ERROR
    assert done.taken() == [Withdraw("TRIG fell")]
    assert done.shown.code == -26


def test_trig_and_res_ack_in_one_write_is_an_acknowledgement(done: Bench) -> None:
    assert done.plc(ENABLE | RES_ACK) == Status(0)
    assert done.taken() == [Acknowledge(1)]
    assert done.plc(ENABLE) == Status.READY


def test_a_res_ack_from_before_the_result_does_not_count(busy: Bench) -> None:
    busy.plc(ENABLE | TRIG | RES_ACK)
    assert Status.VALID in busy.finish()
    assert Status.VALID in busy.look()
    assert Status.VALID in busy.plc(ENABLE | TRIG)
    assert Status.VALID not in busy.plc(ENABLE | TRIG | RES_ACK)
    assert busy.taken() == [Acknowledge(1)]


def test_abort_bit(busy: Bench) -> None:
    assert busy.plc(ENABLE | TRIG | Ctrl.ABORT) == Status.ACK | Status.ERROR
    assert (busy.shown.code, busy.shown.detail) == (-26, Detail.ABORTED)
    assert busy.plc(ENABLE | TRIG | RES_ACK) == Status.ACK | Status.ERROR
    assert busy.plc(ENABLE) == Status.READY | Status.ERROR
    assert busy.taken() == [Abort(1), Acknowledge(1)]


@pytest.mark.parametrize("code", [-3, -4, -11, -26])
def test_a_failure_is_an_error_that_stays_latched_until_the_next_command(busy: Bench, code: int) -> None:
    assert busy.finish(code, grasps=0) == Status.ACK | Status.ERROR
    assert (busy.shown.code, busy.shown.latched) == (code, code)
    busy.plc(ENABLE | TRIG | RES_ACK)
    assert busy.plc(ENABLE) == Status.READY | Status.ERROR
    assert busy.shown.latched == code
    assert busy.plc(ENABLE | TRIG, cmd_seq=11) == Status.ACK | Status.BUSY
    assert busy.shown.latched == 0


def test_a_failure_needs_no_res_ack(busy: Bench) -> None:
    busy.finish(-4)
    assert Status.READY in busy.plc(ENABLE)
    assert busy.taken() == [Acknowledge(1)]


@pytest.mark.parametrize("code", [100, 101, 102, 109])
def test_a_scene_that_says_no_is_valid(busy: Bench, code: int) -> None:
    assert busy.finish(code, grasps=0) == Status.ACK | Status.ACQ_DONE | Status.VALID | Status.LAST_PAGE
    assert busy.shown.code == code


@pytest.mark.parametrize(("code", "bits"), [
    (1, Status.WARN), (2, Status.WARN | Status.CALIB_WARN), (3, Status.WARN), (0, Status(0))])
def test_warnings(busy: Bench, code: int, bits: Status) -> None:
    assert busy.finish(code) & (Status.WARN | Status.CALIB_WARN) == bits


def test_the_warning_stays_while_the_calibration_drifts(busy: Bench) -> None:
    busy.cell(drifting=True)
    assert busy.finish(101, grasps=0) & (Status.WARN | Status.CALIB_WARN) == Status.CALIB_WARN
    busy.plc(ENABLE | TRIG | RES_ACK)
    assert busy.plc(ENABLE) == Status.READY | Status.CALIB_WARN
    assert busy.cell(drifting=False) == Status.READY


@pytest.mark.parametrize(("code", "bits"), [
    (0, Status.VALID), (2, Status.VALID | Status.WARN | Status.CALIB_WARN), (-24, Status.ERROR)])
def test_command_5_looks_at_the_calibration_and_is_answered_like_a_cycle(ready: Bench, code: int, bits: Status) -> None:
    assert ready.plc(ENABLE | TRIG, cmd_seq=10, command=5) == Status.ACK | Status.BUSY
    assert ready.taken() == [Start()]
    assert ready.finish(code, grasps=0) & (Status.VALID | Status.ERROR | Status.WARN | Status.CALIB_WARN) == bits
    assert (ready.shown.command, ready.shown.code) == (5, code)
    ready.plc(ENABLE | TRIG | RES_ACK, command=5)
    assert Status.READY in ready.plc(ENABLE)


def test_a_cell_that_never_answers_ends_with_its_time_limit(busy: Bench) -> None:
    assert Status.BUSY in busy.cell(after_ms=4998)
    assert busy.cell(after_ms=2) == Status.ACK | Status.ERROR
    assert busy.shown.code == Code.TIMEOUT
    assert busy.taken() == [Abort(1)]
    busy.cell(finished=1, code=0, valid=True, grasps=3)
    assert busy.shown.code == Code.TIMEOUT
    assert Status.VALID not in busy.status


def test_valid_falls_with_a_code_when_the_cell_withdraws(done: Bench) -> None:
    assert done.cell(valid=False) == Status.ACK | Status.ACQ_DONE | Status.ERROR
    assert (done.shown.code, done.shown.detail) == (-26, Detail.WITHDRAWN)
    assert done.plc(ENABLE) == Status.READY | Status.ERROR


def test_a_result_of_another_cycle_is_never_taken_for_mine(busy: Bench) -> None:
    assert busy.cell(current=0, finished=2, code=0, valid=True, grasps=3) == Status.ACK | Status.ERROR
    assert (busy.shown.code, busy.shown.detail) == (-26, Detail.WITHDRAWN)


def test_triggering_again_replaces_an_unread_result(done: Bench) -> None:
    assert done.plc(ENABLE | TRIG, cmd_seq=11) == Status.ACK | Status.BUSY
    assert (done.shown.cmd_seq, done.shown.cycle_id) == (11, 2)
    assert done.taken() == [Start()]


def test_a_refused_retrigger_leaves_the_unread_result(done: Bench) -> None:
    done.refuse_with = Code.UNKNOWN_ITEM
    done.plc(ENABLE | TRIG, cmd_seq=11)
    assert Status.VALID | Status.NACK in done.status
    assert (done.shown.cmd_seq, done.shown.latched) == (10, -22)


def test_pages_turn_on_the_rising_edge_up_to_the_last() -> None:
    bench = Bench()
    bench.plc(ENABLE)
    bench.plc(ENABLE | TRIG, cmd_seq=1)
    assert Status.LAST_PAGE not in bench.finish(grasps=9)
    pages = []
    for _ in range(4):
        bench.plc(ENABLE | TRIG | NEXT_PAGE)
        bench.plc(ENABLE | TRIG | NEXT_PAGE)
        pages.append((bench.shown.page, Status.LAST_PAGE in bench.status))
        bench.plc(ENABLE | TRIG)
    assert pages == [(1, False), (2, True), (2, True), (2, True)]


@pytest.mark.parametrize("finished", [False, True])
def test_a_lost_connection_counts_as_trig_falling_after_a_while(busy: Bench, finished: bool) -> None:
    if finished:
        busy.finish()
    before = busy.plc(ENABLE | TRIG, connected=False)
    assert busy.cell(after_ms=1999) == before
    assert busy.cell(after_ms=1) == Status.ACK | Status.ERROR
    assert (busy.shown.code, busy.shown.detail) == (-26, Detail.CONNECTION_LOST)
    assert busy.taken() == [Withdraw("the controller's connection was lost")]
    assert busy.plc(ENABLE | TRIG, cmd_seq=11, connected=True) & Status.NACK
    assert Status.READY in busy.plc(ENABLE)


def test_a_connection_that_comes_back_in_time_changes_nothing(busy: Bench) -> None:
    busy.plc(ENABLE | TRIG, connected=False)
    busy.cell(after_ms=1500)
    busy.plc(ENABLE | TRIG, connected=True)
    assert busy.cell(after_ms=1500) == Status.ACK | Status.BUSY


@pytest.mark.parametrize("finished", [False, True])
def test_a_stopped_heartbeat_aborts(ready: Bench, finished: bool) -> None:
    ready.plc(ENABLE | TRIG, cmd_seq=10, heartbeat=1)
    ready.taken()
    if finished:
        ready.finish()
    ready.plc(ENABLE | TRIG, heartbeat=2, after_ms=1990)
    before = ready.cell(after_ms=2000)
    assert before & (Status.BUSY | Status.VALID)
    assert ready.cell(after_ms=1) == Status.ACK | Status.ERROR
    assert ready.shown.detail == Detail.HEARTBEAT_STOPPED
    assert ready.taken() == [Withdraw("the controller's heartbeat stopped")]
    assert Status.READY not in ready.plc(ENABLE)
    assert Status.READY in ready.plc(ENABLE, heartbeat=3)


def test_a_heartbeat_that_is_zero_is_not_monitored(ready: Bench) -> None:
    assert ready.cell(after_ms=100_000) == Status.READY


@pytest.mark.parametrize(("phase", "withdrawn"), [("ready", 0), ("busy", 1), ("done", 1)])
def test_clear_err_from_every_state(phase: str, withdrawn: int, request: pytest.FixtureRequest) -> None:
    bench: Bench = request.getfixturevalue(phase)
    assert bench.plc(ENABLE | Ctrl.CLEAR_ERR) == Status.READY
    assert bench.shown.latched == 0
    assert len(bench.taken()) == withdrawn
    assert Status.BUSY in bench.plc(ENABLE | Ctrl.CLEAR_ERR | TRIG, cmd_seq=12)


def test_clear_err_with_trig_still_high_waits_for_it(busy: Bench) -> None:
    assert busy.plc(ENABLE | TRIG | Ctrl.CLEAR_ERR) == Status.ACK
    assert busy.taken() == [Withdraw("the controller cleared errors")]
    assert busy.plc(ENABLE) == Status.READY


def test_the_clear_command_ends_without_a_result(busy: Bench) -> None:
    busy.finish(-4)
    busy.plc(ENABLE)
    assert Status.ERROR in busy.status
    busy.taken()
    assert busy.plc(ENABLE | TRIG, cmd_seq=11, command=9) == Status.ACK | Status.VALID | Status.LAST_PAGE
    assert (busy.shown.code, busy.shown.cycle_id, busy.shown.cmd_seq, busy.shown.latched) == (0, 0, 11, 0)
    busy.plc(ENABLE | TRIG | RES_ACK, command=9)
    assert busy.plc(ENABLE) == Status.READY
    assert busy.taken() == []


def test_an_outcome_is_reported_once_per_strobe_and_content(ready: Bench) -> None:
    strobe = ENABLE | Ctrl.FEEDBACK_STROBE
    for feedback in ((5, 1, 1), (5, 1, 1), (5, 2, 3)):
        ready.plc(strobe, feedback=feedback)
    assert ready.taken() == [Report(5, 1, 1), Report(5, 2, 3)]
    ready.plc(ENABLE)
    ready.plc(strobe)
    assert ready.taken() == [Report(5, 2, 3)]
    ready.state = handshake.unreported(ready.state, Code.NOT_APPLICABLE)
    assert ready.shown.latched == -8


def test_the_cell_shows_through(ready: Bench) -> None:
    assert ready.cell(degraded=True, simulated=True) == Status.READY | Status.DEGRADED | Status.SIM


def test_facts_of_a_snapshot() -> None:
    assert Facts.of(Snapshot(boot_id=1, phase="ready", owner="modbus")).fault == 0
    assert Facts.of(Snapshot(boot_id=1, phase="computing", owner="modbus")).fault == Code.BUSY
    assert Facts.of(Snapshot(boot_id=1, phase="starting", owner="modbus")).fault == Code.NOT_READY
    lost = Snapshot(boot_id=1, phase="starting", owner="modbus", cameras=(CameraStatus("left", False, error="dead"),))
    assert Facts.of(lost).fault == Code.CAMERAS
    simulated = failure(1, Request(), Code.BIN_EMPTY, simulated=True)
    held = Published(simulated, simulated.json_bytes(), 0)
    for valid in (True, False):     # the result's own mark counts, whatever the cameras have become since
        shown = Snapshot(boot_id=1, phase="ready", owner="modbus", latest=held, published=held, valid=valid)
        assert Facts.of(shown).simulated is valid
    foreign = Facts.of(Snapshot(boot_id=1, phase="ready", owner="rest"))
    assert (foreign.controlled, foreign.fault) == (False, Code.NOT_IN_CONTROL)


EVENTS = st.one_of(
    st.builds(lambda bits, seq, command: ("plc", Ctrl(bits), seq, command),
              st.integers(0, 255), st.integers(0, 4), st.sampled_from([1, 1, 1, 9, 3, 77])),
    st.builds(lambda ms, beat, connected: ("time", ms, beat, connected),
              st.sampled_from([1, 50, 1900, 2100, 6000]), st.integers(0, 3), st.booleans()),
    st.builds(lambda code, grasps: ("finish", code, grasps), st.sampled_from([0, 1, 102, -4, -3]), st.integers(0, 9)),
    st.sampled_from([("acquired",), ("expire",), ("refuse",), ("fault",), ("well",)]))


def play(bench: Bench, event: tuple[object, ...]) -> None:
    """One random event; a cell that computes may finish, be refused to, or fall ill at any time."""
    facts = bench.inputs.facts
    match event:
        case ("plc", Ctrl() as ctrl, int(seq), int(command)):
            bench.plc(ctrl, cmd_seq=seq, command=command, feedback=(seq, 1, 1))
        case ("time", int(ms), int(beat), bool(connected)):
            bench.inputs = replace(bench.inputs, heartbeat=beat, connected=connected)
            bench.cell(after_ms=ms)
        case ("finish", int(code), int(grasps)) if facts.current:
            bench.finish(code, grasps if 0 <= code <= 3 else 0)
        case ("acquired",) if facts.current:
            bench.cell(acquired=True)
        case ("expire",):
            bench.cell(valid=False)
        case ("refuse",):
            bench.refuse_with = None if bench.refuse_with else Code.UNKNOWN_ITEM
        case ("fault",):
            bench.cell(fault=-4)
        case ("well",):
            bench.cell(fault=0)


def judge(bench: Bench, before: State, cmd_seq_of: dict[int, int]) -> None:
    """What must hold after every event."""
    status, shown = bench.status, bench.shown
    for action in bench.taken():
        if isinstance(action, Start):
            assert before.phase in (Phase.IDLE, Phase.DONE)
            if bench.state.phase is Phase.BUSY:
                assert bench.state.cycle_id not in cmd_seq_of
                cmd_seq_of[bench.state.cycle_id] = bench.inputs.cmd_seq
    alone = (Status.READY, Status.BUSY, Status.VALID)
    assert sum(bit in status for bit in alone) <= 1
    assert not (Status.VALID in status and Status.ERROR in status)
    assert (Status.VALID in status) <= (shown.code >= 0)
    assert (Status.BUSY in status) <= (Status.ACK in status)
    if shown.cycle_id and status & (Status.VALID | Status.BUSY):
        assert cmd_seq_of[shown.cycle_id] == shown.cmd_seq
    assert (Status.READY in status) <= (Ctrl.ENABLE in bench.inputs.ctrl and RES_ACK not in bench.inputs.ctrl)
    assert shown.page * 4 < max(bench.state.grasps, 1)
    if bench.state.phase is Phase.BUSY:
        assert bench.inputs.now_ns < bench.state.deadline_ns
        assert TRIG in bench.inputs.ctrl
    if bench.state.phase in (Phase.START, Phase.IDLE) and Status.READY not in status:
        assert shown.latched < 0


@settings(max_examples=300, deadline=None, derandomize=True)
@given(st.lists(EVENTS, max_size=40))
def test_whatever_happens_clear_err_with_low_levels_reaches_ready(events: list[tuple[object, ...]]) -> None:
    bench = Bench()
    cmd_seq_of: dict[int, int] = {}
    for event in events:
        before = bench.state
        play(bench, event)
        judge(bench, before, cmd_seq_of)
    bench.inputs = replace(bench.inputs, connected=True, heartbeat=0)
    bench.plc(ENABLE)
    bench.plc(ENABLE | Ctrl.CLEAR_ERR)
    if bench.inputs.facts.fault:
        assert bench.shown.latched == bench.inputs.facts.fault
        bench.cell(fault=0)
    assert Status.READY in bench.status
    assert not bench.status & (Status.ERROR | Status.NACK | Status.VALID | Status.BUSY)
    bench.refuse_with = None
    assert Status.BUSY in bench.plc(ENABLE | TRIG, cmd_seq=9)
