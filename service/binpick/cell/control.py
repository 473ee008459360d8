"""The cell as its interfaces know it: everything they may read, and everything they may ask for."""

import asyncio
import contextlib
import logging
import threading
import time
from types import MappingProxyType, TracebackType

from binpick import pipeline, settings
from binpick.camera.base import Clock
from binpick.cell import machine, memory, store, watchdog, worker
from binpick.cell.board import Board
from binpick.cell.calibration import Calibration
from binpick.cell.gallery import Gallery
from binpick.cell.logbook import Logbook
from binpick.cell.meter import Meter
from binpick.cell.rigs import Rigs
from binpick.cell.samples import SampleStore
from binpick.cell.worker import Cameras, Pose, Run, Worker
from binpick.errors import CycleRefused, InputError, NotInControl
from binpick.message import Verify
from binpick.recording import Recorder
from binpick.result import Artefact, Published, Request, Snapshot, Source
from binpick.rig import Rig
from binpick.rigcheck import board

STOP_LIMIT_S = 2.0
"""How long the running step may take to end before its thread is abandoned."""

log = logging.getLogger(__name__)


class Cell:
    """Implements publish.ports.View and Control. Nothing here blocks but `artefact`, and the start, which reads the memory.

    Live inside `async with cell:`, or from `launch` to `close`: a worker thread computes, and a task of the running loop
    enforces deadlines, so that a worker stuck in a driver delays no answer.
    """

    def __init__(self, cell: settings.Cell, rig: Rig, cameras: Cameras, run: Run = pipeline.grasps, *, boot_id: int,
                 pose: Pose = pipeline.poses, recorder: Recorder | None = None, clock: Clock = time.monotonic_ns) -> None:
        self._settings, self._clock = cell, clock
        rigs = Rigs(cell.calibration_directory, cell.rig, rig)
        kept = store.Store(cell.memory.directory) if cell.memory.directory is not None else None
        memories, trouble = kept.load() if kept is not None else ({}, "")
        installed, logbook = rigs.chosen(), Logbook(cell.calibration_directory)
        guard = logbook.guard(cell, installed.rig)
        troubles = tuple(each for each in (trouble, logbook.trouble) if each)
        for each in troubles:
            log.error(each)
        self._board = Board(machine.State(
            max_age_ns=cell.result_max_age_ms * 1_000_000, memories=MappingProxyType(memories), rig=installed,
            faults=troubles), boot_id, cell.control)
        self._board.step(watchdog.watching, guard)
        self.calibration = Calibration(self._board, cell, rigs, SampleStore(cell.calibration_directory), clock)
        """What may be asked for about the rig: implements publish.ports.Calibration."""
        self._gallery = Gallery()
        self._thread = worker.thread(Worker(self._board, self._gallery, cameras, rig, run, pose, recorder, clock,
                                           Meter(rig), self.calibration, logbook))
        self._keeper = store.thread(kept, self._board) if kept is not None else None
        self._supervisor: asyncio.Task[None] | None = None

    def snapshot(self) -> Snapshot:
        """The one immutable state all interfaces show."""
        return self._board.snapshot

    def subscribe(self) -> asyncio.Event:
        """An event of the running loop, set at every new snapshot."""
        return self._board.subscribe()

    def unsubscribe(self, event: asyncio.Event) -> None:
        """Ends a subscription."""
        self._board.unsubscribe(event)

    def finished(self, cycle_id: int) -> Published | None:
        """A finished cycle still in memory, or None."""
        return machine.find(self._board.state, cycle_id)

    def artefact(self, cycle_id: int, name: str) -> Artefact | None:
        """A picture or the cloud of the last cycle; takes tens of milliseconds."""
        return self._gallery.artefact(cycle_id, name)

    def start(self, request: Request, source: Source) -> int:
        """Starts a cycle and returns its id at once.

        Raises NotInControl, NotReady, Busy, UnknownItem, FrameUnavailable, FlangePoseMissing; nothing has changed then.
        """
        try:
            self._admit(source)
            job = settings.resolve(self._settings, request.recipe, request.bin, request.tool)
            pipeline.admit(self._board.state.installed.rig, job, request)
            timeout_ns = (request.timeout_ms or self._settings.timeout_ms) * 1_000_000
            return self._board.step(machine.start, request, job, self._clock(), timeout_ns).last_id
        except CycleRefused:
            self._board.step(machine.refused)
            raise

    def verify(self, wanted: Verify, request: Request, source: Source) -> int:
        """Starts a look at the calibration alone and returns its id at once.

        Whoever does not control the cell may do so while it is idle. Raises like `start`, and InputError for a board that
        cannot be or marks that are to be stored and not configured; nothing has changed then.
        """
        try:
            if wanted.board:
                board.parse(wanted.board)
            if wanted.store_marks and self._settings.reference_marks is None:
                raise InputError("there are no marks to store: configure reference_marks in the cell file")
            job = settings.resolve(self._settings, request.recipe, request.bin, request.tool)
            pipeline.admit(self._board.state.installed.rig, job, request)
            timeout_ns = (request.timeout_ms or self._settings.timeout_ms) * 1_000_000
            owner = self._settings.control
            return self._board.step(watchdog.verify, request, job, self._clock(), timeout_ns, wanted, source,
                                    owner).last_id
        except CycleRefused:
            self._board.step(machine.refused)
            raise

    def abort(self, cycle_id: int, source: Source) -> None:
        """Retires a running cycle (−26)."""
        self._admit(source)
        self._board.step(machine.abort, cycle_id, self._clock())

    def acknowledge(self, cycle_id: int, source: Source) -> None:
        """The controller has read the published result."""
        self._admit(source)
        self._board.step(machine.acknowledge, cycle_id)

    def withdraw(self, reason: str, source: Source) -> None:
        """Takes back what is published or running."""
        self._admit(source)
        self._board.step(machine.withdraw, reason, self._clock())

    def report(self, cycle_id: int, grasp: int, outcome: int, source: Source) -> None:
        """What became of a grasp."""
        self._admit(source)
        self._board.step(memory.report, cycle_id, grasp, outcome)
        log.info("cycle %d grasp %d: outcome %d by %s", cycle_id, grasp, outcome, source)

    def forget(self, bin_number: int, source: Source) -> None:
        """The bin was exchanged: its memory of outcomes is dropped. Raises NotInControl, UnknownItem, Busy."""
        self._admit(source)
        number = settings.resolve(self._settings, bin_number=bin_number).bin.number
        self._board.step(memory.forget, number)
        log.info("bin %d was exchanged, says %s: its memory is empty", number, source)

    def launch(self) -> asyncio.Task[None]:
        """Starts the worker thread, and the supervisor on the running loop, which ends only by `close` or by a defect."""
        self._supervisor = asyncio.get_running_loop().create_task(self._supervise(), name="the cell's supervisor")
        self._thread.start()
        if self._keeper is not None:
            self._keeper.start()
        return self._supervisor

    @property
    def alive(self) -> bool:
        """False only when the worker thread has died of a defect."""
        return self._thread.is_alive() or self._thread.ident is None or self._board.state.stopping

    def stop(self) -> None:
        """READY falls, triggers are refused, what runs or holds is withdrawn; returns at once."""
        self._board.step(machine.stop, self._clock())

    async def close(self, limit_s: float = STOP_LIMIT_S) -> bool:
        """Stops and waits for the worker to give the cameras back. False: it did not within the limit and is abandoned."""
        self.stop()
        loop = asyncio.get_running_loop()
        deadline = loop.time() + limit_s
        while any(thread.is_alive() for thread in self._threads) and loop.time() < deadline:
            await asyncio.sleep(0.005)
        if self._supervisor is not None:
            self._supervisor.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._supervisor
        ended = not self._thread.is_alive()
        if not ended:
            log.warning("the cell's thread did not end within %.1f s and is abandoned", limit_s)
        return ended

    async def __aenter__(self) -> "Cell":
        self.launch()
        return self

    async def __aexit__(self, kind: type[BaseException] | None, error: BaseException | None,
                        traceback: TracebackType | None) -> None:
        await self.close()

    @property
    def _threads(self) -> tuple[threading.Thread, ...]:
        return (self._thread,) if self._keeper is None else (self._thread, self._keeper)

    def _admit(self, source: Source) -> None:
        owner = self._settings.control
        if source != owner:
            raise NotInControl(f"this cell is controlled by {owner}, not by {source}: "
                               "see `control` in the cell file")

    async def _supervise(self) -> None:
        """Wakes at every change and at the next instant that matters; the worker may be stuck, this is not."""
        changed = self.subscribe()
        try:
            while True:
                changed.clear()
                now_ns = self._clock()
                due_ns = machine.due(self._board.step(machine.tick, now_ns))
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(None if due_ns is None else (due_ns - now_ns) / 1e9):
                        await changed.wait()
        finally:
            self.unsubscribe(changed)
