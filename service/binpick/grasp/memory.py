"""What failed is not tried again: the laws of a bin's memory, from the outcomes of grasps to the next cycle's choice.

A failure speaks of a spot and of what lies around it, so it is forgotten as soon as that changed. All heights are compared in
whole tenths of a millimetre, so that a memory read back from a file decides as the one that was written.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np
from jaxtyping import Bool, Float32, Int, Int16

from binpick import geometry
from binpick.cycle import CycleInput, CycleResult
from binpick.data import Grasp, HeightMap, Segments
from binpick.geometry import Transform
from binpick.message import Triple
from binpick.outcomes import COLLISION, DOUBLE, DROPPED, MISSED, OK, UNREACHABLE, Attempt, Grid, Look, Memory
from binpick.result import GraspMessage

FAILURES = (MISSED, DROPPED, COLLISION, DOUBLE)
"""What speaks against a part's hold. Skipped says nothing; unreachable speaks of a pose, not of a hold."""
PENALTY = 0.2
"""What each failure on its part leaves of a grasp's quality (Sanders 2020)."""
BLOCKING = 2
"""So many failures block a part for a tool that comes the same way."""
SAME_SPOT_M = 0.010
SAME_POSE_RAD = math.radians(15)
SAME_WAY_RAD = math.radians(30)
PATCH = 20
"""Cells along a patch's side: 40 mm."""
UNSEEN = -0x8000
TENTHS_PER_M = 1e4
CHANGED_TENTHS = 20
"""A cell that differs by less shows the same: 2 mm, at 1 m five sigma of depth."""
UNCHANGED_SHARE = 0.80
FORGET_AFTER = timedelta(hours=1)
"""What nobody touched for so long was not a matter of the spot alone."""
KEPT = 256
"""Attempts kept of a bin; the oldest go first."""

Tenths = Int16[np.ndarray, "rows cols"]


def tenths(heights: HeightMap) -> Tenths:
    """The measured heights in whole tenths of a millimetre, UNSEEN where nothing was measured."""
    seen = np.isfinite(heights.height)
    whole = np.clip(np.rint(np.where(seen, heights.height, 0) * np.float32(TENTHS_PER_M)), -0x7FFF, 0x7FFF)
    return np.where(seen, whole, UNSEEN).astype(np.int16)


def standing(memory: Memory, heights: HeightMap, captured_at: str, verdicts: Sequence[Attempt] = ()) -> Memory:
    """With what was seen, and without the attempts around which something changed, or which are too old."""
    now = tenths(heights)
    attempts = sorted((*memory.attempts, *verdicts), key=lambda attempt: attempt.name)[-KEPT:]
    kept = [attempt for attempt in attempts
            if _age(attempt.captured_at, captured_at) < FORGET_AFTER
            and unchanged(attempt.patch.cells, _patch(now, heights, attempt.position_m))]
    silent = memory.silent or any(verdict.outcome in (OK, DOUBLE) for verdict in verdicts)
    return memory.model_copy(update={"attempts": tuple(kept), "silent": silent})


def unchanged(before: Tenths, after: Tenths) -> bool:
    """Whether of the cells seen both times at least UNCHANGED_SHARE differ by less than 2 mm.

    Where nothing can be compared nothing is known to have changed.
    """
    both = (before != UNSEEN) & (after != UNSEEN)
    same = np.abs(before[both].astype(np.int32) - after[both]) < CHANGED_TENTHS
    return bool(not both.any() or same.mean() >= UNCHANGED_SHARE)


def weighed(grasps: Sequence[Grasp], memory: Memory) -> tuple[list[Grasp], int]:
    """Grasps, best first, without those that are blocked, of which the number is given too; the order is by quality again.

    Blocked is the very pose that was told to have failed or to be unreachable, and, from two failures of a tool on a part on,
    every pose of that tool that comes the same way.
    """
    speaking = [attempt for attempt in memory.attempts if attempt.outcome in (*FAILURES, UNREACHABLE)]
    if not grasps or not speaking:
        return list(grasps), 0
    failures, blocked = _history(grasps, speaking)
    kept = [replace(grasp, quality=round(grasp.quality * PENALTY ** count, 3)) if count else grasp
            for grasp, count, out in zip(grasps, failures.tolist(), blocked.tolist(), strict=True) if not out]
    return sorted(kept, key=lambda grasp: -grasp.quality), len(grasps) - len(kept)


def _history(grasps: Sequence[Grasp], attempts: Sequence[Attempt]) -> tuple[Int[np.ndarray, "g"], Bool[np.ndarray, "g"]]:
    """Of each grasp how many failures there were on its part, and whether it is blocked."""
    T_bin_tcp = np.stack([grasp.T_bin_tcp for grasp in grasps])
    distances_m = np.linalg.norm(T_bin_tcp[:, None, :3, 3] - np.array([attempt.position_m for attempt in attempts]), axis=2)
    cosines = T_bin_tcp[:, :3, 2] @ np.array([attempt.approach for attempt in attempts]).T
    same_tool = np.equal.outer([grasp.tool for grasp in grasps], [attempt.tool for attempt in attempts])
    failed = np.array([attempt.outcome in FAILURES for attempt in attempts])
    told = np.array([attempt.source == "told" for attempt in attempts])
    near = same_tool & failed & (distances_m <= np.array([attempt.reach_m for attempt in attempts]))
    again = same_tool & told & (distances_m <= SAME_SPOT_M) & (cosines > math.cos(SAME_POSE_RAD))
    ways = (near & (cosines > math.cos(SAME_WAY_RAD))).sum(axis=1)
    return near.sum(axis=1), again.any(axis=1) | (ways >= BLOCKING)


def looked(inputs: CycleInput, published: Sequence[GraspMessage], T_bin_frame: Transform, heights: HeightMap,
           segments: Segments) -> Memory:
    """The memory after a cycle: what it saw and published beside what still stands.

    `T_bin_frame` maps the grasps' frame to the bin's.
    """
    if not published:
        return inputs.memory.model_copy(update={"look": None})
    now = tenths(heights)
    parts = np.zeros(now.shape, dtype=np.int16)
    attempts: list[Attempt] = []
    for grasp in published:
        T_bin_tcp = T_bin_frame @ geometry.from_quaternion(np.array(grasp.position_m), np.array(grasp.quaternion_xyzw))
        x, y, z = np.round(T_bin_tcp[:3, 3], 6).tolist()
        ax, ay, az = np.round(T_bin_tcp[:3, 2], 6).tolist()
        mine = _cells(segments.part_points[grasp.part_id], heights)
        parts[mine & (parts == 0)] = grasp.number
        half_m = round(float(np.sqrt(mine.sum())) * heights.cell_m / 2, 6)
        attempts.append(Attempt(
            captured_at=inputs.pair.captured_at, cycle_id=inputs.cycle_id, grasp=grasp.number, tool=grasp.tool.number,
            position_m=(x, y, z), approach=(ax, ay, az), reach_m=max(SAME_SPOT_M, half_m),
            patch=Grid.of(_patch(now, heights, (x, y, z)))))
    look = Look(heights=Grid.of(now), parts=Grid.of(parts), attempts=tuple(attempts))
    return inputs.memory.model_copy(update={"look": look})


def told(memory: Memory, attempt: Attempt, outcome: int) -> Memory:
    """With what the controller said of a grasp (wire codes 1 to 7).

    Said again it changes nothing, a later word replaces an earlier one, and words about different grasps may come in any order.
    Of a cycle that the controller speaks of nothing needs to be seen: what was is dropped.
    """
    cycle = attempt.name[:2]
    known = {a.name: a for a in memory.attempts if a.source == "told" or a.name[:2] != cycle}
    known[attempt.name] = attempt.model_copy(update={"outcome": outcome, "source": "told"})
    spoken_of = memory.look is not None and any(a.name[:2] == cycle for a in memory.look.attempts)
    return Memory(attempts=tuple(known[name] for name in sorted(known)[-KEPT:]), look=None if spoken_of else memory.look)


def after(memory: Memory, cycle: CycleResult, outcomes: Mapping[int, int]) -> Memory:
    """The memory after a cycle that started from `memory`, and what was told of its grasps: wire codes by grasp number.

    Cycles of one bin need different ids or instants, for these name the attempts. Raises KeyError for a grasp it has not.
    """
    memory = cycle.memory or memory
    published = {attempt.grasp: attempt for attempt in cycle.attempts}
    for number, outcome in sorted(outcomes.items()):
        memory = told(memory, published[number], outcome)
    return memory


def merged(before: Memory, after: Memory, now: Memory) -> Memory:
    """A cycle's memory, `after`, made from `before`, with what was told while it ran, which made `before` into `now`."""
    old = {attempt.name: attempt for attempt in before.attempts}
    for attempt in now.attempts:
        if old.get(attempt.name) != attempt:
            after = told(after, attempt, attempt.outcome)
    return after


def _patch(now: Tenths, heights: HeightMap, position_m: Triple) -> Int16[np.ndarray, "side side"]:
    """The PATCH x PATCH cells around a position; cells outside the bin are unseen."""
    i = int(np.floor((position_m[1] - heights.origin_y_m) / heights.cell_m)) - PATCH // 2
    j = int(np.floor((position_m[0] - heights.origin_x_m) / heights.cell_m)) - PATCH // 2
    patch = np.full((PATCH, PATCH), UNSEEN, dtype=np.int16)
    rows, cols = slice(max(i, 0), max(i + PATCH, 0)), slice(max(j, 0), max(j + PATCH, 0))
    inside = now[rows, cols]
    patch[rows.start - i:rows.start - i + inside.shape[0], cols.start - j:cols.start - j + inside.shape[1]] = inside
    return patch


def _cells(points: Float32[np.ndarray, "n 3"], heights: HeightMap) -> Bool[np.ndarray, "rows cols"]:
    """The cells above which a part's points (frame `bin`) lie."""
    rows, cols = heights.height.shape
    mask = np.zeros((rows, cols), dtype=bool)
    j = np.floor((points[:, 0] - heights.origin_x_m) / heights.cell_m).astype(np.int64)
    i = np.floor((points[:, 1] - heights.origin_y_m) / heights.cell_m).astype(np.int64)
    inside = (i >= 0) & (i < rows) & (j >= 0) & (j < cols)
    mask[i[inside], j[inside]] = True
    return mask


def _age(then: str, now: str) -> timedelta:
    """Of two instants in ISO 8601; none where a clock was set back."""
    return max(datetime.fromisoformat(now) - datetime.fromisoformat(then), timedelta(0))
