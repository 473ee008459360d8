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
from jaxtyping import Float32

from binpick.data import Disparity, Mask
from binpick.stereo.compiled import compiled
from binpick.stereo.evidence import Evidence
from binpick.stereo.weights import Model, Network

LEAST_SIGMA_PX, MOST_SIGMA_PX = 0.02, 3.0
"""Sigma is no smaller than what a 14x14 px window can tell at best, and no larger than what it was fitted on."""
BLOCK = 1024
"""Columns that are taken through a network at a time: they stay in the cache, and so few BLAS never shares among threads."""
QUARTER = np.float32(0.25)
Pixels = Float32[np.ndarray, "n h w"]
OfCells = Float32[np.ndarray, "m h2 w2"]
Measures = Float32[np.ndarray, "n k"]
Field = Float32[np.ndarray, "h w"]
Vector = Float32[np.ndarray, "n"]


@dataclass(frozen=True, slots=True, eq=False)
class Trust:
    """Log-odds that a match is more than 1 px off, and its sigma in px; both mean nothing where nothing is matched."""

    odds: Float32[np.ndarray, "h w"]
    sigma_px: Disparity


def judge(evidence: Evidence, model: Model) -> Trust:
    """What the evidence says of every pixel, by what was fitted at its resolution."""
    pixels, cells, two, law = evidence.pixels, evidence.cells, evidence.two, model.wrong
    of_cells = answer(model.sigma, _means(pixels, cells)).reshape(cells.shape[1:])
    weights = np.float32(law.constant), np.array(law.pixels, np.float32), np.array(law.cells, np.float32)
    odds, log_sigma = _alone(pixels, cells, *weights, of_cells)
    contested = _contested(pixels, cells, two, int(np.count_nonzero(two)))
    _put(odds, two, answer(model.wrong_between, contested))
    _put(log_sigma, two, answer(model.sigma_between, contested))
    return Trust(odds, np.clip(cv2.exp(log_sigma), LEAST_SIGMA_PX, MOST_SIGMA_PX))


def answer(network: Network, measures: Measures) -> Float32[np.ndarray, "k"]:
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


@compiled
def _means(pixels: Pixels, cells: OfCells) -> Measures:
    """All measures of every cell: the pixels' means, then its own."""
    n, m, rows, cols = len(pixels), *cells.shape
    measures = np.empty((n + m, rows, cols), np.float32)
    for k in range(n):
        for row in range(rows):
            top, bottom = pixels[k, 2 * row], pixels[k, 2 * row + 1]
            for col in range(cols):
                measures[k, row, col] = (top[2 * col] + top[2 * col + 1] + bottom[2 * col] + bottom[2 * col + 1]) * QUARTER
    measures[n:] = cells
    return measures.reshape((n + m, rows * cols))


@compiled
def _alone(pixels: Pixels, cells: OfCells, constant: np.float32, of_pixels: Vector, of_cells: Vector, log_sigma: Field,
           ) -> tuple[Field, Field]:
    """Log-odds and the log of sigma where one surface is seen; the last cells also on an odd last row and column."""
    (m, rows, cols), (n, height, width) = cells.shape, pixels.shape
    odds, sigmas = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    line = np.empty(cols, np.float32)
    for v in range(height):
        row = min(v // 2, rows - 1)
        line[:] = constant
        for k in range(m):
            _add(line, cells[k, row], of_cells[k])
        for u in range(2 * cols):
            odds[v, u], sigmas[v, u] = line[u // 2], log_sigma[row, u // 2]
        if width % 2:
            odds[v, width - 1], sigmas[v, width - 1] = line[cols - 1], log_sigma[row, cols - 1]
        for k in range(n):
            _add(odds[v], pixels[k, v], of_pixels[k])
    return odds, sigmas


@compiled
def _add(total: Vector, values: Vector, weight: np.float32) -> None:
    if weight != 0:
        for i in range(len(total)):
            total[i] += values[i] * weight


@compiled
def _contested(pixels: Pixels, cells: OfCells, two: Mask, count: int) -> Measures:
    """All measures of the `count` pixels between two surfaces, in the order of rows."""
    (m, rows, cols), n, begin = cells.shape, len(pixels), 0
    measures, places = np.empty((n + m, count), np.float32), np.empty(two.shape[1], np.intp)
    for v in range(len(two)):
        found, row = 0, min(v // 2, rows - 1)
        for u in range(two.shape[1]):
            places[found] = u
            found += two[v, u]
        for i in range(found):
            for k in range(n):
                measures[k, begin + i] = pixels[k, v, places[i]]
            for k in range(m):
                measures[n + k, begin + i] = cells[k, row, min(places[i] // 2, cols - 1)]
        begin += found
    return measures


@compiled
def _put(field: Field, where: Mask, figures: Vector) -> None:
    i = 0
    for v in range(len(where)):
        for u in range(where.shape[1]):
            if where[v, u]:
                field[v, u] = figures[i]
                i += 1


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
