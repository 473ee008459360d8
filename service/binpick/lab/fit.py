"""Fits the laws of `stereo.trust` on the exam's tuning seeds and writes `stereo/weights.py`: `make fit`."""

import sys
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.optimize import minimize

from binpick.data import Rectified
from binpick.lab import depths, exam
from binpick.settings import PRESETS, Hybrid, StereoSettings
from binpick.stereo import evidence, filter, pyramid, refine, search, weights

LESSONS = (("A", range(1, 11)), ("B", range(1, 11)))
"""World and seeds. Steel and scenes without the projector taught nothing but to distrust the others."""
OFF_PX = 1.0
"""An error beyond this is what `wrong` means."""
QUANTILE = 0.71
"""Share of errors below sigma: more than the normal law's 68 %, since their tails are heavier than its own."""
EVERY = 3
"""Part pixels are neighbours' likeness: each third is learned from."""
MOST_PIXELS = 300_000
"""More teach nothing new, and take minutes."""
RIDGE = 1e-4
LEAST_ERROR_PX = 0.003
SMOOTH = 0.05
"""The quantile's kink is rounded over so much of log px, or its slope would jump for the optimiser."""


@dataclass(frozen=True, slots=True, eq=False)
class Lesson:
    """Matched part pixels: evidence, whether between two surfaces, and the error, px; beyond `wrong_px` it is one."""

    planes: Float32[np.ndarray, "m n"]
    two: Bool[np.ndarray, "m"]
    error_px: Float32[np.ndarray, "m"]
    wrong_px: float


def lessons(seeds: int) -> Iterator[tuple[Lesson, Lesson]]:
    """What the tuning scenes teach at full and at half resolution; `seeds` limits how many of each kind."""
    quality, fast = PRESETS["quality"], PRESETS["fast"]
    for world, some in LESSONS:
        for seed in some[:seeds]:
            paper = exam.paper(world, seed)
            pair = depths.rectified(paper)[0]
            truth = paper.truth(pair.window)
            part = truth.part_id > 0
            target = truth.disparity - np.float32(pair.window.min_disparity)
            rows, cols = (side // 2 * 2 for side in part.shape)
            yield (_lesson(pair, quality, refine.FULL, target, part, 1),
                   _lesson(pyramid.shrink(pair), fast, refine.HALF, target[:rows:2, :cols:2], part[:rows:2, :cols:2], 2))


def _lesson(pair: Rectified, settings: StereoSettings, reach: refine.Reach, target: Float32[np.ndarray, "h w"],
            part: Bool[np.ndarray, "h w"], scale: int) -> Lesson:
    """`target` is the truth on the pair's pixels, in full-resolution px; errors are the pair's own px."""
    matcher = settings.matcher.shrunk if isinstance(settings.matcher, Hybrid) else settings.matcher
    whole = search.search(pair.left, pair.right, pair.window.num_disparities, matcher)
    confidence, _ = filter.confirm(whole, pair, matcher, settings)
    found = np.ascontiguousarray(whole[:, pair.margin:])
    refined = refine.refine(found, pair, reach)
    seen = evidence.gather(found, refined, confidence, pair)
    height, width = target.shape
    off = np.abs(refined.disparity[:height, :width] - target / scale)
    judged = part & np.isfinite(off)
    pixels = seen.pixels[:, :height, :width][:, judged]
    cells = np.stack([refine.spread(plane, (found.shape[0], found.shape[1]))[:height, :width][judged] for plane in seen.cells])
    planes = np.concatenate([pixels, cells]).T[::EVERY]
    return Lesson(planes.copy(), seen.two[:height, :width][judged][::EVERY], off[judged][::EVERY], OFF_PX / scale)


def fit(taught: Sequence[Lesson]) -> weights.Model:
    """The laws of one resolution."""
    planes = np.concatenate([lesson.planes for lesson in taught]).astype(np.float64)
    two = np.concatenate([lesson.two for lesson in taught])
    error = np.concatenate([lesson.error_px for lesson in taught]).astype(np.float64)
    wrong_px = taught[0].wrong_px
    return weights.Model(_laws(planes[~two], error[~two], wrong_px, quadratic=False),
                         _laws(planes[two], error[two], wrong_px, quadratic=True))


def _laws(planes: Float[np.ndarray, "m n"], error: Float[np.ndarray, "m"], wrong_px: float, quadratic: bool) -> weights.Laws:
    step = len(error) // MOST_PIXELS + 1
    planes, error = planes[::step], error[::step]
    first, second = np.triu_indices(planes.shape[1])
    terms = np.column_stack([planes, planes[:, first] * planes[:, second]]) if quadratic else planes
    mean, spread = terms.mean(axis=0), terms.std(axis=0)
    used = spread > 1e-6
    x = np.column_stack([np.ones(len(terms)), (terms[:, used] - mean[used]) / spread[used]])
    wrong = _logistic(x, error > wrong_px)
    likely = 1 / (1 + np.exp(-x @ wrong)) < 0.5
    sigma = _quantile(x[likely], np.log(np.maximum(error[likely], LEAST_ERROR_PX)))

    def law(solved: Float[np.ndarray, "k"]) -> weights.Law:
        full = np.zeros(terms.shape[1])
        full[used] = solved[1:] / spread[used]
        rounded = tuple(float(f"{w:.4g}") for w in full)
        pixels, linear = len(evidence.OF_PIXELS), planes.shape[1]
        return weights.Law(float(f"{solved[0] - full @ mean:.4g}"), rounded[:pixels], rounded[pixels:linear], rounded[linear:])

    return weights.Laws(law(wrong), law(sigma))


def _logistic(x: Float[np.ndarray, "m k"], wrong: Bool[np.ndarray, "m"]) -> Float[np.ndarray, "k"]:
    """Maximum likelihood of the log-odds."""

    def loss(w: Float[np.ndarray, "k"]) -> tuple[float, Float[np.ndarray, "k"]]:
        odds = x @ w
        slope = 1 / (1 + np.exp(-odds)) - wrong
        return float(np.mean(np.logaddexp(0, odds) - wrong * odds) + RIDGE * (w @ w)), x.T @ slope / len(x) + 2 * RIDGE * w

    found: Float[np.ndarray, "k"] = minimize(loss, np.zeros(x.shape[1]), jac=True, method="L-BFGS-B").x
    return found


def _quantile(x: Float[np.ndarray, "m k"], y: Float[np.ndarray, "m"]) -> Float[np.ndarray, "k"]:
    """Linear quantile regression (Koenker and Bassett 1978), its kink rounded."""

    def loss(w: Float[np.ndarray, "k"]) -> tuple[float, Float[np.ndarray, "k"]]:
        left = (y - x @ w) / SMOOTH
        slope = QUANTILE - 1 / (1 + np.exp(np.clip(left, -60, 60)))
        value = SMOOTH * np.mean(QUANTILE * left + np.logaddexp(0, -left))
        return float(value + RIDGE * (w @ w)), -x.T @ slope / len(x) + 2 * RIDGE * w

    begin = np.zeros(x.shape[1])
    begin[0] = np.quantile(y, QUANTILE)
    found: Float[np.ndarray, "k"] = minimize(loss, begin, jac=True, method="L-BFGS-B").x
    return found


def text(full: weights.Model, half: weights.Model) -> str:
    """The module that holds them."""
    source = Path(weights.__file__).read_text()
    lines = [source[:source.index("FULL = ")]]
    for name, model in (("FULL", full), ("HALF", half)):
        lines.append(f"{name} = Model(\n")
        for which, laws in (("alone", model.alone), ("between", model.between)):
            lines.append(f"    {which}=Laws(\n")
            for kind, law in (("wrong", laws.wrong), ("sigma", laws.sigma)):
                said = f"{kind}=Law({law.constant}, {law.pixels}, {law.cells}, {law.pairs}),"
                lines.append(textwrap.fill(said, 124, initial_indent=8 * " ", subsequent_indent=18 * " ") + "\n")
            lines.append("    ),\n")
        lines.append(")\n")
    return "".join(lines)


if __name__ == "__main__":
    Path(weights.__file__).write_text(text(*map(fit, zip(*lessons(int(sys.argv[1]) if sys.argv[1:] else 10), strict=True))))
