"""Semi-global matching (Hirschmueller 2008) along three paths, row by row, in compiled loops.

What OpenCV's MODE_SGBM_3WAY finds, in less than half of its time: the same costs, the same paths (along the row both ways, and
down), the same uniqueness, check from the right and median of 3x3. Only fractions of a pixel are rounded to the nearest 1/16,
not towards zero, which made OpenCV's 1/32 px too small on average. Sums end at 16 bits instead of wrapping.
"""

from typing import Any

import cv2
import numpy as np
from jaxtyping import Int16, UInt8

from binpick import threads
from binpick.data import Image
from binpick.settings.stereo import Sgbm
from binpick.stereo import costs
from binpick.stereo.compiled import compiled
from binpick.stereo.lanes import (
    LANES,
    all_of,
    counted,
    least,
    load,
    lower,
    lowest,
    minus,
    most,
    plus,
    store,
    upper,
    where_equal,
    where_less,
    where_within,
)
from binpick.stereo.strip import Strip, strips

STRIP_ROWS, WARM_ROWS = 608, 26
"""Most rows that are matched at a time, half of a camera's, and rows above them from which the way down begins: so deep what is
above is felt. They do not depend on the machine: the bytes are the same whoever computes a strip."""
SCALE = 16
"""Disparities are integers in 1/16 px, as OpenCV's are."""
NONE = np.int16(-SCALE)
"""Nothing found: OpenCV's mark, one px below the range."""
TOP = np.int16(32767)
PAD = LANES
"""On both sides of a path's costs, TOP: what would be a disparity outside of the range."""
ONE = np.int32(1)
Found = Int16[np.ndarray, "h found_w"]
"""1/16 px, NONE where nothing was found."""
Row = Int16[np.ndarray, "w"]
Sums = Int16[np.ndarray, "n"]


def of_left(left: Image, right: Image, num_disparities: int, matcher: Sgbm) -> Found:
    """Disparities of the left image right of its margin of `num_disparities` columns.

    Matches that are not `matcher.uniqueness_percent` better than all others but their neighbours are dropped, and those that
    differ by more than 1 px from what the right image's pixel prefers.
    """
    here, there = (np.ascontiguousarray(image[:, ::-1]) for image in (left, right))
    found = _match(here, there, num_disparities, matcher, matcher.uniqueness_percent, True)
    return np.ascontiguousarray(found[:, ::-1])


def of_right(left: Image, right: Image, num_disparities: int, matcher: Sgbm) -> Found:
    """Disparities of the right image, all of it and all that was found: near its right border, what the left image's border
    repeated is most like."""
    return _match(right, cv2.copyMakeBorder(left, 0, 0, 0, num_disparities, cv2.BORDER_REPLICATE), num_disparities, matcher, 0,
                  False)


def _match(image: Image, other: UInt8[np.ndarray, "h other_w"], disparities: int, matcher: Sgbm, unique_percent: int,
           checked: bool) -> Found:
    """Disparities of an image whose pixels are found in the other one at x + disparity, wherever that one reaches so far."""
    rows, width = image.shape[0], other.shape[1] - disparities
    found = np.empty((rows, width), np.int16)
    with threads.pool("match") as pool:
        here, there = pool.map(costs.prepared, (image, other))

        def match(strip: Strip) -> None:
            _strip(here, there, strip.top, strip.bottom, disparities, matcher.block_px // 2, np.int16(matcher.p1),
                   np.int16(matcher.p2), unique_percent, checked, found)

        list(pool.map(match, strips(rows, STRIP_ROWS, 0)))
    return np.asarray(cv2.medianBlur(found, 3), np.int16)


@compiled
def _strip(here: costs.Prepared, there: costs.Prepared, top: int, bottom: int, disparities: int, radius: int, p1: np.int16,
           p2: np.int16, unique_percent: int, checked: bool, found: Int16[np.ndarray, "h w"]) -> None:
    rows, width, height = here.shape[0], found.shape[1], 2 * radius + 1
    size = width * disparities
    block = np.zeros((height, size), np.uint8)
    column, cost, total = np.zeros(size, np.int16), np.empty(size, np.int16), np.empty(size, np.int16)
    down, down_least = np.full(width * (disparities + PAD), TOP, np.int16), np.zeros(width, np.int16)
    for x in range(width):
        down[x * (disparities + PAD):x * (disparities + PAD) + disparities] = 0
    along = np.empty(2 * (disparities + 2 * PAD), np.int16)
    theirs, theirs_cost = np.empty(width + disparities, np.int16), np.empty(width + disparities, np.int16)
    first = max(0, top - WARM_ROWS)
    for y in range(first - height + 1, bottom):
        entering = min(max(y + radius, 0), rows - 1)
        costs.enter(here[entering], there[entering], block[y % height], column, disparities)
        if y < first:
            continue
        costs.blocks(column, cost, disparities, radius)
        _forth_and_down(cost, down, down_least, along, total, disparities, p1, p2)
        if y >= top:
            _back(cost, along, total, theirs, theirs_cost, disparities, p1, p2, unique_percent, found[y])
            if checked:
                _check(theirs, found[y])


@compiled
def _begin(along: Sums, disparities: int) -> None:
    along[:] = TOP
    along[PAD:PAD + disparities] = 0


@compiled
def _stepped(below: Any, here: Any, above: Any, cheapest: Any, jump: Any, p1: Any, cost: Any) -> Any:
    """The costs of a path one pixel further: stay, change by one, or jump from the cheapest."""
    return plus(minus(least(least(here, jump), plus(least(below, above), p1)), cheapest), cost)


@compiled
def _forth_and_down(cost: Sums, down: Sums, down_least: Row, along: Sums, total: Sums, disparities: int, p1: np.int16,
                    p2: np.int16) -> None:
    """The path along the row, and the one from above, whose costs and their least are kept for the next row; their sum."""
    _begin(along, disparities)
    old, new, cheapest, p1s, tops = PAD, disparities + 3 * PAD, np.int16(0), all_of(p1), all_of(TOP)
    for x in range(len(down_least)):
        jump, jump_down = all_of(_sum(cheapest, p2)), all_of(_sum(down_least[x], p2))
        floor, floor_down = all_of(cheapest), all_of(down_least[x])
        best, best_down, before, here = tops, tops, tops, load(down, x * (disparities + PAD))
        for d in range(0, disparities, LANES):
            at, way, above = x * disparities + d, old + d, x * (disparities + PAD) + d
            own, after = load(cost, at), load(down, above + LANES)
            forth = _stepped(load(along, way - 1), load(along, way), load(along, way + 1), floor, jump, p1s, own)
            falling = _stepped(lower(before, here), here, upper(here, after), floor_down, jump_down, p1s, own)
            store(along, new + d, forth)
            store(down, above, falling)
            store(total, at, plus(forth, falling))
            best, best_down, before, here = least(best, forth), least(best_down, falling), here, after
        old, new, cheapest, down_least[x] = new, old, lowest(best), lowest(best_down)


@compiled
def _back(cost: Sums, along: Sums, total: Sums, theirs: Row, theirs_cost: Row, disparities: int, p1: np.int16, p2: np.int16,
          unique_percent: int, found: Row) -> None:
    """The path back, and what is cheapest in the sum of all three; `theirs` is what each of the other image's pixels prefers.

    Of all disparities that share a lane the two cheapest are kept: the cheapest that is no neighbour of the best is then the
    first of a lane, or the second of those whose first is the best or beside it.
    """
    _begin(along, disparities)
    old, new, cheapest, p1s, tops = PAD, disparities + 3 * PAD, np.int16(0), all_of(p1), all_of(TOP)
    theirs[:], theirs_cost[:] = -1, TOP
    for x in range(len(found) - 1, -1, -1):
        jump, floor, best = all_of(_sum(cheapest, p2)), all_of(cheapest), tops
        first, second, where = tops, tops, all_of(np.int16(0))
        for d in range(0, disparities, LANES):
            at, way = x * disparities + d, old + d
            back = _stepped(load(along, way - 1), load(along, way), load(along, way + 1), floor, jump, p1s, load(cost, at))
            store(along, new + d, back)
            whole, best = plus(load(total, at), back), least(best, back)
            store(total, at, whole)
            where, second = where_less(whole, first, all_of(np.int16(d)), where), least(second, most(first, whole))
            first = least(first, whole)
        old, new, cheapest, price, places = new, old, lowest(best), lowest(first), plus(where, counted())
        winner = lowest(where_equal(first, all_of(price), places, tops))
        rival = lowest(where_within(minus(places, all_of(np.int16(winner - 1))), all_of(np.int16(3)), second, first))
        if np.int32(rival) * (100 - unique_percent) < np.int32(price) * 100:
            found[x] = NONE
            continue
        if theirs_cost[x + winner] > price:
            theirs_cost[x + winner], theirs[x + winner] = price, winner
        found[x] = _parabola(total, x * disparities, winner, disparities)


@compiled
def _sum(a: np.int16, b: np.int16) -> np.int16:
    return np.int16(min(np.int32(a) + np.int32(b), np.int32(TOP)))


@compiled
def _parabola(total: Sums, at: int, winner: np.int16, disparities: int) -> np.int16:
    """Its lowest point through the winner's and its neighbours' costs, 1/16 px."""
    whole = np.int32(winner) * SCALE
    if not 0 < winner < disparities - 1:
        return np.int16(whole)
    before, price, after = np.int32(total[at + winner - 1]), np.int32(total[at + winner]), np.int32(total[at + winner + 1])
    bend = max(before + after - 2 * price, ONE)
    return np.int16(whole + ((before - after) * SCALE + bend) // (2 * bend))


@compiled
def _check(theirs: Row, found: Row) -> None:
    """Drops what no pixel of the other image prefers within 1 px, at either of the whole disparities around."""
    for x in range(len(found)):
        if found[x] < 0:
            continue
        below, above = np.int32(found[x]) // SCALE, (np.int32(found[x]) + SCALE - 1) // SCALE
        if theirs[x + below] >= 0 and abs(theirs[x + below] - below) > 1 and theirs[x + above] >= 0 and abs(
                theirs[x + above] - above) > 1:
            found[x] = NONE
