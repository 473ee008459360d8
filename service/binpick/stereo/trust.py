"""What is measured: how likely each match is wrong, and its sigma if it is not, both told from the evidence.

One figure is the log-odds of an error beyond 1 px, the other the log of the error's size. The odds of a surface seen alone are
linear in the evidence, so that they mean something on images unlike those they were fitted on; the rest are small networks:
between two surfaces "which of the two?" is no linear question, nor is what adds to an error. The weights were fitted on the
exam's tuning seeds by `lab/fit.py`; `binpick bench stereo` says how well they hold.
"""

import math
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int

from binpick.data import Disparity, Mask
from binpick.stereo import islands, sums
from binpick.stereo.compiled import compiled
from binpick.stereo.evidence import Evidence
from binpick.stereo.weights import Model, Network

LEAST_SIGMA_PX, MOST_SIGMA_PX = 0.02, 3.0
"""Sigma is no smaller than what a 14x14 px window can tell at best, and no larger than what it was fitted on."""
QUARTER = np.float32(0.25)
Pixels = Float32[np.ndarray, "n h w"]
OfCells = Float32[np.ndarray, "m h2 w2"]
Measures = Float32[np.ndarray, "n k"]
Field = Float32[np.ndarray, "h w"]
Vector = Float32[np.ndarray, "n"]
Weights: TypeAlias = tuple[np.float32, Vector, Vector, Float32[np.ndarray, "units k"]]
"""A network's constant, out, offsets, hidden."""


@dataclass(frozen=True, slots=True, eq=False)
class Trust:
    """Log-odds that a match is more than 1 px off, and its sigma in px; both mean nothing where nothing is matched."""

    odds: Float32[np.ndarray, "h w"]
    sigma_px: Disparity


def judge(evidence: Evidence, model: Model) -> Trust:
    """What the evidence says of every pixel, by what was fitted at its resolution."""
    law = np.float32(model.wrong.constant), np.array(model.wrong.pixels, np.float32), np.array(model.wrong.cells, np.float32)
    networks = (_weights(network) for network in (model.sigma, model.wrong_between, model.sigma_between))
    odds, log_sigma = _judged(evidence.pixels, evidence.cells, evidence.two, law, *networks)
    return Trust(odds, np.clip(cv2.exp(log_sigma), LEAST_SIGMA_PX, MOST_SIGMA_PX))


def answer(network: Network, measures: Measures) -> Float32[np.ndarray, "k"]:
    """The network's figure for every column of measures."""
    figures = np.empty(measures.shape[1], np.float32)
    _answer(_weights(network), np.ascontiguousarray(measures), figures)
    return figures


def _weights(network: Network) -> Weights:
    hidden, offsets, out = (np.array(weights, np.float32) for weights in (network.hidden, network.offsets, network.out))
    return np.float32(network.constant), out, offsets, hidden


@compiled
def _answer(network: Weights, measures: Measures, figures: Vector) -> None:
    """Figures of the first columns: as many as there is room for."""
    constant, out, offsets, hidden = network
    active = np.empty_like(figures)
    figures[:] = constant
    for unit in range(len(out)):
        active[:] = offsets[unit]
        for k in range(0, len(measures) - 3, 4):
            sums.add_four(active, measures[k], measures[k + 1], measures[k + 2], measures[k + 3], hidden[unit, k:k + 4])
        for k in range(len(measures) // 4 * 4, len(measures)):
            sums.add(active, measures[k], hidden[unit, k])
        for i in range(len(active)):
            figures[i] += out[unit] * active[i] if active[i] > 0 else np.float32(0)


@compiled
def _judged(pixels: Pixels, cells: OfCells, two: Mask, law: tuple[np.float32, Vector, Vector], sigma: Weights,
            wrong_between: Weights, sigma_between: Weights) -> tuple[Field, Field]:
    """Log-odds and the log of sigma, row by row of cells; the last ones also on an odd last row and column."""
    (m, rows, cols), (n, height, width) = cells.shape, pixels.shape
    odds, sigmas = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    line, line_sigma = np.empty(cols, np.float32), np.empty(cols, np.float32)
    measures, figures, places = np.empty((n + m, width), np.float32), np.empty(width, np.float32), np.empty(width, np.intp)
    for row in range(rows):
        _means(pixels, cells, row, measures)
        _answer(sigma, measures, line_sigma)
        line[:] = law[0]
        for k in range(m):
            sums.add(line, cells[k, row], law[2][k])
        for v in range(2 * row, 2 * row + 2 if row < rows - 1 else height):
            _twice(line, odds[v])
            _twice(line_sigma, sigmas[v])
            for k in range(n):
                sums.add(odds[v], pixels[k, v], law[1][k])
            between = places[:_places(two[v], places)]
            _contested(pixels, cells, v, between, measures)
            for network, field in ((wrong_between, odds), (sigma_between, sigmas)):
                _answer(network, measures, figures[:len(between)])
                for i in range(len(between)):
                    field[v, between[i]] = figures[i]
    return odds, sigmas


@compiled
def _means(pixels: Pixels, cells: OfCells, row: int, measures: Measures) -> None:
    """All measures of a row of cells: the pixels' means, then its own."""
    n = len(pixels)
    for k in range(n):
        top, bottom = pixels[k, 2 * row], pixels[k, 2 * row + 1]
        for col in range(cells.shape[2]):
            measures[k, col] = (top[2 * col] + top[2 * col + 1] + bottom[2 * col] + bottom[2 * col + 1]) * QUARTER
    for k in range(len(cells)):
        measures[n + k, :cells.shape[2]] = cells[k, row]


@compiled
def _twice(cells: Vector, line: Vector) -> None:
    """A row of cells on a row of pixels."""
    for col in range(len(cells)):
        line[2 * col] = line[2 * col + 1] = cells[col]
    line[len(line) - 1] = cells[len(cells) - 1]


@compiled
def _places(two: Bool[np.ndarray, "w"], places: Int[np.ndarray, "w"]) -> int:
    """The columns of a row where surfaces compete; how many there are."""
    found = 0
    for u in range(len(two)):
        places[found] = u
        found += two[u]
    return found


@compiled
def _contested(pixels: Pixels, cells: OfCells, v: int, places: Int[np.ndarray, "n"], measures: Measures) -> None:
    """All measures of a row's pixels at `places`."""
    n, (m, rows, cols) = len(pixels), cells.shape
    row = min(v // 2, rows - 1)
    for k in range(n):
        for i in range(len(places)):
            measures[k, i] = pixels[k, v, places[i]]
    for k in range(m):
        for i in range(len(places)):
            measures[n + k, i] = cells[k, row, min(places[i] // 2, cols - 1)]


def believed(disparity: Disparity, trust: Trust, max_risk: float) -> Mask:
    """Matched, and unlikely to be wrong."""
    return np.asarray(np.isfinite(disparity) & (trust.odds <= _log_odds(max_risk)))


def speckled(disparity: Disparity, sound: Mask, speckle_px: int) -> Mask:
    """The sound pixels in islands of up to `speckle_px`; within an island neighbours differ by 2 px at most."""
    return islands.small(disparity, sound, speckle_px)


def _log_odds(risk: float) -> float:
    return math.inf if risk >= 1 else math.log(risk / (1 - risk))
