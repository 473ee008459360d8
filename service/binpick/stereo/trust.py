"""What is measured: how likely each match is wrong, and its sigma if it is not, by two laws of the evidence.

Both are linear: the log-odds of an error beyond 1 px, and the log of the error's size. Pixels between two surfaces have weights
of their own, since what counts there (which surface is it?) is no question elsewhere. The weights were fitted on the exam's
tuning seeds by `lab/fit.py`; `binpick bench stereo` says how well they hold.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32

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
    chosen = np.stack([plane.ravel().take(between) for plane in evidence.pixels])[:, None, :]
    fields = []
    for alone, contested in ((model.alone.wrong, model.between.wrong), (model.alone.sigma, model.between.sigma)):
        field = _sum(evidence.pixels, alone.pixels, _of_cells(evidence, alone))
        if between.size:
            field.ravel()[between] = _sum(chosen, contested.pixels, _of_cells(evidence, contested).ravel().take(between)[None])
        fields.append(field)
    odds, log_sigma = fields
    return Trust(odds, np.clip(cv2.exp(log_sigma), LEAST_SIGMA_PX, MOST_SIGMA_PX))


def _of_cells(evidence: Evidence, law: Law) -> Float32[np.ndarray, "h w"]:
    """What the cells add, on all pixels."""
    constant = np.full(evidence.cells.shape[1:], law.constant, np.float32)
    return spread(_sum(evidence.cells, law.cells, constant), (evidence.two.shape[0], evidence.two.shape[1]))


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
