"""What it costs to match two pixels: unlike grey levels and slopes, summed over a block, for a row and all its disparities.

Birchfield and Tomasi's measure (1998): a pixel is compared with the range that the other image takes half a pixel around its
match, so sampling costs nothing. As OpenCV's semi-global matcher has it: slopes cut at 31, and a fourth of the grey levels.
Costs of a row lie one after the other, disparity by disparity. A pixel's matches lie to its right, at x + disparity: a left
image and its right one come mirrored.
"""

from typing import Any

import numpy as np
from jaxtyping import Int16, UInt8

from binpick.data import Image
from binpick.stereo.compiled import compiled
from binpick.stereo.lanes import LANES, all_of, least, load, minus, most, plus, quarter, store, widened

STEEPEST = 31
"""Where slopes are cut."""
MOST_SLOPE = np.int32(STEEPEST)
SLOPE, GREY = 0, 3
"""Where a prepared row holds each signal: the signal itself, then its least and its most half a pixel around."""
Prepared = UInt8[np.ndarray, "h 6 w"]


@compiled
def prepared(image: Image) -> Prepared:
    """Slopes (Sobel's leftwards, plus 31) and grey levels of an image, each with its range half a pixel around."""
    rows, cols = image.shape
    out = np.empty((rows, 6, cols), np.uint8)
    for y in range(rows):
        above, here, below = image[max(y - 1, 0)], image[y], image[min(y + 1, rows - 1)]
        slope = out[y, SLOPE]
        out[y, GREY] = here
        slope[0] = slope[cols - 1] = STEEPEST
        for x in range(1, cols - 1):
            rise = np.int32(above[x - 1]) - np.int32(above[x + 1]) + np.int32(below[x - 1]) - np.int32(below[x + 1])
            rise += (np.int32(here[x - 1]) - np.int32(here[x + 1])) * 2
            slope[x] = np.uint8(STEEPEST + min(max(rise, -MOST_SLOPE), MOST_SLOPE))
        for signal in (SLOPE, GREY):
            _range(out[y, signal], out[y, signal + 1], out[y, signal + 2])
    return out


@compiled
def _range(values: UInt8[np.ndarray, "w"], low: UInt8[np.ndarray, "w"], high: UInt8[np.ndarray, "w"]) -> None:
    last = len(values) - 1
    for x in (0, last):
        low[x] = high[x] = values[x]
    for x in range(1, last):
        value = np.int32(values[x])
        before, after = (value + np.int32(values[x - 1])) >> 1, (value + np.int32(values[x + 1])) >> 1
        low[x], high[x] = np.uint8(min(value, before, after)), np.uint8(max(value, before, after))


@compiled
def enter(here: UInt8[np.ndarray, "6 w"], there: UInt8[np.ndarray, "6 other_w"], leaving: UInt8[np.ndarray, "n"],
          column: Int16[np.ndarray, "n"], disparities: int) -> None:
    """A row enters a block's columns: its costs are added to `column`, those in `leaving` are taken off and replaced."""
    slope, slope_low, slope_high = there[SLOPE], there[SLOPE + 1], there[SLOPE + 2]
    grey, grey_low, grey_high = there[GREY], there[GREY + 1], there[GREY + 2]
    for x in range(len(column) // disparities):
        own_slope = all_of(here[SLOPE, x]), all_of(here[SLOPE + 1, x]), all_of(here[SLOPE + 2, x])
        own_grey = all_of(here[GREY, x]), all_of(here[GREY + 1, x]), all_of(here[GREY + 2, x])
        for d in range(0, disparities, LANES):
            at, match = x * disparities + d, x + d
            cost = plus(_unlike(own_slope, (load(slope, match), load(slope_low, match), load(slope_high, match))),
                        quarter(_unlike(own_grey, (load(grey, match), load(grey_low, match), load(grey_high, match)))))
            store(column, at, plus(load(column, at), minus(widened(cost), widened(load(leaving, at)))))
            store(leaving, at, cost)


@compiled
def _unlike(one: Any, other: Any) -> Any:
    """How far each value lies outside of the other's range, the lesser of the two."""
    return least(most(minus(one[0], other[2]), minus(other[1], one[0])),
                 most(minus(other[0], one[2]), minus(one[1], other[0])))


@compiled
def blocks(column: Int16[np.ndarray, "n"], cost: Int16[np.ndarray, "n"], disparities: int, radius: int) -> None:
    """Columns summed along the row; the first and the last one stand for those beyond."""
    last = len(column) // disparities - 1
    for d in range(0, disparities, LANES):
        total = load(column, d)
        for x in range(1, radius + 1):
            total = plus(plus(total, load(column, d)), load(column, min(x, last) * disparities + d))
        store(cost, d, total)
    for x in range(1, last + 1):
        at, come, gone = x * disparities, min(x + radius, last) * disparities, max(x - 1 - radius, 0) * disparities
        for d in range(0, disparities, LANES):
            change = minus(load(column, come + d), load(column, gone + d))
            store(cost, at + d, plus(load(cost, at - disparities + d), change))
