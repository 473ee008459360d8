"""The Modbus handshake as a pure state machine: levels of the control word in, the cell's state in, signals and actions out.

args, cmd_seq, TRIG -> ACK, BUSY -> ACQ_DONE -> VALID (or ERROR), BUSY = 0 -> RES_ACK -> VALID = 0 -> both fall -> READY

`step` is called at every write, at every new snapshot and ten times a second; time comes in as an argument. A failed or refused
command ends in the same way as a good one: TRIG and RES_ACK fall; ERROR and the latched code stay for CLEAR_ERR or for the
next accepted command.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from typing import TypeAlias

from binpick.errors import Code
from binpick.publish.exchange import NO_CTRL, Abort, Acknowledge, Action, Facts, Forget, Inputs, Report, Start, Withdraw
from binpick.publish.image import NO_ECHO, NO_STATUS, Echo, Signals
from binpick.publish.registers import PAGE_SIZE, Ctrl, Detail, Status

HEARTBEAT_NS = 2_000_000_000
COMMANDS = range(1, 10)
PICK, VERIFY, SAMPLE, EXCHANGED, CLEAR = 1, 5, 7, 8, 9
REASONS = {
    Detail.TRIG_FELL: "TRIG fell", Detail.CONNECTION_LOST: "the controller's connection was lost",
    Detail.HEARTBEAT_STOPPED: "the controller's heartbeat stopped", Detail.CLEARED: "the controller cleared errors",
}


class Phase(Enum):
    """START waits for TRIG = RES_ACK = 0 to be written; CLOSING waits for it after a command; DONE holds what came of it."""

    START = "start"
    IDLE = "idle"
    BUSY = "busy"
    DONE = "done"
    CLOSING = "closing"


@dataclass(frozen=True, slots=True)
class State:
    """The handshake between two steps. `accepted` is the last latched cmd_seq, ignored from then on however often it is
    written; `turned_away` the last refused one, ignored until TRIG falls. `acknowledgeable`: RES_ACK was seen low since DONE.
    """

    phase: Phase = Phase.START
    cmd_seq: int = 0
    command: int = 0
    cycle_id: int = 0
    echo: Echo = NO_ECHO
    code: int = Code.NOT_READY.value
    detail: Detail = Detail.NONE
    acquired: bool = False
    grasps: int = 0
    page: int = 0
    nack: bool = False
    error: bool = False
    latched: int = 0
    deadline_ns: int = 0
    acknowledgeable: bool = False
    accepted: int = 0
    turned_away: int = 0
    reported: tuple[int, int, int] | None = None
    last_ctrl: Ctrl = NO_CTRL
    heartbeat: int = 0
    heartbeat_ns: int = 0
    lost_ns: int | None = None


Step: TypeAlias = tuple[State, tuple[Action, ...]]


def step(state: State, inputs: Inputs) -> Step:
    """The next state and what is to be done now, in this order."""
    state = _observed(state, inputs)
    if Ctrl.CLEAR_ERR in inputs.ctrl & ~state.last_ctrl:
        state, actions = _cleared(state, inputs)
    else:
        state, actions = _PHASES[state.phase](state, inputs)
    state = _next_page(state, inputs)
    if not actions:
        state, actions = _trigger(state, inputs)
    state, reports = _feedback(state, inputs)
    # RES_ACK counts only if it rises on this result: one that was already high acknowledged something else.
    unread = state.phase is Phase.DONE and (state.acknowledgeable or not inputs.res_ack)
    return replace(state, last_ctrl=inputs.ctrl, acknowledgeable=unread), (*actions, *reports)


def started(state: State, inputs: Inputs, cycle_id: int, echo: Echo, deadline_ns: int) -> State:
    """The cell took the cycle; it must have ended by the deadline."""
    return replace(state, phase=Phase.BUSY, cmd_seq=inputs.cmd_seq, command=inputs.command, accepted=inputs.cmd_seq,
                   cycle_id=cycle_id, echo=echo, code=Code.BUSY.value, detail=Detail.NONE, acquired=False, grasps=0, page=0,
                   nack=False, error=False, latched=0, deadline_ns=deadline_ns, acknowledgeable=False, turned_away=0)


def done(state: State, inputs: Inputs, echo: Echo = NO_ECHO) -> State:
    """A command without a cycle was carried out."""
    return replace(started(state, inputs, 0, echo, 0), phase=Phase.DONE, code=Code.OK.value)


def refused(state: State, inputs: Inputs, code: Code) -> State:
    """A command was turned away: NACK until TRIG falls. A cycle that runs or is unread goes on as if nothing had happened."""
    state = replace(state, nack=True, latched=code.value, turned_away=inputs.cmd_seq)
    if state.phase in (Phase.BUSY, Phase.DONE):
        return state
    return replace(state, phase=Phase.CLOSING, cmd_seq=inputs.cmd_seq, command=inputs.command, cycle_id=0, echo=NO_ECHO,
                   code=code.value, detail=Detail.NONE, acquired=False)


def unreported(state: State, code: Code) -> State:
    """The cell did not know the grasp of an outcome."""
    return replace(state, latched=code.value)


def signals(state: State, inputs: Inputs) -> Signals:
    """What the registers show in this state."""
    done, facts = state.phase is Phase.DONE, inputs.facts
    valid = done and state.code >= 0
    fault = _fault(state, inputs)
    status = {
        Status.READY: state.phase is Phase.IDLE and not fault,
        Status.ACK: done or state.phase is Phase.BUSY or (state.phase is Phase.CLOSING and inputs.trig and not state.nack),
        Status.NACK: state.nack,
        Status.BUSY: state.phase is Phase.BUSY,
        Status.ACQ_DONE: state.acquired and state.phase in (Phase.BUSY, Phase.DONE),
        Status.VALID: valid,
        Status.ERROR: state.error,
        Status.WARN: valid and 1 <= state.code <= 3,
        Status.LAST_PAGE: valid and (state.page + 1) * PAGE_SIZE >= state.grasps,
        Status.CALIB_WARN: facts.drifting or (valid and state.code == Code.CALIBRATION_WARNING),
        Status.DEGRADED: facts.degraded,
        Status.SIM: facts.simulated,
    }
    bits = NO_STATUS
    for bit, on in status.items():
        bits |= bit if on else NO_STATUS
    waiting = state.phase in (Phase.START, Phase.IDLE)
    return Signals(status=bits, cmd_seq=state.cmd_seq, command=state.command, cycle_id=state.cycle_id, code=state.code,
                   detail=state.detail, page=state.page, latched=state.latched or (fault if waiting else 0), echo=state.echo)


def _observed(state: State, inputs: Inputs) -> State:
    """Heartbeat, connection, and the falling of TRIG, which ends a refusal."""
    if inputs.heartbeat != state.heartbeat:
        state = replace(state, heartbeat=inputs.heartbeat, heartbeat_ns=inputs.now_ns)
    if inputs.connected:
        state = replace(state, lost_ns=None)
    elif state.lost_ns is None:
        state = replace(state, lost_ns=inputs.now_ns)
    return state if inputs.trig else replace(state, nack=False, turned_away=0)


def _beating(state: State, inputs: Inputs) -> bool:
    return state.heartbeat == 0 or inputs.now_ns - state.heartbeat_ns <= HEARTBEAT_NS


def _fault(state: State, inputs: Inputs) -> int:
    """Why a pick would be refused now; 0 when it would not."""
    if not inputs.facts.controlled:
        return inputs.facts.fault
    if Ctrl.ENABLE not in inputs.ctrl or inputs.res_ack or not _beating(state, inputs) or state.phase is Phase.START:
        return Code.NOT_READY.value
    return inputs.facts.fault


def _departure(state: State, inputs: Inputs) -> Detail:
    """Why the controller counts as gone; NONE when it does not."""
    if not inputs.trig:
        return Detail.TRIG_FELL
    if state.lost_ns is not None and inputs.now_ns - state.lost_ns >= inputs.reconnect_ns:
        return Detail.CONNECTION_LOST
    return Detail.NONE if _beating(state, inputs) else Detail.HEARTBEAT_STOPPED


def _start(state: State, inputs: Inputs) -> Step:
    # Memory starts as zeros: only a control word that was really written proves that TRIG is low.
    return (replace(state, phase=Phase.IDLE) if inputs.written and inputs.low else state), ()


def _idle(state: State, _inputs: Inputs) -> Step:
    return state, ()


def _busy(state: State, inputs: Inputs) -> Step:
    facts = inputs.facts
    if departure := _departure(state, inputs):
        return _close(_fail(state, Code.ABORTED, departure), inputs), (Withdraw(REASONS[departure]),)
    if facts.finished >= state.cycle_id:
        return _ended(state, facts), ()
    if Ctrl.ABORT in inputs.ctrl:
        return _fail(state, Code.ABORTED, Detail.ABORTED), (Abort(state.cycle_id),)
    if inputs.now_ns >= state.deadline_ns:
        return _fail(state, Code.TIMEOUT), (Abort(state.cycle_id),)
    return replace(state, acquired=state.acquired or (facts.acquired and facts.current == state.cycle_id)), ()


def _ended(state: State, facts: Facts) -> State:
    if facts.finished > state.cycle_id or not facts.valid:
        return _fail(state, Code.ABORTED, Detail.WITHDRAWN)
    if facts.code < 0:
        return _fail(state, Code(facts.code))
    # A scene was judged, so its pair was accepted, even if both happened between two steps.
    return replace(state, phase=Phase.DONE, code=facts.code, detail=facts.detail, grasps=facts.grasps, acquired=True)


def _done(state: State, inputs: Inputs) -> Step:
    held = inputs.facts.valid and inputs.facts.finished == state.cycle_id
    if inputs.res_ack and state.acknowledgeable:
        return _close(state, inputs), (Acknowledge(state.cycle_id),) if held else ()
    if departure := _departure(state, inputs):
        if state.code < 0:
            return _close(state, inputs), (Acknowledge(state.cycle_id),) if held else ()
        state = _fail(state, Code.ABORTED, departure) if state.cycle_id else state
        return _close(state, inputs), (Withdraw(REASONS[departure]),) if held else ()
    if state.code >= 0 and state.cycle_id and not held:
        return _fail(state, Code.ABORTED, Detail.WITHDRAWN), ()
    return state, ()


def _closing(state: State, inputs: Inputs) -> Step:
    return _close(state, inputs), ()


_PHASES: dict[Phase, Callable[[State, Inputs], Step]] = {
    Phase.START: _start, Phase.IDLE: _idle, Phase.BUSY: _busy, Phase.DONE: _done, Phase.CLOSING: _closing}


def _close(state: State, inputs: Inputs) -> State:
    return replace(state, phase=Phase.IDLE if inputs.low else Phase.CLOSING, grasps=0, page=0)


def _fail(state: State, code: Code, detail: Detail = Detail.NONE) -> State:
    return replace(state, phase=Phase.DONE, code=code.value, detail=detail, error=True, latched=code.value, grasps=0, page=0)


def _cleared(state: State, inputs: Inputs) -> Step:
    """Whatever there was is over: back to IDLE as soon as TRIG and RES_ACK are low."""
    unfinished = state.phase in (Phase.BUSY, Phase.DONE)
    if state.phase is Phase.BUSY or (state.phase is Phase.DONE and state.code >= 0):
        state = _fail(state, Code.ABORTED, Detail.CLEARED)
    state = replace(state, error=False, latched=0, nack=False)
    if state.phase in (Phase.START, Phase.IDLE):
        return _PHASES[state.phase](state, inputs)
    return _close(state, inputs), (Withdraw(REASONS[Detail.CLEARED]),) if unfinished else ()


def _next_page(state: State, inputs: Inputs) -> State:
    rising = Ctrl.NEXT_PAGE in inputs.ctrl & ~state.last_ctrl
    more = (state.page + 1) * PAGE_SIZE < state.grasps
    return replace(state, page=state.page + 1) if rising and more and state.phase is Phase.DONE else state


def _trigger(state: State, inputs: Inputs) -> Step:
    """Latches a new command, or turns it away at once."""
    known = (0, state.accepted, state.turned_away)
    if not inputs.trig or inputs.cmd_seq in known or state.phase is Phase.START:
        return state, ()
    if code := _refusal(state, inputs):
        return refused(state, inputs, code), ()
    if inputs.command in (PICK, VERIFY, SAMPLE, EXCHANGED):
        return state, (Forget() if inputs.command == EXCHANGED else Start(),)
    held = state.phase is Phase.DONE and inputs.facts.valid
    return done(state, inputs), (Withdraw(REASONS[Detail.CLEARED]),) if held else ()


def _refusal(state: State, inputs: Inputs) -> Code:
    """Why a new command is turned away; OK when it is not."""
    if state.phase in (Phase.BUSY, Phase.CLOSING):
        return Code.BUSY if state.phase is Phase.BUSY else Code.NOT_READY
    if inputs.command not in COMMANDS:
        return Code.BAD_ARGUMENT
    if inputs.command not in (PICK, VERIFY, SAMPLE, EXCHANGED, CLEAR):
        return Code.NOT_APPLICABLE
    return Code(_fault(state, inputs))


def _feedback(state: State, inputs: Inputs) -> Step:
    """One report for one strobe, and another when its numbers change while the strobe stays high."""
    if Ctrl.FEEDBACK_STROBE not in inputs.ctrl:
        return replace(state, reported=None), ()
    if state.reported == inputs.feedback:
        return state, ()
    return replace(state, reported=inputs.feedback), (Report(*inputs.feedback),)
