"""Picks without feedback: the bin as it was seen last against the bin as it is, in a planted heap."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from binpick import geometry, pipeline
from binpick.cycle import CycleInput, CycleResult
from binpick.data import HeightMap, frozen
from binpick.errors import Code
from binpick.grasp import memory as laws
from binpick.grasp.verification import verified
from binpick.outcomes import DOUBLE, MISSED, OK, Attempt, Grid, Look, Memory
from binpick.settings.stereo import PRESETS

NO_CHANGE: Callable[[np.ndarray], None] = lambda grid: None  # noqa: E731
A, B, C = (np.s_[20:40, 20:50], np.s_[60:80, 30:60], np.s_[62:82, 90:120])
"""Blocks of 40 x 60 mm, 15 mm thick; A lies 20 mm high on another, B and C on the floor."""


def heap() -> np.ndarray:
    grid = np.zeros((100, 150), dtype=np.float32)
    grid[15:45, 15:55] = 0.02
    grid[A] += 0.015
    grid[B] = grid[C] = 0.015
    return grid


def seen(change: Callable[[np.ndarray], None] = NO_CHANGE, seed: int = 2) -> HeightMap:
    """A map with half a millimetre of noise and some cells unseen."""
    grid, draw = heap(), np.random.default_rng(seed)
    change(grid)
    grid += draw.normal(0, 0.0004, grid.shape).astype(np.float32)
    grid[draw.random(grid.shape) < 0.05] = np.nan
    return HeightMap(height=frozen(grid), watertight=frozen(grid), cell_m=0.002, origin_x_m=-0.15, origin_y_m=-0.1,
                     coverage=0.9)


def published(*parts: tuple[slice, slice]) -> Memory:
    """Two grasps on the first part, one on each other."""
    before, owners = laws.tenths(seen(seed=1)), np.zeros((100, 150), dtype=np.int16)
    numbers = [1, *range(3, 2 + len(parts))]
    for number, cells in zip(numbers, parts, strict=True):
        owners[cells] = number
    patch = Grid.of(np.zeros((20, 20), dtype=np.int16))
    attempts = (Attempt(captured_at="2026-01-01T00:00:00Z", cycle_id=4, grasp=number, tool=1, position_m=(0.0, 0.0, 0.1),
                        approach=(0.0, 0.0, -1.0), reach_m=0.02, patch=patch) for number in range(1, 2 + len(parts)))
    return Memory(look=Look(heights=Grid.of(before), parts=Grid.of(owners), attempts=tuple(attempts)), silent=True)


def verdicts(memory: Memory, change: Callable[[np.ndarray], None] = NO_CHANGE) -> dict[int, int]:
    found = verified(memory, seen(change))
    assert all(attempt.source == "seen" and attempt.cycle_id == 4 for attempt in found)
    return {attempt.grasp: attempt.outcome for attempt in found}


def lowered(*parts: tuple[slice, slice], by_m: float = 0.015) -> Callable[[np.ndarray], None]:
    def change(grid: np.ndarray) -> None:
        for cells in parts:
            grid[cells] -= by_m
    return change


def test_a_part_that_is_gone_was_picked_by_its_first_grasp() -> None:
    assert verdicts(published(A, B, C), lowered(A)) == {1: OK}
    assert verdicts(published(B, A, C), lowered(A)) == {3: OK}
    assert verdicts(published(A, B, C), lowered(B, C)) == {3: OK, 4: OK}


def test_two_that_are_gone_together_were_picked_at_once() -> None:
    below = np.s_[15:45, 15:55]

    def both(grid: np.ndarray) -> None:
        grid[below] = 0.0
    assert verdicts(published(A, B), both) == {1: DOUBLE}


def test_what_slid_into_the_gap_is_not_taken_for_a_second_part() -> None:
    def slid(grid: np.ndarray) -> None:
        grid[15:45, 15:55] = 0.0                      # the part and the one below it are not where they were,
        grid[15:45, 55:85] += 0.02                    # but that one lies beside
    assert verdicts(published(A, B), slid) == {1: OK}


def test_when_nothing_changed_at_all_the_first_grasp_missed() -> None:
    assert verdicts(published(A, B, C)) == {1: MISSED}


def test_but_not_before_a_robot_was_seen_to_pick_without_telling() -> None:
    unknown = published(A, B, C).model_copy(update={"silent": False})
    assert verdicts(unknown) == {}
    assert verdicts(unknown, lowered(A)) == {1: OK}
    for change, silent in ((NO_CHANGE, False), (lowered(A), True)):
        heights = seen(change)
        assert laws.standing(unknown, heights, "2026-01-01T00:01:00Z", verified(unknown, heights)).silent is silent
    assert not laws.told(published(A), published(A).look.attempts[0], MISSED).silent


@pytest.mark.parametrize("change", [
    lowered(np.s_[85:95, 5:20]), lowered(np.s_[85:95, 5:20], by_m=-0.01), lowered(np.s_[62:82, 92:98], by_m=0.004)],
    ids=["something else was taken", "something fell in", "a part was tilted"])
def test_a_change_elsewhere_says_nothing_of_a_grasp(change: Callable[[np.ndarray], None]) -> None:
    assert verdicts(published(A, B, C), change) == {}


@settings(max_examples=60, deadline=None, derandomize=True)
@given(rows=st.integers(0, 99), cols=st.integers(0, 149), by_mm=st.floats(-40, 40))
def test_single_cells_that_come_and_go_are_no_change(rows: int, cols: int, by_mm: float) -> None:
    assert verdicts(published(A, B, C), lowered(np.s_[rows:rows + 3, cols:cols + 3], by_m=by_mm / 1000)) == {1: MISSED}


def test_what_was_not_seen_has_no_verdict() -> None:
    def hidden(grid: np.ndarray) -> None:
        grid[A] = np.nan
        grid[85:95, 5:20] = 0.01
    assert verdicts(published(A, B), hidden) == {}
    assert verdicts(Memory()) == {}
    half = frozen(seen().height[:50].copy())
    assert verified(published(A), replace(seen(), height=half, watertight=half)) == ()


LAID = (("block", geometry.translation(0.0, 0.0, 0.0075)), ("block", geometry.translation(0.08, 0.03, 0.0075)))


@pytest.fixture(scope="module")
def cycles(photograph: Callable[..., CycleInput]) -> Callable[..., CycleResult]:
    """cycles(parts, memory): a cycle without feedback on what came before."""
    number = 0

    def run(parts: tuple[tuple[str, geometry.Transform], ...], memory: Memory) -> CycleResult:
        nonlocal number
        number += 1
        inputs = photograph(parts, seed=number)
        recipe = inputs.job.recipe.model_copy(update={"stereo": PRESETS["fast"]})
        job = inputs.job.model_copy(update={"recipe": recipe})
        return pipeline.run(replace(inputs, job=job, cycle_id=number, memory=memory))

    return run


def test_a_grasp_after_which_nothing_changed_is_put_back_once_and_blocked_twice(cycles: Callable[..., CycleResult]) -> None:
    first = cycles(LAID, Memory(silent=True))
    spot = np.array(first.result.grasps[0].position_m)

    def near(cycle: CycleResult, within_m: float) -> list[int]:
        return [g.rank for g in cycle.result.grasps if np.linalg.norm(np.subtract(g.position_m, spot)) < within_m]

    second = cycles(LAID, laws.after(Memory(), first, {}))
    assert [(a.grasp, a.outcome) for a in second.verified] == [(1, MISSED)]
    assert near(second, 0.01)
    assert near(second, 0.04)[0] > 1
    third = cycles(LAID, laws.after(Memory(), second, {}))
    assert len(third.memory.attempts) == 2                           # now the other block's first grasp, too
    fourth = cycles(LAID, laws.after(Memory(), third, {}))           # whichever came first has missed twice
    assert [len({g.part_id for g in cycle.result.grasps}) for cycle in (third, fourth)] == [2, 1]    # numbers are a cycle's own
    fifth = cycles(LAID, laws.after(Memory(), fourth, {}))
    assert fifth.result.return_code.code is Code.ALL_BLOCKED_BY_HISTORY
    one_gone = cycles(LAID[1:], laws.after(Memory(), first, {}))
    assert {a.outcome for a in one_gone.verified} == {OK}
    assert one_gone.memory.attempts == ()


def test_a_cell_that_only_looks_sees_the_same_every_time(cycles: Callable[..., CycleResult]) -> None:
    first = cycles(LAID, Memory())
    second = cycles(LAID, laws.after(Memory(), first, {}))
    assert second.verified == ()
    assert second.memory.attempts == ()
    assert min(grasp.quality for grasp in (*first.result.grasps, *second.result.grasps)) > 0.6      # nothing put back
