"""First cycles of the exam: ours and the textbook pipeline on the same frames, judged by the simulator's truth."""

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from binpick import geometry, pipeline
from binpick.cycle import CycleResult
from binpick.data import Window
from binpick.geometry import Transform
from binpick.lab import baseline, exam, stereo
from binpick.lab.exam import Paper
from binpick.lab.stereo import DepthScore
from binpick.result import GraspMessage
from binpick.sim import score
from binpick.sim.score import Verdict


@dataclass(frozen=True, slots=True, eq=False)
class Taken:
    """A grasp as the robot takes it: the pose in the bin, the tool's number, and how far two fingers open and close."""

    T_bin_tcp: Transform
    tool: int
    open_m: float = 0.0
    close_m: float = 0.0


@dataclass(frozen=True, slots=True)
class Answer:
    """One pipeline's cycle on one scene: what its depth is worth, whether its grasps are good, and its seconds."""

    depth: DepthScore
    good: tuple[bool, ...]
    penetration_m: tuple[float, ...]
    seconds: tuple[float, ...]

    @property
    def top_is_good(self) -> bool:
        """Whether there was a first grasp and the judge passed it."""
        return bool(self.good) and self.good[0]


@dataclass(frozen=True, slots=True)
class Scene:
    """All answers on one scene. `textbook` rows: full frame and fixed range; the same with our window and range."""

    seed: int
    code: int
    plain: DepthScore
    ours: Answer
    stages_ms: dict[str, float]
    textbook: Answer | None = None
    textbook_window: Answer | None = None


def sit(world: str, seeds: Iterable[int], cycles: int, against_textbook: bool) -> Iterator[Scene]:
    """Sits the exam, one scene at a time; `cycles` timed repetitions of ours, of which the median counts."""
    for seed in seeds:
        paper = exam.paper(world, seed)
        outcome, seconds, stages = _ours(paper, cycles)
        if outcome.rectified is None or outcome.depth is None:
            raise RuntimeError("a settled world always has depth")
        view = outcome.rectified.window
        truth = paper.truth(view)
        on_part = truth.part_id > 0
        verdicts = judged(paper, [taken(grasp) for grasp in outcome.result.grasps])
        depth = stereo.score(outcome.depth.disparity, truth.disparity, on_part, truth.visible_both)
        yield Scene(
            seed=seed,
            code=outcome.result.return_code.value,
            ours=_answer(depth, verdicts, seconds),
            stages_ms=stages,
            plain=stereo.score(stereo.plain_sgbm(outcome.rectified), truth.disparity, on_part, truth.visible_both),
            textbook=_textbook(paper, None) if against_textbook else None,
            textbook_window=_textbook(paper, view) if against_textbook else None,
        )


def _ours(paper: Paper, cycles: int) -> tuple[CycleResult, tuple[float, ...], dict[str, float]]:
    """The outcome, seconds of each repetition after one warm-up, and the median of every stage in ms."""
    outcome = pipeline.run(paper.inputs)
    seconds, stages = [], []
    for _ in range(cycles):
        began = time.perf_counter()
        outcome = pipeline.run(paper.inputs)
        seconds.append(time.perf_counter() - began)
        stages.append(outcome.result.timing_ms)
    return (
        outcome,
        tuple(seconds),
        {k: round(float(np.median([s[k] for s in stages])), 1) for k in (stages[0] if stages else {})},
    )


def _textbook(paper: Paper, view: Window | None) -> Answer:
    inputs = paper.inputs
    T_camera_bin = inputs.job.bin.T_parent_bin
    book = baseline.run(inputs.pair.left.image, inputs.pair.right.image, inputs.rig, T_camera_bin, inputs.job.bin, view)
    truth = paper.truth(book.window)
    disparity = np.where(book.disparity > 0, book.disparity, np.float32(np.nan)).astype(np.float32)
    verdicts = judged(paper, [Taken(T_bin_tcp, inputs.job.tool.number) for T_bin_tcp in book.grasps[:5]])
    depth = stereo.score(disparity, truth.disparity, truth.part_id > 0, truth.visible_both)
    return _answer(depth, verdicts, (book.seconds["total"],))


def _answer(depth: DepthScore, verdicts: Sequence[Verdict], seconds: tuple[float, ...]) -> Answer:
    return Answer(depth, tuple(v.ok for v in verdicts), tuple(v.penetration_m for v in verdicts), seconds)


def judged(paper: Paper, grasps: Sequence[Taken]) -> tuple[Verdict, ...]:
    """The judge's verdict on each grasp."""
    job = paper.inputs.job
    return tuple(score.judge(paper.scene, grasp.T_bin_tcp, job.tool_numbered(grasp.tool), grasp.open_m, grasp.close_m)
                 for grasp in grasps)


def taken(grasp: GraspMessage) -> Taken:
    """The published grasp; the exam asks for frame `bin`."""
    if grasp.frame != "bin":
        raise ValueError("the exam's papers are answered in the bin's frame")
    T_bin_tcp = geometry.from_quaternion(np.array(grasp.position_m), np.array(grasp.quaternion_xyzw))
    return Taken(T_bin_tcp, grasp.tool.number, grasp.open_m, grasp.close_m)
