"""What is measured: how likely each match is wrong, and its sigma if it is not, by two laws of the evidence.

One gives the log-odds of an error beyond 1 px, the other the log of the error's size. Where one surface is seen both are
linear; between two surfaces they are quadratic and have weights of their own: "which of the two?" is no question elsewhere. The
weights were fitted on the exam's tuning seeds by `lab/fit.py`; `binpick bench stereo` says how well they hold.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Int

from binpick.data import Disparity, Mask
from binpick.stereo.evidence import Evidence
from binpick.stereo.refine import spread
from binpick.stereo.weights import Law, Model

LEAST_SIGMA_PX, MOST_SIGMA_PX = 0.02, 3.0
"""Sigma is no smaller than what a 14x14 px window can tell at best, and no larger than what the law was fitted on."""


@dataclass(frozen=True, slots=True, eq=False)
class Trust:
    """Log-odds that a match is more than 1 px off, and its sigma in px; both mean nothing where nothing is matched."""

    odds: Float32[np.ndarray, "h w"]
    sigma_px: Disparity


def judge(evidence: Evidence, model: Model) -> Trust:
    """What the evidence says of every pixel, by the laws fitted at its resolution."""
    between = np.flatnonzero(evidence.two)
    contested = _at(evidence, between)
    fields = []
    for alone, contest in ((model.alone.wrong, model.between.wrong), (model.alone.sigma, model.between.sigma)):
        constant = np.full(evidence.cells.shape[1:], alone.constant, np.float32)
        of_cells = spread(_sum(evidence.cells, alone.cells, constant), (evidence.two.shape[0], evidence.two.shape[1]))
        field = _sum(evidence.pixels, alone.pixels, of_cells)
        field.ravel()[between] = _contest(contested, contest)
        fields.append(field)
    odds, log_sigma = fields
    return Trust(odds, np.clip(cv2.exp(log_sigma), LEAST_SIGMA_PX, MOST_SIGMA_PX))


def _at(evidence: Evidence, places: Int[np.ndarray, "k"]) -> Float32[np.ndarray, "n k"]:
    """All measures at some pixels, given by their place in the raster."""
    rows, cols = evidence.cells.shape[1:]
    v, u = np.divmod(places, evidence.two.shape[1])
    cell = np.minimum(v // 2, rows - 1) * cols + np.minimum(u // 2, cols - 1)
    return np.stack([plane.ravel().take(places) for plane in evidence.pixels]
                    + [plane.ravel().take(cell) for plane in evidence.cells])


def _contest(measures: Float32[np.ndarray, "n k"], law: Law) -> Float32[np.ndarray, "k"]:
    """The quadratic law, summed in a fixed order."""
    total = np.full(measures.shape[1], law.constant, np.float32)
    pairs = iter(law.pairs)
    for i, (measure, weight) in enumerate(zip(measures, law.pixels + law.cells, strict=True)):
        factor = np.full_like(measure, weight)
        for other in measures[i:] if law.pairs else ():
            factor += other * np.float32(next(pairs))
        total += measure * factor
    return total


def _sum(planes: Float32[np.ndarray, "n h w"], weights: tuple[float, ...], total: Float32[np.ndarray, "h w"],
         ) -> Float32[np.ndarray, "h w"]:
    """Added to `total` one plane after the other, not by BLAS: the same sum whatever the number of threads."""
    for plane, weight in zip(planes, weights, strict=True):
        if weight:
            cv2.scaleAdd(plane, weight, total, dst=total)
    return total


def believed(disparity: Disparity, trust: Trust, max_risk: float) -> Mask:
    """Matched, and unlikely to be wrong."""
    return np.asarray(np.isfinite(disparity) & (trust.odds <= _log_odds(max_risk)))


def speckled(disparity: Disparity, sound: Mask, speckle_px: int) -> Mask:
    """The sound pixels in islands of fewer than `speckle_px`; within an island neighbours differ by 2 px at most."""
    if not speckle_px:
        return np.zeros(sound.shape, dtype=bool)
    fixed = np.where(sound, disparity * 16, -16).astype(np.int16)
    cv2.filterSpeckles(fixed, -16, speckle_px, 32)
    return np.asarray(sound & (fixed < 0))


def _log_odds(risk: float) -> float:
    return math.inf if risk >= 1 else math.log(risk / (1 - risk))
