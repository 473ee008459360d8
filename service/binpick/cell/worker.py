"""The thread that owns the cameras and computes cycles; whatever happens in one, it is there for the next."""

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

from binpick.calibration import SampleAnswer, SampleRequest
from binpick.camera.base import Clock, MonotonicNs, remaining_s
from binpick.cell import machine, watchdog
from binpick.cell import memory as memories
from binpick.cell.board import Board
from binpick.cell.calibration import Calibration
from binpick.cell.gallery import Gallery
from binpick.cell.logbook import Logbook
from binpick.cell.machine import State, Ticket
from binpick.cell.meter import Meter
from binpick.cycle import CycleInput, CycleResult
from binpick.data import CameraStatus, Light, StereoPair
from binpick.errors import BinpickError, CameraError, Code, CycleAborted, CycleTimeout, PairRefused
from binpick.recording import Recorder
from binpick.result import Published, Result, failure
from binpick.rig import Rig

OPEN_LIMIT_S = 5.0
"""For one attempt to open all cameras: each needs about one second, a dead one two."""
BACKOFF_S = (0.5, 1.0, 2.0, 5.0)
"""Waits between attempts to open the cameras."""
WATCH_S = 0.25
"""How often an idle cell looks at its cameras."""
INTERNAL_ERROR = "internal error, see the log"

log = logging.getLogger(__name__)


@runtime_checkable
class Cameras(Protocol):
    """The rig's cameras as one."""

    def open(self, deadline_ns: MonotonicNs) -> None:
        """Opens those that are not open; raises one CameraError that names every broken one."""
        ...

    def capture(self, light: Light, deadline_ns: MonotonicNs) -> StereoPair:
        """Triggers all and returns their accepted pair; raises CameraError."""
        ...

    def watch(self) -> bool:
        """Looks at idle cameras without waiting; raises a CameraError that names the ones that are gone. True: one that was
        away can be opened again."""
        ...

    def close(self) -> None:
        """Gives them back; never raises."""
        ...

    def statuses(self) -> tuple[CameraStatus, ...]:
        """What each says of itself, without waiting."""
        ...


@dataclass(frozen=True, slots=True)
class Attempts:
    """At opening the cameras: how many failed in a row, and when the next is due."""

    failed: int = 0
    due_ns: MonotonicNs = 0


Run = Callable[[CycleInput, Callable[[], None]], CycleResult]
Pose = Callable[[CycleInput, CycleResult, Callable[[], None]], CycleResult]


@dataclass(frozen=True, slots=True)
class Worker:
    """What the thread needs; `run` is the pipeline up to the grasps, `pose` adds the parts' poses once those are out.

    `rig` is what cycles run on unless another one was installed; `calibration` keeps samples, where they can be asked for.
    """

    board: Board
    gallery: Gallery
    cameras: Cameras
    rig: Rig
    run: Run
    pose: Pose
    recorder: Recorder | None
    clock: Clock
    meter: Meter
    calibration: Calibration | None = None
    logbook: Logbook = field(default_factory=lambda: Logbook(None))

    def live(self) -> None:
        """The thread's body: opens cameras, waits for tickets, until the cell stops."""
        attempts = Attempts()
        try:
            self.board.step(machine.observe, self.cameras.statuses())
            while not self.board.state.stopping:
                attempts = self._turn(attempts)
        finally:
            self.cameras.close()

    def _turn(self, attempts: Attempts) -> Attempts:
        """One ticket, or one look at the cameras, which are opened when that is due or one of them came back."""
        up, opening = self.board.state.cameras_up, False
        state = self.board.wait(_wanted, WATCH_S if up else min(WATCH_S, remaining_s(attempts.due_ns, self.clock)))
        try:
            if state.stopping:
                return attempts
            if state.ticket is not None:
                self._cycle(state.ticket)
            elif self.cameras.watch() or (not state.cameras_up and self.clock() >= attempts.due_ns):
                opening = True
                self.cameras.open(self.clock() + int(OPEN_LIMIT_S * 1e9))
                log.info("cameras open: %s", ", ".join(f"{c.name} {c.model} {c.serial}" for c in self.cameras.statuses()))
        except CameraError as error:
            if not attempts.failed or _errors(self.cameras.statuses()) != _errors(state.cameras):     # not at every attempt
                log.warning("cameras not open: %s", error)
        except Exception:
            log.exception("unexpected, outside a cycle")
            self.board.step(machine.stumble, INTERNAL_ERROR)
            time.sleep(WATCH_S)
        self.board.step(machine.observe, self.cameras.statuses())
        if self.board.state.cameras_up:
            return Attempts()
        if not opening:
            return attempts
        pause_s = BACKOFF_S[min(attempts.failed, len(BACKOFF_S) - 1)]
        return Attempts(attempts.failed + 1, self.clock() + int(pause_s * 1e9))

    def _cycle(self, ticket: Ticket) -> None:
        fault, inputs, cycle, sample = "", None, None, None
        try:
            if ticket.sample is not None:
                cycle, sample = self._sampled(ticket, ticket.sample)
            else:
                inputs = self._acquire(ticket)
                cycle = self._compute(ticket, inputs)
        except CycleAborted:
            self.board.step(machine.finish, ticket.cycle_id, None)
            return
        except BinpickError as error:
            log.warning("cycle %d: %s", ticket.cycle_id, error)
            cycle = CycleResult(self._failure(ticket, error.code, str(error)))
        except Exception:
            log.exception("cycle %d: unexpected", ticket.cycle_id)
            fault = INTERNAL_ERROR
            cycle = CycleResult(self._failure(ticket, Code.NOT_READY, INTERNAL_ERROR))
        result, finished_ns = cycle.result, self.clock()
        triggered_ns = _triggered_ns(inputs.pair) if inputs else finished_ns
        published = Published(result, result.json_bytes(), triggered_ns, cycle.attempts, sample)
        # cameras first: who sees the result and triggers again must not be told READY by cameras that just died
        self.board.step(machine.observe, self.cameras.statuses())
        state = self.board.step(machine.finish, ticket.cycle_id, published, fault)
        if machine.find(state, ticket.cycle_id) is not published:
            log.warning("cycle %d: its late result was dropped", ticket.cycle_id)
            return
        self._remember(ticket, inputs, cycle)
        self._watched(ticket, inputs, cycle)
        log.info("cycle %d: %d %s, %d grasps, %.0f ms", ticket.cycle_id, result.return_code.value, result.return_code.name,
                 len(result.grasps), (finished_ns - ticket.started_ns) / 1e6)
        if result.stopped:
            log.error("cycle %d: %s", ticket.cycle_id, "; ".join(state.faults))
        if inputs is not None:
            result = self._posed(inputs, cycle, published)
        if self.recorder is not None and inputs is not None:
            self.recorder.offer(inputs, result)

    def _remember(self, ticket: Ticket, inputs: CycleInput | None, cycle: CycleResult) -> None:
        if inputs is not None and cycle.memory is not None:
            self.board.step(memories.remember, ticket.cycle_id, ticket.job.bin.number, inputs.memory, cycle.memory)
        for seen in cycle.verified:
            log.info("cycle %d grasp %d: outcome %d by the cameras", seen.cycle_id, seen.grasp, seen.outcome)

    def _watched(self, ticket: Ticket, inputs: CycleInput | None, cycle: CycleResult) -> None:
        """The watchdog's word, for the next cycle and for people."""
        seen = cycle.result.calibration
        if inputs is None or inputs.guard is None or cycle.guard is None or seen is None:
            return
        self.board.step(watchdog.keep, ticket.cycle_id, inputs.guard, cycle.guard, seen)
        if trouble := self.logbook.note(ticket.cycle_id, inputs.guard, cycle.guard, seen):
            self.board.step(machine.alarm, trouble)

    def _posed(self, inputs: CycleInput, cycle: CycleResult, published: Published) -> Result:
        """The result with its parts' poses, in the place of the published one; without them when the next cycle is wanted."""
        try:
            result = self.pose(inputs, cycle, self._yield).result
        except CycleAborted:
            return published.result
        except BinpickError as error:
            log.warning("cycle %d: no poses: %s", inputs.cycle_id, error)
            return published.result
        if result is not published.result:
            self.board.step(machine.complete, replace(published, result=result, body=result.json_bytes()))
        return result

    def _yield(self) -> None:
        """Called between parts: whoever triggers or stops the cell does not wait for poses."""
        if _wanted(self.board.state):
            raise CycleAborted("the next cycle is wanted")
        with contextlib.suppress(CameraError):      # its status says so
            self.cameras.watch()
        self.board.step(machine.observe, self.cameras.statuses())

    def _acquire(self, ticket: Ticket) -> CycleInput:
        """All shots of the recipe, one after the other; they are accepted together, after the last."""
        statuses = self.cameras.statuses()
        self.meter.use(self._rig)
        settled = self.meter.settle(ticket.job, ticket.request, statuses, lambda light: self._shoot(ticket, light))
        pairs = [self._shoot(ticket, light) for light in settled.lights]
        self.meter.watch(ticket.job, ticket.request, settled.lights, pairs)
        simulated = any(status.simulated for status in statuses)
        self.board.step(machine.acquired, ticket.cycle_id)
        memory = memories.recall(self.board.state, ticket.job.bin.number)
        return CycleInput(ticket.cycle_id, pairs[0], self._rig, ticket.job, ticket.request, simulated, tuple(pairs[1:]), memory,
                          settled.outcome, watchdog.recall(self.board.state, self._rig), ticket.verify)

    def _sampled(self, ticket: Ticket, wanted: SampleRequest) -> tuple[CycleResult, SampleAnswer | None]:
        """One pair of a board, kept as a sample; whether it was seen is the code."""
        assert self.calibration is not None
        inputs, acquired_ns = self._acquire(ticket), self.clock()
        answer = self.calibration.keep(wanted, inputs, lambda: self._proceed(ticket))
        cycle = CycleResult(self._failure(ticket, answer.sample.code, answer.sample.sentence))
        return self._timed(ticket, cycle, acquired_ns), answer

    @property
    def _rig(self) -> Rig:
        """It does not change while a ticket holds the slot."""
        installed = self.board.state.rig
        return installed.rig if installed is not None else self.rig

    def _shoot(self, ticket: Ticket, light: Light) -> StereoPair:
        """One accepted pair of this cycle."""
        self._proceed(ticket)
        pair = self.cameras.capture(light, ticket.deadline_ns)
        if _triggered_ns(pair) < ticket.started_ns:
            raise PairRefused("the cameras gave a pair that is older than the trigger")
        return pair

    def _compute(self, ticket: Ticket, inputs: CycleInput) -> CycleResult:
        """The pipeline's result with the cell's own times; its arrays go to the gallery while the id still counts."""
        acquired_ns = self.clock()
        cycle = CycleResult(self._failure(ticket, Code.NOT_READY, INTERNAL_ERROR))
        try:
            self._proceed(ticket)
            cycle = self.run(inputs, lambda: self._proceed(ticket))
            if ticket.verify is not None:       # who stores marks is told when they are not on disk
                self.logbook.keep(inputs.guard, cycle.guard)
        finally:
            if self._counts(ticket):
                self.gallery.keep(inputs, cycle)
        return self._timed(ticket, cycle, acquired_ns)

    def _timed(self, ticket: Ticket, cycle: CycleResult, acquired_ns: MonotonicNs) -> CycleResult:
        times = {"acquire": (acquired_ns - ticket.started_ns) / 1e6, **cycle.result.timing_ms,
                 "total": (self.clock() - ticket.started_ns) / 1e6}
        rounded = {name: round(ms, 3) for name, ms in times.items()}
        return replace(cycle, result=cycle.result.model_copy(update={"timing_ms": rounded}))

    def _proceed(self, ticket: Ticket) -> None:
        """Called between stages: a retired cycle ends at the next step, one out of time says so."""
        if not self._counts(ticket):
            raise CycleAborted(f"cycle {ticket.cycle_id} was retired")
        if self.clock() >= ticket.deadline_ns:
            raise CycleTimeout(Code.TIMEOUT.message)

    def _counts(self, ticket: Ticket) -> bool:
        running = self.board.state.running
        return running is not None and running.cycle_id == ticket.cycle_id

    def _failure(self, ticket: Ticket, code: Code, message: str) -> Result:
        return failure(ticket.cycle_id, ticket.request, code, message, simulated=self.board.state.simulated)


def thread(worker: Worker) -> threading.Thread:
    """The thread, not yet started. A daemon: a camera driver stuck in C must not hold the program's exit."""
    return threading.Thread(target=worker.live, name="binpick-cell", daemon=True)


def _wanted(state: State) -> bool:
    return state.stopping or state.ticket is not None


def _errors(cameras: tuple[CameraStatus, ...]) -> tuple[str, ...]:
    return tuple(camera.error for camera in cameras)


def _triggered_ns(pair: StereoPair) -> MonotonicNs:
    return min(pair.left.triggered_ns, pair.right.triggered_ns)
