"""All that a publisher knows of the cell: what it may read, and what it may ask for."""

import asyncio
from typing import Protocol, runtime_checkable

from binpick.calibration import CalibrationState, HandEyeAnswer, HandEyeRequest, SampleRequest, Samples
from binpick.message import Verify
from binpick.result import Artefact, Published, Request, Snapshot, Source

__all__ = ["Artefact", "Calibration", "Control", "Source", "View"]


@runtime_checkable
class View(Protocol):
    """Reading; every call returns at once with what is true now."""

    def snapshot(self) -> Snapshot:
        """The one immutable state all interfaces show."""
        ...

    def subscribe(self) -> asyncio.Event:
        """An event of the running loop, set at every new snapshot; clear it before looking. Drop it with `unsubscribe`."""
        ...

    def unsubscribe(self, event: asyncio.Event) -> None:
        """Ends a subscription."""
        ...

    def finished(self, cycle_id: int) -> Published | None:
        """A finished cycle still in memory (the last 16) with its bytes and the instant its age is told from, or None."""
        ...

    def artefact(self, cycle_id: int, name: str) -> Artefact | None:
        """cloud.ply, overlay.png, disparity.png, confidence.png, left.png or right.png of the last cycle kept.

        None when that cycle or name is not there. Takes tens of milliseconds: call it off the loop.
        """
        ...


@runtime_checkable
class Calibration(Protocol):
    """The rig in use, its versions, and samples of a board. But for `sample` every call takes some milliseconds, `handeye`
    seconds: call them off the loop."""

    def state(self) -> CalibrationState:
        """The version in use, and those there are."""
        ...

    def sample(self, request: SampleRequest, source: Source) -> int:
        """Starts to take a sample of a board and returns the cycle's id at once; `Published.sample` is what came of it.

        Whoever does not control the cell may do so while it is idle. Raises NotInControl, Busy, NotReady, UnknownItem,
        NotApplicable when there are too many already, InputError for a board that cannot be.
        """
        ...

    def samples(self) -> Samples:
        """All samples, and what is missing."""
        ...

    def image(self, sample: int, camera: str) -> bytes | None:
        """A sample's picture of one camera as PNG; None when there is none."""
        ...

    def delete(self, sample: int | None = None) -> None:
        """Forgets one sample, or all. Raises NotApplicable for an unknown one."""
        ...

    def handeye(self, request: HandEyeRequest) -> HandEyeAnswer:
        """Makes a version of the rig with the samples' hand-eye; it is not active. Raises InputError naming what is missing."""
        ...

    def activate(self, version: int, source: Source) -> CalibrationState:
        """From the next cycle on, and after restarts, the cell runs on this version; what is published is withdrawn.

        Whoever does not control the cell may do so while it is idle. Raises NotInControl, Busy, NotReady, UnknownItem; nothing
        has changed then.
        """
        ...


@runtime_checkable
class Control(Protocol):
    """Asking; refused with CycleRefused when the cell is busy, not ready, or owned by another interface."""

    @property
    def calibration(self) -> Calibration:
        """Asking about the rig."""
        ...

    def start(self, request: Request, source: Source) -> int:
        """Starts a cycle and returns its id at once; raises Busy, NotReady, NotInControl, UnknownItem, FrameUnavailable."""
        ...

    def verify(self, wanted: Verify, request: Request, source: Source) -> int:
        """Starts a look at the calibration alone and returns its id at once; raises like `start`, and InputError."""
        ...

    def abort(self, cycle_id: int, source: Source) -> None:
        """Retires a running cycle (−26); raises NotApplicable when it is not running."""
        ...

    def acknowledge(self, cycle_id: int, source: Source) -> None:
        """The controller has read the published result, which stops being valid."""
        ...

    def withdraw(self, reason: str, source: Source) -> None:
        """Takes back what is published or running, as when the controller went away."""
        ...

    def report(self, cycle_id: int, grasp: int, outcome: int, source: Source) -> None:
        """What became of a grasp (numbers as in wire.Outcome); idempotent; raises NotApplicable for unknown ones."""
        ...

    def forget(self, bin_number: int, source: Source) -> None:
        """The bin was exchanged: drops its memory and withdraws its poses; raises UnknownItem, Busy."""
        ...
