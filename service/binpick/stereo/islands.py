"""Islands of a disparity map: sound pixels side by side whose disparities go on; small ones are no surface but speckles.

What cv2.filterSpeckles finds, in a fraction of its time: rows are cut into runs, and runs that touch are joined (union-find).
"""

import numpy as np
from jaxtyping import Bool, Float32, Int32

from binpick.data import Disparity, Mask
from binpick.stereo.compiled import compiled

SCALE, FAR = np.float32(16), np.int32(32)
"""Neighbours on an island differ by 2 px at most, told in whole 1/16 px as OpenCV does."""
SEA = np.int32(-1000)
"""The level of what is not sound: far from all that is."""
Line = Int32[np.ndarray, "w"]
Runs = Int32[np.ndarray, "n"]


@compiled
def small(disparity: Disparity, sound: Mask, most_px: int) -> Mask:
    """The sound pixels on islands of up to `most_px` pixels."""
    rows, cols = sound.shape
    # memory that no run needs is never touched
    begin, joined = np.empty(rows * cols + 1, np.int32), np.empty(rows * cols, np.int32)
    level, above = np.empty(cols, np.int32), np.empty(cols, np.int32)
    run, run_above, count = np.empty(cols, np.int32), np.empty(cols, np.int32), 0
    for v in range(rows):
        level, above, run, run_above = above, level, run_above, run
        _levels(disparity[v], sound[v], level)
        count = _cut(level, run, begin, joined, v * cols, count)
        if v > 0:
            _join(level, above, run, run_above, joined)
    begin[count] = rows * cols
    size, speckle = _sizes(begin[:count + 1], joined), np.zeros(rows * cols, np.bool_)
    for number in range(count):
        if size[number] <= most_px and sound[begin[number] // cols, begin[number] % cols]:
            speckle[begin[number]:begin[number + 1]] = True
    return speckle.reshape((rows, cols))


@compiled
def _levels(disparity: Float32[np.ndarray, "w"], sound: Bool[np.ndarray, "w"], level: Line) -> None:
    for u in range(len(level)):
        level[u] = np.int32(disparity[u] * SCALE) if sound[u] else SEA


@compiled
def _cut(level: Line, run: Line, begin: Runs, joined: Runs, place: int, count: int) -> int:
    """Cuts a row into runs, numbered from `count` on, each an island of its own yet; how many there are now."""
    for u in range(len(level)):
        if u == 0 or abs(level[u] - level[u - 1]) > FAR:
            begin[count], joined[count] = place + u, count
            count += 1
        run[u] = count - 1
    return count


@compiled
def _join(level: Line, above: Line, run: Line, run_above: Line, joined: Runs) -> None:
    last, last_above = np.int32(-1), np.int32(-1)
    for u in range(len(level)):
        if (run[u] != last or run_above[u] != last_above) and abs(level[u] - above[u]) <= FAR:
            last, last_above = run[u], run_above[u]
            one, other = _first(joined, last), _first(joined, last_above)
            joined[max(one, other)] = min(one, other)


@compiled
def _first(joined: Runs, number: np.int32) -> np.int32:
    """The first run of the island that a run belongs to; the way there is halved for those who come later."""
    while joined[number] != number:
        joined[number] = joined[joined[number]]
        number = joined[number]
    return number


@compiled
def _sizes(begin: Runs, joined: Runs) -> Runs:
    """Pixels of each run's island. Runs are joined to earlier ones only."""
    size: Runs = begin[1:] - begin[:-1]
    for number in range(len(size) - 1, -1, -1):
        if joined[number] != number:
            size[joined[number]] += size[number]
    for number in range(len(size)):
        size[number] = size[joined[number]]
    return size
