"""What a run of `binpick bench grasp` consists of: sorts of bins, each looked into once and some of them emptied."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from binpick.lab import clearing, harvest, picks, tally
from binpick.lab.archive import Archive
from binpick.sim import exam


@dataclass(frozen=True, slots=True)
class Bins:
    """Bins of one sort: how many seeds are looked into once, and how many are emptied by every task."""

    world: str
    parts: int
    first: int
    cleared: int = 0
    projector: bool = True

    @property
    def sheets(self) -> int:
        """How many sheets there will be."""
        return self.first * len(picks.MIXES) + self.cleared * len(clearing.TASKS)


GATE = (Bins("A", 25, 10, 3), Bins("A", 60, 10))
"""What decides whether a version is good; within an hour on two cores."""
FULL = tuple(Bins(world, parts, 10, 3, projector)
             for world in exam.SETUPS for parts, projector in ((20, True), (40, True), (60, True), (25, False)))
"""Everything; a night."""


def run(chosen: Sequence[Bins], seeds: Sequence[int], keep: Archive, done: Callable[[], None]) -> dict[str, Any]:
    """All figures; `done` is called after each sheet. Raises InputError for an unknown world."""
    return {"exam_sha256": exam.sha256(), "series": [_series(bins, seeds, keep, done) for bins in chosen]}


def _series(bins: Bins, seeds: Sequence[int], keep: Archive, done: Callable[[], None]) -> dict[str, Any]:
    sheets, emptied = [], []
    for sheet in picks.sit(bins.world, seeds[:bins.first], bins.parts, keep, bins.projector):
        sheets.append(sheet)
        done()
    for one in clearing.sit(bins.world, seeds[:bins.cleared], bins.parts, keep, bins.projector):
        emptied.append(one)
        done()
    figures = tally.figures(bins.world, bins.parts, sheets)
    return {**figures, "projector": bins.projector, "clearing": harvest.figures(emptied)}
