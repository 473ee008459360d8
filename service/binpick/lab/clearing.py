"""Bins emptied in a closed loop: the robot takes the first grasp, the judge decides, the rest settles, until none is left."""

import functools
import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from binpick import pipeline, settings
from binpick.cycle import CycleInput, CycleResult
from binpick.grasp import memory
from binpick.lab import exam, grasps
from binpick.lab.archive import NOWHERE, Archive
from binpick.lab.exam import Paper
from binpick.outcomes import COLLISION, MISSED, NO_MEMORY, OK, Memory
from binpick.result import Request, Result
from binpick.sim import exam as frozen
from binpick.sim import lift, oracle, score
from binpick.sim.score import Verdict
from binpick.sim.world import World, WorldScene

PATIENCE = 2.5
"""So many cycles per part, and the robot gives up."""
SHOTS = 1000
"""Shots of one seed's bins: every cycle is one more shot, with noise of its own."""


@dataclass(frozen=True, slots=True)
class Task:
    """What lies in the bin (as in `sim.exam.kinds`), and the tools, each the default of its kind, that empty it."""

    kinds: str
    tools: tuple[str, ...]

    @property
    def name(self) -> str:
        """For tables."""
        return f"{' + '.join(self.tools)}: {self.kinds}"


TASKS = (Task("block", ("suction",)), Task("mixed", ("suction",)), Task("cylinder", ("two_finger",)),
         Task("tee", ("two_finger",)), Task("mixed", ("suction", "two_finger")))


@dataclass(frozen=True, slots=True)
class Taken:
    """The first grasp of a cycle as the robot took it; `reason` is the judge's, "" when it holds a part of `kind`.

    `lifted`: the part also stayed in the hand when physics lifted it; not asked of grasps that do not hold.
    """

    tool: str
    kind: str
    reason: str
    penetration_m: float
    lifted: bool = False

    @property
    def collides(self) -> bool:
        """Whether the tool went deeper into anything than it may."""
        return self.penetration_m > score.MAX_PENETRATION_M


@dataclass(frozen=True, slots=True)
class Cycle:
    """One cycle: its code, its computed time, and what became of its first grasp (None: it had none)."""

    code: int
    compute_ms: float
    taken: Taken | None

    @property
    def picked(self) -> bool:
        """Whether a part left the bin."""
        return self.taken is not None and not self.taken.reason


@dataclass(frozen=True, slots=True)
class Left:
    """A part that stayed: whether a tool of the task could have taken it, and how many pixels of it the left camera shows."""

    kind: str
    pickable: bool
    pixels: int


@dataclass(frozen=True, slots=True)
class Clearing:
    """How one bin of `parts` was emptied, cycle by cycle, and what stayed."""

    kinds: str
    tools: tuple[str, ...]
    seed: int
    parts: int
    cycles: tuple[Cycle, ...]
    left: tuple[Left, ...]

    @property
    def removed(self) -> int:
        """Parts that left the bin."""
        return sum(cycle.picked for cycle in self.cycles)


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """One cycle with the frames it saw and all that it computed."""

    paper: Paper
    outcome: CycleResult
    cycle: Cycle


def sit(world: str, seeds: Iterable[int], parts: int, keep: Archive = NOWHERE, projector: bool = True) -> Iterator[Clearing]:
    """All tasks, bin by bin. Raises InputError for an unknown world."""
    for task, seed in itertools.product(TASKS, seeds):
        facts = {"cleared": task.name, "world": world, "seed": seed, "parts": parts, "projector": projector,
                 "settings": exam.settings_sha256(world, *task.tools)}
        yield keep.sheet(Clearing, facts, functools.partial(clear, task, world, seed, parts, keep, projector))


def clear(task: Task, world: str, seed: int, parts: int, keep: Archive = NOWHERE, projector: bool = True) -> Clearing:
    """Empties one bin. Raises InputError."""
    full = World(world, task.kinds, parts, seed)
    done = list(steps(task, full, parts, keep, projector))
    return Clearing(task.kinds, task.tools, seed, parts, tuple(step.cycle for step in done), left(done[-1], full.scene()))


def steps(task: Task, world: World, parts: int, keep: Archive = NOWHERE, projector: bool = True) -> Iterator[Step]:
    """Cycle by cycle, until one has no pose, or patience ends. The cell remembers what failed, as it is told."""
    known = NO_MEMORY
    for number in range(1, 1 + int(PATIENCE * parts)):
        paper = _paper(task, world.scene(), number, known, keep, projector)
        outcome = pipeline.run(paper.inputs)
        result = outcome.result
        first = [grasps.taken(grasp) for grasp in result.grasps[:1]]
        verdict = grasps.judged(paper, first)
        lifted = [_lifted(paper, *each) for each in zip(first, verdict, strict=True)]
        yield Step(paper, outcome, _cycle(result, verdict, lifted))
        if not verdict:
            return
        known = memory.after(known, outcome, {result.grasps[0].number: _outcome(verdict[0])})
        if verdict[0].ok:
            world.remove(verdict[0].part_id)
            world.settle()


def _cycle(result: Result, verdicts: Sequence[Verdict], lifted: Sequence[bool]) -> Cycle:
    taken = [Taken(result.grasps[0].tool.kind, v.kind, v.reason, v.penetration_m, up)
             for v, up in zip(verdicts, lifted, strict=True)]
    return Cycle(result.return_code.value, result.timing_ms["compute"], taken[0] if taken else None)


def _lifted(paper: Paper, first: grasps.Taken, verdict: Verdict) -> bool:
    tool = paper.inputs.job.tool_numbered(first.tool)
    return verdict.ok and lift.lift(paper.scene, first.T_bin_tcp, tool, verdict.part_id, first.open_m).held


def _outcome(verdict: Verdict) -> int:
    """What the controller says of a grasp."""
    if verdict.ok:
        return OK
    return COLLISION if verdict.penetration_m > score.MAX_PENETRATION_M else MISSED


def left(last: Step, scene: WorldScene) -> tuple[Left, ...]:
    """What stayed in the bin, as the last cycle's camera sees it."""
    if last.outcome.rectified is None:
        raise RuntimeError("a cycle of the exam always has a window")
    seen = replace(last.paper, scene=scene).truth(last.outcome.rectified.window).part_id
    pixels = np.bincount(np.maximum(seen, 0).ravel(), minlength=1 + max([0, *(part.part_id for part in scene.parts)]))
    could = oracle.pickable(scene, last.paper.inputs.job.tools)
    return tuple(Left(part.kind, part.part_id in could, int(pixels[part.part_id])) for part in scene.parts)


def _paper(task: Task, scene: WorldScene, number: int, known: Memory, keep: Archive, projector: bool) -> Paper:
    """What the cameras take of the bin in this cycle, and what the cell remembers of it."""
    tools = [{"number": i, "kind": kind} for i, kind in enumerate(task.tools, start=1)]
    cell = frozen.cell(scene.world, tools=tools)
    recipe = cell.recipes[0].model_copy(update={"projector": projector})
    job = settings.resolve(cell).model_copy(update={"tools": cell.tools, "recipe": recipe})
    first, *more = (exam.pair(scene, light, SHOTS * scene.seed + number, keep) for light in job.recipe.lights)
    request = Request.model_validate({"frame": "bin"})
    inputs = CycleInput(number, first, frozen.rig(scene.world), job, request, simulated=True, more=tuple(more), memory=known)
    return Paper(inputs, scene)
