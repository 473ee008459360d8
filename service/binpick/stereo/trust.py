"""What is measured: how likely each match is wrong, and its sigma if it is not, both told from the evidence.

One figure is the log-odds of an error beyond 1 px, the other the log of the error's size. The odds of a surface seen alone are
linear in the evidence, so that they mean something on images unlike those they were fitted on; the rest are small networks:
between two surfaces "which of the two?" is no linear question, nor is what adds to an error. The weights were fitted on the
exam's tuning seeds by `lab/fit.py`; `binpick bench stereo` says how well they hold.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Int

from binpick.data import Disparity, Mask
from binpick.stereo.evidence import Evidence
from binpick.stereo.refine import mean_of_four, spread
from binpick.stereo.weights import Model, Network

LEAST_SIGMA_PX, MOST_SIGMA_PX = 0.02, 3.0
"""Sigma is no smaller than what a 14x14 px window can tell at best, and no larger than what it was fitted on."""
BLOCK = 1024
"""Columns that are taken through a network at a time: they stay in the cache, and so few BLAS never shares among threads."""


@dataclass(frozen=True, slots=True, eq=False)
class Trust:
    """Log-odds that a match is more than 1 px off, and its sigma in px; both mean nothing where nothing is matched."""

    odds: Float32[np.ndarray, "h w"]
    sigma_px: Disparity


def judge(evidence: Evidence, model: Model) -> Trust:
    """What the evidence says of every pixel, by what was fitted at its resolution."""
    shape, cells = (evidence.two.shape[0], evidence.two.shape[1]), evidence.cells
    constant = np.full(cells.shape[1:], model.wrong.constant, np.float32)
    odds = _sum(evidence.pixels, model.wrong.pixels, spread(_sum(cells, model.wrong.cells, constant), shape))
    means = np.concatenate([*(mean_of_four(plane)[None] for plane in evidence.pixels), cells])
    log_sigma = spread(answer(model.sigma, means.reshape(len(means), -1)).reshape(cells.shape[1:]), shape)
    v, u = np.nonzero(evidence.two)
    contested = _at(evidence, v, u)
    for field, network in ((odds, model.wrong_between), (log_sigma, model.sigma_between)):
        field[v, u] = answer(network, contested)
    return Trust(odds, np.clip(cv2.exp(log_sigma), LEAST_SIGMA_PX, MOST_SIGMA_PX))


def _at(evidence: Evidence, v: Int[np.ndarray, "k"], u: Int[np.ndarray, "k"]) -> Float32[np.ndarray, "n k"]:
    """All measures at some pixels, given by row and column."""
    rows, cols = evidence.cells.shape[1:]
    pixel, cell = v * evidence.two.shape[1] + u, np.minimum(v >> 1, rows - 1) * cols + np.minimum(u >> 1, cols - 1)
    return np.stack([plane.ravel().take(pixel) for plane in evidence.pixels]
                    + [plane.ravel().take(cell) for plane in evidence.cells])


def answer(network: Network, measures: Float32[np.ndarray, "n k"]) -> Float32[np.ndarray, "k"]:
    """The network's figure for every column of measures."""
    hidden, offsets, out = (np.array(weights, np.float32) for weights in (network.hidden, network.offsets, network.out))
    figures = np.empty(measures.shape[1], np.float32)
    for begin in range(0, len(figures), BLOCK):
        block = slice(begin, begin + BLOCK)
        active = hidden @ measures[:, block]
        active += offsets[:, None]
        np.matmul(out, np.maximum(active, 0, out=active), out=figures[block])
    figures += np.float32(network.constant)
    return figures


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
