"""All that a publisher knows of the cell: what it may read, and what it may ask for."""

import asyncio
from typing import Protocol, runtime_checkable

from binpick.result import Artefact, Published, Request, Snapshot, Source

__all__ = ["Artefact", "Control", "Source", "View"]


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
class Control(Protocol):
    """Asking; refused with CycleRefused when the cell is busy, not ready, or owned by another interface."""

    def start(self, request: Request, source: Source) -> int:
        """Starts a cycle and returns its id at once; raises Busy, NotReady, NotInControl, UnknownItem, FrameUnavailable."""
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
