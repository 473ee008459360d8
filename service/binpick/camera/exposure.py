"""Auto exposure: from how bright a test shot came out to the next one's exposure and gain, until it is right or cannot be."""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import UInt8

from binpick.message import Metering
from binpick.settings.recipe import AutoExposure

Window = UInt8[np.ndarray, "_ _"]
SATURATED, BLACK = 250, 3
"""Grey levels from which a level says only that there is too much light, and up to which only that there is too little."""
TOLERANCE = 0.1
"""So far from the target, as a share of it, the level may be."""
STEADY = 2
"""Shots in a row within the tolerance, of one exposure: a lamp that flickers gives one by chance."""
MOST_SHOTS = 10
LEAST_FACTOR, MOST_FACTOR = 0.25, 8.0
"""Of a step; the first one is taken when the level is saturated, which hides how bright it is."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What exposure and gain may be, by the recipe and by the cameras."""

    shortest_us: float
    longest_us: float
    lowest_db: float
    highest_db: float

    def begin(self, exposure_us: float) -> "Search":
        """A search that starts there."""
        return Search(*self.split(exposure_us * 10 ** (self.lowest_db / 20)))

    def split(self, light: float) -> tuple[float, float]:
        """Exposure and gain of so much light, in µs without gain: gain above the lowest only beyond the longest exposure."""
        base = 10 ** (self.lowest_db / 20)
        exposure_us = min(max(light / base, self.shortest_us), self.longest_us)
        more_db = 20 * math.log10(max(light / (exposure_us * base), 1.0))
        return round(exposure_us, 1), round(min(self.lowest_db + more_db, self.highest_db), 2)


@dataclass(frozen=True, slots=True)
class Search:
    """Auto exposure of one kind of light after the shots so far; `level` is what the last one came out with.

    It is over when there is an `outcome`: then exposure and gain stay as they are.
    """

    exposure_us: float
    gain_db: float
    outcome: Metering = ""
    level: float = 0.0
    steady: int = 0
    direction: int = 0
    """Of the last step, as far as that is known: 1 to more light, -1 to less, 0 from a level that tells little."""
    wished: tuple[float, ...] = ()
    """How much light each shot asked for, in µs without gain."""

    @property
    def light(self) -> float:
        """Exposure and gain in one number, µs without gain."""
        return self.exposure_us * float(10 ** (self.gain_db / 20))


def step(search: Search, level: float, wanted: AutoExposure, limits: Limits) -> Search:
    """The search after one more shot with its exposure and gain, whose `level` came out so.

    After one that was too bright and one that was too dark only half of the way is gone, since then it is the lamp that
    changes; when that does not end, the middle of what was asked for is kept, and called unsteady.
    """
    known = BLACK < level < SATURATED
    factor = wanted.target_grey / level if known else LEAST_FACTOR if level > BLACK else MOST_FACTOR
    factor = min(max(factor, LEAST_FACTOR), MOST_FACTOR)
    direction = (1 if factor > 1 else -1) if known else 0
    after = replace(search, level=level, wished=(*search.wished, search.light * factor), direction=direction)
    right = abs(level / wanted.target_grey - 1) <= TOLERANCE
    after = replace(after, steady=search.steady + 1 if right else 0)
    if after.steady >= STEADY:
        return replace(after, outcome="settled")
    if len(after.wished) >= MOST_SHOTS:
        exposure_us, gain_db = limits.split(float(np.exp(np.median(np.log(after.wished[MOST_SHOTS // 2:])))))
        return replace(after, exposure_us=exposure_us, gain_db=gain_db, outcome="unsteady", level=wanted.target_grey)
    if right:
        return after
    half = search.direction * direction < 0 or search.steady > 0
    exposure_us, gain_db = limits.split(search.light * (math.sqrt(factor) if half else factor))
    if (exposure_us, gain_db) == (search.exposure_us, search.gain_db):
        return replace(after, outcome="too_dark" if factor > 1 else "too_bright")
    return replace(after, exposure_us=exposure_us, gain_db=gain_db)


def drifted(search: Search, level: float, wanted: AutoExposure) -> bool:
    """Whether a cycle's images are so much brighter or darker than those the search ended with that it is to be done again."""
    usual = max(search.level, BLACK)
    return not 1 / (1 + wanted.drift) <= max(level, BLACK) / usual <= 1 + wanted.drift


def level(images: tuple[Window, ...], percentile: float) -> float:
    """The grey level that this share of the pixels (%) does not exceed, of the brightest image."""
    return max(_level(image, percentile) for image in images)


def _level(image: Window, percentile: float) -> float:
    counts = np.cumsum(cv2.calcHist([np.ascontiguousarray(image)], [0], None, [256], [0, 256])[:, 0].astype(np.int64))
    return float(np.searchsorted(counts, percentile / 100 * counts[-1]))
