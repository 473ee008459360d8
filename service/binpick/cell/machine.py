"""The cell as a pure state machine: one cycle at a time, every step a function from a frozen state to the next.

A cycle is named by its id. The worker thread that computes it cannot be cancelled, so time limit, abort and disconnect
*retire the id*: its failure is published at once, the worker keeps the only slot until it comes back, and whatever it brings
back is dropped and counted.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from binpick.calibration import Installed, SampleRequest
from binpick.data import CameraStatus
from binpick.errors import Busy, Code, InputError, NotApplicable, NotReady
from binpick.message import Verify
from binpick.outcomes import Memory
from binpick.result import Drift, Owner, Phase, Published, Request, Snapshot, failure
from binpick.rigcheck.guard import Guard
from binpick.settings import Job

KEPT = 16
"""Finished results in memory, and the ones whose outcomes may be reported."""
OUTCOMES = range(1, 8)
"""1 ok, 2 missed, 3 dropped, 4 collision, 5 skipped, 6 double, 7 unreachable."""
TRIGGERED_AGAIN, ACKNOWLEDGED = "triggered again", "acknowledged"
"""Ends of a result that its controller brought about."""


@dataclass(frozen=True, slots=True)
class Ticket:
    """The cycle that occupies the slot; `retired` once its id counts no more though the worker still holds it.

    `sample`: it takes a pair of images of a board and computes no grasps; `verify`: it looks at the calibration alone. `aside`:
    by somebody who does not control the cell; its result is kept, but does not take the published one's place.
    """

    cycle_id: int
    request: Request
    job: Job
    started_ns: int
    deadline_ns: int
    acquired: bool = False
    retired: bool = False
    sample: SampleRequest | None = None
    verify: Verify | None = None
    aside: bool = False


@dataclass(frozen=True, slots=True)
class State:
    """All that the cell knows; times are the host's monotonic clock.

    `memories` are by bin; `exchanged` is the last cycle that saw a bin's predecessor. `rig` and `guard` are what the next cycle
    and its watchdog start from, `drift` is what people are told; `held`: why none may start though the cameras are up.
    """

    max_age_ns: int
    cameras: tuple[CameraStatus, ...] = ()
    stopping: bool = False
    last_id: int = 0
    ticket: Ticket | None = None
    published: Published | None = None
    valid: bool = False
    withdrawn: str = ""
    finished: tuple[Published, ...] = ()
    outcomes: Mapping[tuple[int, int], int] = field(default_factory=lambda: MappingProxyType({}))
    memories: Mapping[int, Memory] = field(default_factory=lambda: MappingProxyType({}))
    guard: Guard | None = None
    drift: Drift | None = None
    exchanged: Mapping[int, int] = field(default_factory=lambda: MappingProxyType({}))
    rig: Installed | None = None
    held: str = ""
    faults: tuple[str, ...] = ()
    counts: Mapping[str, int] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def running(self) -> Ticket | None:
        """The cycle in flight, or None."""
        return self.ticket if self.ticket is not None and not self.ticket.retired else None

    @property
    def installed(self) -> Installed:
        """The rig in use; a cell has one from its start."""
        assert self.rig is not None
        return self.rig

    @property
    def cameras_up(self) -> bool:
        """Every camera of the rig answers."""
        return bool(self.cameras) and all(camera.connected for camera in self.cameras)

    @property
    def simulated(self) -> bool:
        """Some camera does not look at the real world."""
        return any(camera.simulated for camera in self.cameras)

    @property
    def phase(self) -> Phase:
        """"starting" is every not-ready that can end by itself: cameras down, a retired cycle still in the slot, or held."""
        if self.stopping:
            return "stopping"
        if self.running is not None:
            return "computing" if self.running.acquired else "acquiring"
        return "ready" if self.cameras_up and self.ticket is None and not self.held else "starting"


def start(state: State, request: Request, job: Job, now_ns: int, timeout_ns: int, sample: SampleRequest | None = None,
          verify: Verify | None = None, aside: bool = False) -> State:
    """Takes the slot; `last_id` of the new state names the cycle. What was published is withdrawn.

    Raises NotReady, Busy: the state is unchanged then.
    """
    if state.stopping:
        raise NotReady("the cell is stopping")
    if state.held:
        raise Busy(f"{state.held}: trigger again when the cell is ready")
    if state.ticket is not None:
        raise Busy(f"cycle {state.ticket.cycle_id} is running; nothing is queued: trigger again when the cell is ready"
                   if not state.ticket.retired else
                   f"cycle {state.ticket.cycle_id} was withdrawn and is still being cleared away: trigger again when the cell "
                   "is ready")
    if not state.cameras_up:
        raise NotReady("the cell is not ready: " + (_cameras_down(state) or "the cameras are being opened"))
    state = invalidate(state, TRIGGERED_AGAIN)
    cycle_id = state.last_id + 1
    ticket = Ticket(cycle_id, request, job, now_ns, now_ns + timeout_ns, sample=sample, verify=verify, aside=aside)
    return _count(replace(state, last_id=cycle_id, ticket=ticket), "started")


def invalidate(state: State, why: str) -> State:
    """The published result holds no longer."""
    return replace(state, valid=False, withdrawn=why) if state.valid else state


def refused(state: State) -> State:
    """A trigger was turned away."""
    return _count(state, "refused")


def acquired(state: State, cycle_id: int) -> State:
    """The pair was accepted; nothing happens for an id that is retired."""
    if state.running is None or state.running.cycle_id != cycle_id:
        return state
    return replace(state, ticket=replace(state.running, acquired=True))


def finish(state: State, cycle_id: int, published: Published | None, fault: str = "") -> State:
    """The worker came back and the slot is free; None when it brings nothing because its id was retired meanwhile.

    A result of a retired id is dropped and counted. `fault`, or that the last gate had to stop a pose, stays latched until a
    cycle ends well.
    """
    retired = state.running is None or state.running.cycle_id != cycle_id
    aside = state.ticket is not None and state.ticket.aside
    if state.ticket is not None and state.ticket.cycle_id == cycle_id:
        state = replace(state, ticket=None)
    if published is None:
        return state
    if retired:
        return _count(state, "late")
    if published.result.return_code.code is Code.CAMERAS:
        state = _count(state, "camera_failures")
    if fault:
        state = _count(state, "internal_errors")
    if stopped := published.result.stopped:
        state = _count(state, "gate_stopped", sum(stopped.values()))
        fault = "the last gate stopped " + ", ".join(f"{count} {why.replace('_', ' ')}" for why, count in stopped.items())
    if fault or published.result.return_code.value >= 0:
        state = replace(state, faults=(fault,) if fault else ())
    return _publish(state, published, aside)


def complete(state: State, fuller: Published) -> State:
    """A finished result says more than it did; whether it holds does not change. Nothing happens for one no longer kept."""
    was = find(state, fuller.result.cycle_id)
    if was is None:
        return state
    finished = tuple(fuller if each is was else each for each in state.finished)
    return replace(state, finished=finished, published=fuller if state.published is was else state.published)


def abort(state: State, cycle_id: int, now_ns: int, why: str = "") -> State:
    """Retires the running cycle (−26). Raises NotApplicable when that cycle is not running."""
    if state.running is None or state.running.cycle_id != cycle_id:
        raise NotApplicable(f"cycle {cycle_id} is not running")
    return _count(_retire(state, Code.ABORTED, now_ns, why), "aborted")


def acknowledge(state: State, cycle_id: int) -> State:
    """The controller has read the result. Raises NotApplicable unless exactly that one is published and valid."""
    if not state.valid or state.published is None or state.published.result.cycle_id != cycle_id:
        raise NotApplicable(f"the result of cycle {cycle_id} is not waiting to be acknowledged")
    return _count(invalidate(state, ACKNOWLEDGED), "acknowledged")


def withdraw(state: State, reason: str, now_ns: int) -> State:
    """Takes back what runs and what is published; nothing happens when there is neither."""
    if state.running is not None:
        state = _count(_retire(state, Code.ABORTED, now_ns, f"The cycle was withdrawn: {reason}."), "aborted")
        return invalidate(state, reason)
    return _count(invalidate(state, reason), "withdrawn") if state.valid else state


def report(state: State, cycle_id: int, grasp: int, outcome: int) -> State:
    """What became of a grasp; saying it twice changes nothing, a later word replaces the earlier one.

    Raises NotApplicable for a cycle no longer kept or a grasp it does not have, InputError for an unknown outcome.
    """
    if outcome not in OUTCOMES:
        raise InputError(f"outcome {outcome} is unknown: 1 ok, 2 missed, 3 dropped, 4 collision, 5 skipped, 6 double, "
                         "7 unreachable")
    kept = find(state, cycle_id)
    if kept is None or grasp not in {g.number for g in kept.result.grasps}:
        raise NotApplicable(f"there is no grasp {grasp} of cycle {cycle_id} among the last {KEPT} results")
    if state.outcomes.get((cycle_id, grasp)) == outcome:
        return state
    return replace(state, outcomes=MappingProxyType({**state.outcomes, (cycle_id, grasp): outcome}))


def tick(state: State, now_ns: int) -> State:
    """Enforces the cycle's deadline (−3) and the age of the published result; does nothing before `due`."""
    if state.running is not None and now_ns >= state.running.deadline_ns:
        state = _count(_retire(state, Code.TIMEOUT, now_ns), "timeouts")
    if state.valid and state.published is not None and now_ns >= state.published.triggered_ns + state.max_age_ns:
        state = _count(invalidate(state, f"older than {state.max_age_ns // 1_000_000} ms"), "expired")
    return state


def due(state: State) -> int | None:
    """When `tick` has something to do next, or None."""
    instants = []
    if state.running is not None:
        instants.append(state.running.deadline_ns)
    if state.valid and state.published is not None:
        instants.append(state.published.triggered_ns + state.max_age_ns)
    return min(instants, default=None)


def observe(state: State, cameras: tuple[CameraStatus, ...]) -> State:
    """What the cameras say of themselves now."""
    return state if cameras == state.cameras else replace(state, cameras=cameras)


def stumble(state: State, fault: str) -> State:
    """Something of ours failed outside a cycle; stays latched until a cycle ends well."""
    return _count(replace(state, faults=(fault,)), "internal_errors")


def alarm(state: State, fault: str) -> State:
    """Something wants attention though cycles run; stays latched until one ends well."""
    return replace(state, faults=(fault,))


def stop(state: State, now_ns: int) -> State:
    """Nothing is ready any more, and what runs or holds is withdrawn."""
    return replace(withdraw(state, "the cell is stopping", now_ns), stopping=True)


def find(state: State, cycle_id: int) -> Published | None:
    """A finished cycle still in memory."""
    return next((p for p in reversed(state.finished) if p.result.cycle_id == cycle_id), None)


def snapshot(state: State, boot_id: int, owner: Owner) -> Snapshot:
    """The state as the interfaces show it."""
    running = state.running
    return Snapshot(
        boot_id=boot_id, phase=state.phase, current=running.cycle_id if running else 0,
        acquired=running.acquired if running else False,
        published=state.published, valid=state.valid, withdrawn=state.withdrawn,
        latest=state.finished[-1] if state.finished else None, cameras=state.cameras, faults=state.faults, owner=owner,
        simulated=state.simulated, counts=tuple(sorted(state.counts.items())), drift=state.drift,
        rig=state.rig.told if state.rig is not None else None, rig_note=state.rig.note if state.rig is not None else "")


def _retire(state: State, code: Code, now_ns: int, why: str = "") -> State:
    """The running cycle's id counts no more; its failure is what it leaves behind. Its age counts from now."""
    ticket = state.running
    assert ticket is not None
    result = failure(ticket.cycle_id, ticket.request, code, why, simulated=state.simulated)
    state = replace(state, ticket=replace(ticket, retired=True))
    return _publish(state, Published(result, result.json_bytes(), triggered_ns=now_ns), ticket.aside)


def _publish(state: State, published: Published, aside: bool = False) -> State:
    finished = (*state.finished, published)[-KEPT:]
    oldest = finished[0].result.cycle_id
    outcomes = MappingProxyType({key: value for key, value in state.outcomes.items() if key[0] >= oldest})
    state = replace(state, finished=finished, outcomes=outcomes)
    if not aside:
        state = replace(state, published=published, valid=True, withdrawn="")
    return _count(state, "finished")


def _count(state: State, name: str, by: int = 1) -> State:
    return replace(state, counts=MappingProxyType({**state.counts, name: state.counts.get(name, 0) + by}))


def _cameras_down(state: State) -> str:
    return "; ".join(f"camera {c.name}: {c.error}" for c in state.cameras if not c.connected and c.error)
