"""Sits the stereo exam: every method on the same frames of a scene, its errors against the truth, its seconds in turns."""

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from binpick.data import BLACK_PATTERN, FIRST_GRAY_PATTERN, Depth, Rectified
from binpick.lab import exam, methods
from binpick.lab.exam import Paper
from binpick.lab.regions import Regions, regions
from binpick.lab.stereo import Field, plain_matcher, plain_sgbm
from binpick.scene import bin as load_carrier
from binpick.settings import PRESETS, StereoSettings
from binpick.settings.recipe import Shot
from binpick.sim.truth import Truth
from binpick.stereo import depth, rectify

Result = TypeVar("Result")
CREASE, PLANE, CURVED, EDGE = range(4)
"""Where a part's pixel lies: beside a fold between faces, on a plane, on a round face, at a depth edge."""


@dataclass(frozen=True, slots=True)
class Series:
    """Scenes of one kind: the world, what lies in the bin, whether dots are thrown on it, and the shots of a cycle.

    Without `shots` a cycle is one pair, the recipe's. With them ours gets them all, the other methods the first.
    """

    name: str
    world: str
    kinds: str = "mixed"
    projector: bool = True
    shots: tuple[Shot, ...] = ()


GRAY_CODE = (Shot(), *(Shot(pattern=pattern) for pattern in range(FIRST_GRAY_PATTERN, BLACK_PATTERN + 1)))
"""Dots for the other methods, and what a programmable projector shows for ours."""
SERIES = (
    Series("mixed_A", "A"), Series("mixed_B", "B"), Series("metal_A", "A", kinds="metal"),
    Series("metal_gray_A", "A", kinds="metal", shots=GRAY_CODE), Series("no_projector_A", "A", projector=False))
"""In the order of the tables."""


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """One method on one scene, part pixel by part pixel: the signed error in px (NaN = not measured) and the sigma it claims.

    `seconds` are its repetitions; `sigma_px` is None for methods that claim none.
    """

    error_px: Float32[np.ndarray, "n"]
    sigma_px: Float32[np.ndarray, "n"] | None
    seconds: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Marked:
    """One scene of the exam with all answers; arrays run over the pixels of parts.

    `depth_scale` is focal length times baseline, m px.
    """

    seed: int
    truth_px: Float32[np.ndarray, "n"]
    region: UInt8[np.ndarray, "n"]
    visible_both: Bool[np.ndarray, "n"]
    depth_scale: float
    answers: dict[str, Answer]


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """A marked scene with the maps behind it, for a picture."""

    series: Series
    marked: Marked
    rectified: Rectified
    truth: Truth
    maps: dict[str, Field]
    depths: dict[str, Depth]


@dataclass(slots=True)
class _Watch:
    """Seconds by method."""

    seconds: dict[str, list[float]] = field(default_factory=dict)

    def time(self, name: str, work: Callable[[], Result]) -> Result:
        began = time.perf_counter()
        result = work()
        self.seconds.setdefault(name, []).append(time.perf_counter() - began)
        return result


def sit(series: Series, seeds: Iterable[int], repeats: int) -> Iterator[Sheet]:
    """One scene after the other; `repeats` timed runs of plain SGBM and of each preset, taking turns, one of the others.

    A cycle of many shots takes seconds and is timed once.
    """
    for seed in seeds:
        paper = exam.paper(series.world, seed, kinds=series.kinds, projector=series.projector, shots=series.shots)
        yield answer(series, seed, paper, 1 if series.shots else repeats)


def answer(series: Series, seed: int, paper: Paper, repeats: int) -> Sheet:
    """All methods on one paper.

    Ours is timed from the camera's images to the measured map. Plain SGBM is OpenCV's bare call on images that are rectified
    already: nothing is charged to the yardstick.
    """
    pair = rectified(paper)[0]
    depths = {name: _ours(paper, settings) for name, settings in PRESETS.items()}
    maps = {methods.PLAIN: plain_sgbm(pair)}
    watch = _Watch()
    matcher = plain_matcher(pair.window.num_disparities)
    for _ in range(repeats):
        watch.time(methods.PLAIN, partial(matcher.compute, pair.left, pair.right))
        for name, settings in PRESETS.items():
            watch.time(name, partial(_ours, paper, settings))
    maps |= {name: watch.time(name, partial(method, pair)) for name, method in methods.others().items()}
    maps |= {name: measured.disparity for name, measured in depths.items()}
    truth = paper.truth(pair.window)
    return Sheet(series, mark(seed, pair, truth, {p.part_id: p.kind for p in paper.scene.parts}, maps, depths, watch.seconds),
                 pair, truth, maps, depths)


def _ours(paper: Paper, settings: StereoSettings) -> Depth:
    return depth.of_shots(rectified(paper), paper.inputs.job.recipe.lights, settings)[1]


def rectified(paper: Paper) -> tuple[Rectified, ...]:
    """The bin's window of every shot of a paper, as the pipeline cuts it."""
    inputs = paper.inputs
    rect, job = rectify.rectification(inputs.rig), inputs.job
    box = load_carrier.search_box(job.bin, job.recipe.limits.above_rim_m)
    wanted = rectify.window(rect, load_carrier.place(job.bin, inputs.T_base_camera), *box)
    view = rectify.visible(rect, inputs.rig, wanted)
    return tuple(rectify.rectify(pair.left.image, pair.right.image, inputs.rig, view) for pair in inputs.pairs)


def mark(seed: int, pair: Rectified, truth: Truth, kinds: dict[int, str], maps: dict[str, Field], depths: dict[str, Depth],
         seconds: dict[str, list[float]]) -> Marked:
    """Every map against the truth on the pixels of parts."""
    at = regions(truth, kinds)
    answers = {
        name: Answer((disparity - truth.disparity)[at.parts], depths[name].sigma_px[at.parts] if name in depths else None,
                     tuple(seconds.get(name, ())))
        for name, disparity in maps.items()}
    return Marked(seed, truth.disparity[at.parts], _places(at)[at.parts], truth.visible_both[at.parts],
                  pair.focal_px * pair.baseline_m, answers)


def _places(at: Regions) -> UInt8[np.ndarray, "h w"]:
    places = np.full(at.parts.shape, CREASE, dtype=np.uint8)
    for mask, place in ((at.planes, PLANE), (at.curved, CURVED), (at.edges, EDGE)):
        places[mask] = place
    return places
