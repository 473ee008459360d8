"""First cycles over kinds of parts, per tool: the judge's word on each grasp, and which parts are one segment."""

import functools
import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from binpick import pipeline
from binpick.cycle import CycleResult
from binpick.lab import exam, grasps, offsets, parts
from binpick.lab.archive import NOWHERE, Archive
from binpick.lab.exam import Paper
from binpick.lab.parts import PartScore

KINDS = {"suction": ("block", "mixed", "bracket"), "two_finger": ("cylinder", "tee", "mixed")}
"""What each tool is tried on: parts that it is made for, and all together."""
MIXES = tuple(dict.fromkeys(itertools.chain(*KINDS.values())))
"""Every bin that is filled; the frames of one serve all tools."""
METHOD, OTHERS = "grid", ("open3d",)
"""The recipe's way to tell parts apart, and those that are tried beside it."""


@dataclass(frozen=True, slots=True)
class Grip:
    """A published grasp as judged; `off_m` and `penetration_m` are the verdict's `distance_m` and `penetration_m`.

    Of suction, `off_m` is the error along the approach that `sigma_z_m` speaks of; of two fingers, by how much the part is
    wider than said. `in_sigmas`: its errors as `offsets` tells them.
    """

    ok: bool
    penetration_m: float
    off_m: float
    sigma_z_m: float
    in_sigmas: tuple[float, ...] = (np.nan, np.nan, np.nan)


@dataclass(frozen=True, slots=True)
class Pick:
    """The first cycle of one tool on one bin."""

    tool: str
    code: int
    grips: tuple[Grip, ...]
    timing_ms: dict[str, float]


@dataclass(frozen=True, slots=True)
class Tried:
    """The same bin by another segmenter."""

    method: str
    parts: tuple[PartScore, ...]
    picks: tuple[Pick, ...]


@dataclass(frozen=True, slots=True)
class Sheet:
    """One bin: its parts against the segments, which do not depend on the tool, and a cycle of each of its tools."""

    kinds: str
    seed: int
    parts: tuple[PartScore, ...]
    picks: tuple[Pick, ...]
    others: tuple[Tried, ...] = ()


def sit(world: str, seeds: Iterable[int], count: int, keep: Archive = NOWHERE, projector: bool = True) -> Iterator[Sheet]:
    """All bins of `count` parts, kind by kind. Raises InputError for an unknown world."""
    for kinds, seed in itertools.product(MIXES, seeds):
        facts = {"first": kinds, "world": world, "seed": seed, "parts": count, "projector": projector,
                 "settings": exam.settings_sha256(world, *KINDS)}
        yield keep.sheet(Sheet, facts, functools.partial(_sheet, world, seed, kinds, count, projector, keep))


def _sheet(world: str, seed: int, kinds: str, count: int, projector: bool, keep: Archive) -> Sheet:
    return sheet(exam.paper(world, seed, kinds=kinds, parts=count, projector=projector, keep=keep), kinds)


def sheet(paper: Paper, kinds: str) -> Sheet:
    """A bin of `KINDS`, rendered once, by each of its tools and by every segmenter."""
    others = (Tried(method, *_cycles(exam.for_method(paper, method), kinds)) for method in OTHERS)
    return Sheet(kinds, paper.scene.seed, *_cycles(paper, kinds), tuple(others))


def _cycles(paper: Paper, kinds: str) -> tuple[tuple[PartScore, ...], tuple[Pick, ...]]:
    tools = [tool for tool, tried_on in KINDS.items() if kinds in tried_on]
    papers = [exam.for_tool(paper, tool) for tool in tools]
    outcomes = [pipeline.run(asked.inputs) for asked in papers]
    picks = (_pick(*each) for each in zip(tools, papers, outcomes, strict=True))
    return _parts(paper, outcomes[0]), tuple(picks)


def _pick(tool: str, paper: Paper, outcome: CycleResult) -> Pick:
    published = outcome.result.grasps
    verdicts = grasps.judged(paper, [grasps.taken(grasp) for grasp in published])
    grips = (Grip(verdict.ok, verdict.penetration_m, verdict.distance_m, grasp.sigma.z_m,
                  offsets.in_sigmas(paper, outcome, grasp, verdict))
             for verdict, grasp in zip(verdicts, published, strict=True))
    return Pick(tool, outcome.result.return_code.value, tuple(grips), outcome.result.timing_ms)


def _parts(paper: Paper, outcome: CycleResult) -> tuple[PartScore, ...]:
    """Without depth there are no segments, and no part is found."""
    if outcome.rectified is None:
        raise RuntimeError("a cycle of the exam always has a window")
    view = outcome.rectified.window
    nobody = np.zeros((view.height // 2, view.width // 2), dtype=np.int32)
    labels = outcome.segments.parts if outcome.segments is not None else nobody
    return tuple(parts.score(paper, paper.truth(view), view, labels))
