"""Fits the law and the networks of `stereo.trust` on the exam's tuning seeds and writes `stereo/weights.py`: `make fit`."""

import dataclasses
import math
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.optimize import minimize

from binpick.data import Image, Rectified
from binpick.lab import depths, exam
from binpick.settings import PRESETS, Hybrid, StereoSettings
from binpick.stereo import evidence, filter, pyramid, refine, search, trust, weights
from binpick.stereo.fit import Cells
from binpick.stereo.refine import Field

LESSONS = (("A", range(1, 11)), ("B", range(1, 11)))
"""World and seeds. Steel and scenes without the projector taught nothing but to distrust the others."""
BARE = (20.0, 60.0, 100.0, 140.0, 180.0, 220.0)
"""Grey levels of surfaces that show nothing but sensor noise: whatever is matched there is wrong, and no scene says so."""
CLIFFS, RECTANGLES, GRAIN_PX, CONTRAST = 4, 60, 0.9, 30.0
"""Pairs of grainy rectangles (grey levels of spread) one before another: more kinds of depth edges than parts in bins show."""
OFF_PX = 1.0
"""An error beyond this is what `wrong` means."""
WITHIN, WITHIN_TWICE = 0.73, 0.945
"""Shares of errors below sigma and below twice sigma: tails are heavier than the normal law's (0.68, 0.954), and no scene
should leave more than 6 % beyond twice sigma: scenes differ by one or two points."""
ALONE, BETWEEN = 15_000, 8_000
"""Pixels that a scene teaches at most, of each kind: as many in either world, however large its parts appear."""
HIDDEN = 12
"""Rectifiers of a network; 16 told no more, 8 a little less."""
STEPS = 500
"""Of the optimiser, at most: a network's loss hardly falls any further."""
RIDGE, NETWORK_RIDGE = 1e-4, 1e-5
"""What the squares of the law's and of a network's weights cost, their measures scaled to a spread of 1."""
LEAST_ERROR_PX = 0.003
"""Smaller errors count as this: the logarithm of a lucky hit says nothing."""
SMOOTH = 0.05
"""The quantile's kink is rounded over so much of log px, or its slope would jump for the optimiser."""


Loss = Callable[[Float[np.ndarray, "m"]], tuple[float, Float[np.ndarray, "m"]]]
"""Mean loss of some answers, and its slope by each of them times their number."""


@dataclass(frozen=True, slots=True, eq=False)
class Lesson:
    """Some matched part pixels where one surface is seen, or between two: their evidence, and the error in the pair's px.

    `means` has the evidence of the pixels' cells.
    """

    planes: Float32[np.ndarray, "m n"]
    means: Float32[np.ndarray, "m n"]
    error_px: Float32[np.ndarray, "m"]


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What a scene teaches at one resolution, where an error beyond `wrong_px` is one."""

    alone: Lesson
    between: Lesson
    wrong_px: float


def lessons(seeds: int) -> Iterator[tuple[Scene, Scene]]:
    """What the tuning scenes teach at full and at half resolution; `seeds` limits how many of each kind."""
    like = depths.rectified(exam.paper("A", 1))[0]
    yield from (_both(*made) for made in (*_bare(like), *_cliffs(like)))
    for world, some in LESSONS:
        for seed in some[:seeds]:
            paper = exam.paper(world, seed)
            pair = depths.rectified(paper)[0]
            truth = paper.truth(pair.window)
            yield _both(pair, truth.disparity - np.float32(pair.window.min_disparity), truth.part_id > 0)


def _both(pair: Rectified, target: Float32[np.ndarray, "h w"], part: Bool[np.ndarray, "h w"]) -> tuple[Scene, Scene]:
    """At full and at half resolution; `target` is the truth relative to the window's smallest disparity, px."""
    rows, cols = (side // 2 * 2 for side in part.shape)
    nearest, mean = target[:rows:2, :cols:2], _mean_of_four(target)
    coarse = np.where(np.abs(mean - nearest) < 2 * pyramid.SAME_SURFACE_PX, mean, nearest)
    return (_scene(pair, PRESETS["quality"], refine.FULL, target, part, 1),
            _scene(pyramid.shrink(pair), PRESETS["fast"], refine.HALF, coarse, part[:rows:2, :cols:2], 2))


Made = tuple[Rectified, Float32[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]
"""A pair, its true disparity relative to the window's smallest, and which pixels teach."""


def _bare(like: Rectified) -> Iterator[Made]:
    """Surfaces without any texture, in a window like that of a pair."""
    for seed, level in enumerate(BARE):
        rng = np.random.default_rng(seed)
        flat = np.full(like.left.shape, level, np.float32)
        shape = like.window.height, like.window.width
        nowhere = np.full(shape, 2 * like.window.num_disparities, np.float32)
        yield replace(like, left=_noisy(flat, rng), right=_noisy(flat, rng)), nowhere, np.ones(shape, dtype=bool)


def _cliffs(like: Rectified) -> Iterator[Made]:
    """Flat rectangles one before another, in a window like that of a pair: painted into both views from the back."""
    rows, cols = like.left.shape
    for seed in range(CLIFFS):
        rng = np.random.default_rng(seed)
        grain = cv2.GaussianBlur(rng.normal(0, 1, (rows, cols)).astype(np.float32), (0, 0), GRAIN_PX)
        grain *= np.float32(CONTRAST) / grain.std()
        left, right, depth = (np.zeros((rows, cols), np.float32) for _ in range(3))
        for near_px in np.sort(rng.uniform(4, like.window.num_disparities - 8, RECTANGLES)):
            height, width = rng.integers(40, 250, 2) if depth.any() else (rows, cols)
            top, begin = rng.integers(0, rows - height + 1), rng.integers(0, cols - width + 1)
            surface = np.roll(grain, rng.integers(0, cols, 2), (0, 1)) + np.float32(rng.uniform(70, 180))
            here = slice(top, top + height), slice(begin, begin + width)
            left[here], depth[here] = surface[here], near_px
            moved = cv2.warpAffine(surface, np.array([[1, 0, -near_px], [0, 1, 0]]), (cols, rows), flags=cv2.INTER_LANCZOS4)
            there = here[0], slice(max(0, math.ceil(begin - near_px)), max(0, math.ceil(begin + width - near_px)))
            right[there] = moved[there]
        target = depth[:, like.margin:]
        yield replace(like, left=_noisy(left, rng), right=_noisy(right, rng)), target, target > 0


def _noisy(image: Float32[np.ndarray, "h w"], rng: np.random.Generator) -> Image:
    """With a sensor's noise. Evidence knows that of two pixels' difference; one pixel has half its variance."""
    spread = np.sqrt((evidence.NOISE_VARIANCE + evidence.NOISE_PER_STEP * np.maximum(image, 0)) / 2)
    return np.asarray(np.clip(np.round(rng.normal(image, spread)), 0, 255), np.uint8)


def _scene(pair: Rectified, settings: StereoSettings, reach: refine.Reach, target: Float32[np.ndarray, "h w"],
           part: Bool[np.ndarray, "h w"], scale: int) -> Scene:
    """`target` is the truth on the pair's pixels, in full-resolution px; errors are the pair's own px."""
    matcher = settings.matcher.shrunk if isinstance(settings.matcher, Hybrid) else settings.matcher
    whole = search.search(pair.left, pair.right, pair.window.num_disparities, matcher)
    confidence, _ = filter.confirm(whole, pair, matcher)
    found = np.ascontiguousarray(whole[:, pair.margin:])
    refined = refine.refine(found, pair, reach)
    seen = evidence.gather(found, refined, confidence, pair)
    height, width = target.shape
    off = np.abs(refined.disparity[:height, :width] - target / scale)
    judged = part & np.isfinite(off)
    rng = np.random.default_rng(0)

    def lesson(here: Bool[np.ndarray, "h w"], most: int) -> Lesson:
        places = np.flatnonzero(here)
        places = np.sort(rng.choice(places, min(most, len(places)), replace=False))

        def at(planes: Iterable[Float32[np.ndarray, "h2 w2"]]) -> list[Float32[np.ndarray, "m"]]:
            whole = (_spread(plane, (found.shape[0], found.shape[1])) for plane in planes)
            return [plane[:height, :width].ravel()[places] for plane in whole]

        cells = at(seen.cells)
        pixels = [plane[:height, :width].ravel()[places] for plane in seen.pixels]
        means = at(_mean_of_four(plane) for plane in seen.pixels)
        return Lesson(np.stack(pixels + cells, axis=1), np.stack(means + cells, axis=1), off.ravel()[places])

    two = seen.two[:height, :width]
    return Scene(lesson(judged & ~two, ALONE), lesson(judged & two, BETWEEN), OFF_PX / scale)


def _mean_of_four(field: Field) -> Cells:
    """Of each 2x2 px, as `trust` has it; an odd last row or column is left out."""
    rows, cols = (side // 2 * 2 for side in field.shape)
    return np.asarray(cv2.resize(field[:rows, :cols], (cols // 2, rows // 2), interpolation=cv2.INTER_AREA), np.float32)


def _spread(cells: Cells, shape: tuple[int, int]) -> Field:
    """Each cell's value on its four pixels, as `trust` has it; the last ones also on an odd last row and column."""
    rows, cols = cells.shape
    even = cv2.resize(cells, (2 * cols, 2 * rows), interpolation=cv2.INTER_NEAREST)
    spread: Field = cv2.copyMakeBorder(even, 0, shape[0] - 2 * rows, 0, shape[1] - 2 * cols, cv2.BORDER_REPLICATE)
    return spread


def fit(taught: Sequence[Scene]) -> weights.Model:
    """What is known of one resolution."""
    wrong_px = taught[0].wrong_px
    alone, between = _joined([scene.alone for scene in taught]), _joined([scene.between for scene in taught])
    wrong, odds = _law(alone.planes, alone.error_px > wrong_px)
    wrong_between = network(between.planes, likelihood(between.error_px > wrong_px))
    sure, sure_between = odds < 0, trust.answer(wrong_between, between.planes.T) < 0
    return weights.Model(wrong, network(alone.means[sure], shares(alone.error_px[sure])), wrong_between,
                         network(between.planes[sure_between], shares(between.error_px[sure_between])))


def _joined(lessons: Sequence[Lesson]) -> Lesson:
    return Lesson(*(np.concatenate([getattr(lesson, field) for lesson in lessons])
                    for field in ("planes", "means", "error_px")))


def likelihood(wrong: Bool[np.ndarray, "m"]) -> Loss:
    """Of log-odds: maximum likelihood."""

    def loss(odds: Float[np.ndarray, "m"]) -> tuple[float, Float[np.ndarray, "m"]]:
        return float(np.mean(np.logaddexp(0, odds) - wrong * odds)), 1 / (1 + np.exp(-odds)) - wrong

    return loss


def shares(error_px: Float32[np.ndarray, "m"]) -> Loss:
    """Of the log of sigma: quantile regression (Koenker and Bassett 1978) of it and its double at once, kinks rounded."""
    y = np.log(np.maximum(error_px, LEAST_ERROR_PX))

    def loss(log_sigma: Float[np.ndarray, "m"]) -> tuple[float, Float[np.ndarray, "m"]]:
        value, slope = 0.0, np.zeros_like(log_sigma)
        for share, times in ((WITHIN, 1), (WITHIN_TWICE, 2)):
            left = (y - log_sigma - math.log(times)) / SMOOTH
            value += float(SMOOTH * np.mean(share * left + np.logaddexp(0, -left)))
            slope -= share - 1 / (1 + np.exp(np.clip(left, -60, 60)))
        return value, slope

    return loss


def _law(planes: Float32[np.ndarray, "m n"], wrong: Bool[np.ndarray, "m"]) -> tuple[weights.Law, Float[np.ndarray, "m"]]:
    """The linear law of the log-odds, and what it says of the lesson."""
    x, mean, scale = _standard(planes)
    likely = likelihood(wrong)

    def loss(w: Float[np.ndarray, "k"]) -> tuple[float, Float[np.ndarray, "k"]]:
        value, slope = likely(x @ w[1:] + w[0])
        return value + RIDGE * float(w @ w), np.concatenate([[slope.mean()], x.T @ slope / len(x)]) + 2 * RIDGE * w

    solved = minimize(loss, np.zeros(x.shape[1] + 1), jac=True, method="L-BFGS-B").x
    each, pixels = solved[1:] / scale, len(evidence.OF_PIXELS)
    return (weights.Law(_rounded(solved[:1] - each @ mean)[0], _rounded(each[:pixels]), _rounded(each[pixels:])),
            x @ solved[1:] + solved[0])


def network(planes: Float32[np.ndarray, "m n"], of: Loss) -> weights.Network:
    """The network with the smallest loss that is found from one random beginning."""
    x, mean, scale = _standard(planes)
    count, size = x.shape
    rng = np.random.default_rng(0)
    begin = np.concatenate([rng.normal(0, size**-0.5, size * HIDDEN), rng.normal(0, 0.5, HIDDEN), rng.normal(0, 0.1, HIDDEN),
                            [0]])

    def parts(w: Float[np.ndarray, "k"]) -> tuple[np.ndarray, ...]:
        """Hidden weights (measures by rectifiers), offsets, weights out, and the constant."""
        hidden, offsets, out, constant = np.split(w, [size * HIDDEN, (size + 1) * HIDDEN, (size + 2) * HIDDEN])
        return hidden.reshape(size, HIDDEN), offsets, out, constant

    def loss(w: Float[np.ndarray, "k"]) -> tuple[float, Float[np.ndarray, "k"]]:
        hidden, offsets, out, constant = parts(w.astype(np.float32))
        active = np.maximum(x @ hidden + offsets, 0)
        value, slope = of(active @ out + constant)
        slope = (slope / count).astype(np.float32)
        back = (slope[:, None] * out) * (active > 0)
        gradient = np.concatenate([(x.T @ back).ravel(), back.sum(0), active.T @ slope, [slope.sum()]])
        return value + NETWORK_RIDGE * float(w @ w), gradient + 2 * NETWORK_RIDGE * w

    found = minimize(loss, begin, jac=True, method="L-BFGS-B", options={"maxiter": STEPS, "maxfun": 2 * STEPS}).x
    hidden, offsets, out, constant = parts(found)
    each = hidden / scale[:, None]
    return weights.Network(_rounded(constant)[0], _rounded(out), _rounded(offsets - mean @ each),
                           tuple(_rounded(unit) for unit in each.T))


def _standard(planes: Float32[np.ndarray, "m n"],
              ) -> tuple[Float32[np.ndarray, "m n"], Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Each measure with mean 0 and spread 1, what was taken off and divided by; what never changes tells nothing."""
    mean, scale = planes.mean(axis=0, dtype=np.float64), planes.std(axis=0, dtype=np.float64)
    scale = np.where(scale > 1e-6, scale, np.inf)
    return ((planes - mean) / scale).astype(np.float32), mean, scale


def _rounded(values: Float[np.ndarray, "k"]) -> tuple[float, ...]:
    return tuple(float(f"{value:.4g}") for value in values)


def text(full: weights.Model, half: weights.Model) -> str:
    """The module that holds them."""
    source = Path(weights.__file__).read_text()
    lines = [source[:source.index("FULL = ")]]
    for name, model in (("FULL", full), ("HALF", half)):
        lines.append(f"{name} = Model(\n")
        for field in dataclasses.fields(model):
            said = f"{field.name}={getattr(model, field.name)},"
            lines.append(textwrap.fill(said, 124, initial_indent=4 * " ", subsequent_indent=8 * " ") + "\n")
        lines.append(")\n")
    return "".join(lines)


if __name__ == "__main__":
    Path(weights.__file__).write_text(text(*map(fit, zip(*lessons(int(sys.argv[1]) if sys.argv[1:] else 10), strict=True))))
