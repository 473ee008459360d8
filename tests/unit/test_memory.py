"""The memory of outcomes: what failed is not offered again until something changed there."""

import functools
import importlib
import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st
from pydantic import ValidationError

from binpick import geometry, pipeline, recording, settings
from binpick.cycle import CycleInput, CycleResult
from binpick.data import Grasp, HeightMap, frozen
from binpick.errors import Code
from binpick.grasp import memory as laws
from binpick.outcomes import COLLISION, DOUBLE, DROPPED, MISSED, OK, SKIPPED, UNREACHABLE, Attempt, Grid, Look, Memory
from binpick.result import Result

LATER = "2026-01-01T00:10:00Z"
SEED = 3


def bin_map(change: Callable[[np.ndarray], None] = lambda grid: None) -> HeightMap:
    """A heap in a bin of 200 x 160 mm: 20 mm steps of 30 mm, half a millimetre of noise, some cells unseen."""
    draw = np.random.default_rng(SEED)
    coarse = draw.integers(1, 5, (6, 7)).astype(np.float32) * np.float32(0.02)
    grid = np.kron(coarse, np.ones((15, 15), dtype=np.float32))[:80, :100].copy()
    change(grid)
    grid += draw.normal(0, 0.0004, grid.shape).astype(np.float32)
    grid[draw.random(grid.shape) < 0.05] = np.nan
    return HeightMap(height=frozen(grid), watertight=frozen(grid), cell_m=0.002, origin_x_m=-0.1, origin_y_m=-0.08,
                     coverage=0.9)


HEAP = bin_map()


@functools.cache
def patch_at(x: float, y: float) -> Grid:
    return Grid.of(laws._patch(laws.tenths(HEAP), HEAP, (x, y, 0.05)))


def attempt(number: int = 1, x: float = 0.0, y: float = 0.0, *, tool: int = 1, outcome: int = MISSED, cycle_id: int = 1,
            seen: bool = False) -> Attempt:
    return Attempt(captured_at="2026-01-01T00:00:00Z", cycle_id=cycle_id, grasp=number, tool=tool, position_m=(x, y, 0.05),
                   approach=(0.0, 0.0, -1.0), reach_m=0.025, outcome=outcome, source="seen" if seen else "told",
                   patch=patch_at(x, y))


def grasp(x: float = 0.0, y: float = 0.0, *, tool: int = 1, tilt: float = 0.0, quality: float = 0.8) -> Grasp:
    c, s = float(np.cos(tilt)), float(np.sin(tilt))
    T_bin_tcp = geometry.make(np.array([[1.0, 0, 0], [0, -c, s], [0, -s, -c]]), np.array([x, y, 0.05]))
    return Grasp(T_bin_tcp=T_bin_tcp, tool=tool, part_id=1, open_m=0.0, close_m=0.0, quality=quality, seal_m=0.0, room=1.0,
                 sigma_xy_m=0.0, sigma_z_m=0.0, sigma_tilt_rad=0.0)


def offered(candidate: Grasp, *attempts: Attempt) -> float | None:
    """The candidate's quality in the light of these attempts; None when it is blocked."""
    kept, blocked = laws.weighed([candidate], Memory(attempts=attempts))
    assert len(kept) + blocked == 1
    return kept[0].quality if kept else None


@pytest.mark.parametrize("outcome", [MISSED, DROPPED, COLLISION, DOUBLE, UNREACHABLE])
def test_a_pose_that_was_told_to_fail_is_not_offered_again(outcome: int) -> None:
    assert offered(grasp(0.006, 0.006), attempt(outcome=outcome)) is None
    assert offered(grasp(tilt=np.radians(14)), attempt(outcome=outcome)) is None


@pytest.mark.parametrize("outcome", [0, OK, SKIPPED])
def test_what_did_not_fail_costs_nothing(outcome: int) -> None:
    assert offered(grasp(), *(attempt(n, outcome=outcome) for n in (1, 2, 3))) == 0.8


def test_unreachable_poses_cost_their_neighbours_nothing() -> None:
    assert offered(grasp(0.015), *(attempt(n, outcome=UNREACHABLE) for n in (1, 2, 3))) == 0.8
    assert offered(grasp(tilt=np.radians(20)), *(attempt(n, outcome=UNREACHABLE) for n in (1, 2, 3))) == 0.8


def test_one_failure_puts_the_rest_of_the_part_back_and_two_block_it() -> None:
    assert offered(grasp(0.02), attempt()) == 0.16
    assert offered(grasp(0.02), attempt(), attempt(2, 0.012)) is None
    assert offered(grasp(0.03), attempt(), attempt(2, 0.0)) == 0.8                                  # beyond the part
    assert offered(grasp(0.02), attempt(), attempt(2, 0.012, cycle_id=2, outcome=SKIPPED)) == 0.16


def test_another_tool_and_another_way_are_still_tried() -> None:
    failures = attempt(), attempt(2, 0.012)
    assert offered(grasp(0.02, tool=2), *failures) == 0.8
    assert offered(grasp(tilt=np.radians(40)), *failures) == 0.032


def test_what_was_only_seen_to_fail_puts_back_once_and_blocks_twice() -> None:
    assert offered(grasp(), attempt(seen=True)) == 0.16
    assert offered(grasp(), attempt(seen=True), attempt(2, cycle_id=2, seen=True)) is None


def test_those_put_back_come_after_the_others_and_the_rest_keeps_its_order() -> None:
    candidates = [grasp(0.0, quality=0.9), grasp(0.05, quality=0.7), grasp(-0.05, quality=0.7), grasp(0.02, quality=0.6)]
    kept, blocked = laws.weighed(candidates, Memory(attempts=(attempt(),)))
    assert blocked == 1
    assert [k.T_bin_tcp[0, 3] for k in kept] == [0.05, -0.05, 0.02]
    assert laws.weighed(candidates, Memory()) == (candidates, 0)


def lower(rows: slice, cols: slice) -> Callable[[np.ndarray], None]:
    def change(grid: np.ndarray) -> None:
        grid[rows, cols] -= 0.015
    return change


def test_a_failure_stands_while_nothing_changes_there() -> None:
    remembered = Memory(attempts=(attempt(1, 0.0), attempt(2, 0.06)))
    assert laws.standing(remembered, bin_map(), LATER) == remembered
    elsewhere = bin_map(lower(slice(0, 20), slice(0, 100)))
    assert laws.standing(remembered, elsewhere, LATER) == remembered
    touched = bin_map(lower(slice(34, 46), slice(42, 54)))           # 24 x 24 mm at the first
    assert laws.standing(remembered, touched, LATER).attempts == remembered.attempts[1:]
    assert laws.standing(remembered, bin_map(lambda grid: np.copyto(grid, 0.1)), LATER).attempts == ()


@examples(max_examples=50, deadline=None, derandomize=True)
@given(depth_mm=st.floats(-60, 60).filter(lambda d: abs(d) > 4), at=st.tuples(st.integers(30, 50), st.integers(40, 60)))
def test_any_change_of_a_third_of_the_patch_forgets(depth_mm: float, at: tuple[int, int]) -> None:
    def change(grid: np.ndarray) -> None:
        i, j = (min(max(first, 32), 38) for first in at)
        grid[i:i + 12, j + 10:j + 22] += depth_mm / 1000
    spot = attempt(1, 0.0, 0.0)
    i, j = min(max(at[0], 32), 38), min(max(at[1], 32), 38) + 10
    covered = len(set(range(i, i + 12)) & set(range(30, 50))) * len(set(range(j, j + 12)) & set(range(40, 60)))
    gone = not laws.standing(Memory(attempts=(spot,)), bin_map(change), LATER).attempts
    assert gone == (covered > 0.3 * 400) or 0.15 * 400 < covered <= 0.3 * 400


def test_old_failures_are_forgotten_and_a_clock_set_back_is_no_age() -> None:
    remembered = Memory(attempts=(attempt(),))
    assert laws.standing(remembered, bin_map(), "2026-01-01T00:59:59Z") == remembered
    assert not laws.standing(remembered, bin_map(), "2026-01-01T01:00:01Z").attempts
    assert laws.standing(remembered, bin_map(), "2025-12-31T10:00:00Z") == remembered


def test_a_spot_at_the_wall_and_one_outside_have_patches_too() -> None:
    remembered = Memory(attempts=(attempt(1, 0.099, 0.079), attempt(2, -0.1, -0.08), attempt(3, 0.3, 0.3)))
    assert laws.standing(remembered, bin_map(), LATER) == remembered


def test_what_cannot_be_seen_is_not_known_to_have_changed() -> None:
    covered = bin_map(lambda grid: grid.__setitem__(slice(None), np.nan))
    remembered = Memory(attempts=(attempt(),))
    assert laws.standing(remembered, covered, LATER) == remembered


REPORTS = st.lists(st.tuples(st.integers(1, 3), st.integers(1, 3), st.integers(1, 7)), max_size=9,
                   unique_by=lambda report: report[:2])


def spoken(reports: list[tuple[int, int, int]], start: Memory = Memory()) -> Memory:  # noqa: B008 - frozen
    for cycle_id, number, outcome in reports:
        start = laws.told(start, attempt(number, cycle_id=cycle_id, outcome=0), outcome)
    return start


@examples(max_examples=50, deadline=None, derandomize=True)
@given(reports=REPORTS, seed=st.integers(0, 1000))
def test_the_order_of_reports_does_not_matter_and_saying_it_twice_changes_nothing(
        reports: list[tuple[int, int, int]], seed: int) -> None:
    shuffled = reports * 2
    random.Random(seed).shuffle(shuffled)
    assert spoken(shuffled) == spoken(reports)
    assert {a.name[1:]: a.outcome for a in spoken(reports).attempts} == {(c, g): outcome for c, g, outcome in reports}


@examples(max_examples=50, deadline=None, derandomize=True)
@given(reports=REPORTS, later=st.integers(1, 7))
def test_a_later_word_replaces_the_earlier_one(reports: list[tuple[int, int, int]], later: int) -> None:
    for cycle_id, number, _ in reports:
        corrected = [report for report in reports if report[:2] != (cycle_id, number)] + [(cycle_id, number, later)]
        assert spoken([(cycle_id, number, later)], spoken(reports)) == spoken(corrected)


@examples(max_examples=50, deadline=None, derandomize=True)
@given(early=REPORTS, meanwhile=REPORTS)
def test_what_is_told_while_a_cycle_runs_is_not_lost(early: list[tuple[int, int, int]],
                                                     meanwhile: list[tuple[int, int, int]]) -> None:
    before = spoken(early)
    forgets = before.model_copy(update={"attempts": before.attempts[::2]})
    now = spoken(meanwhile, before)
    joined = laws.merged(before, forgets, now)
    changed = [a for a in now.attempts if a not in before.attempts]
    assert set(changed) <= set(joined.attempts)
    assert set(joined.attempts) <= set(forgets.attempts) | set(changed)
    assert laws.merged(before, forgets, before) == forgets


def test_the_controllers_word_drops_what_was_seen_of_its_cycle() -> None:
    seen = attempt(1, seen=True)
    start = Memory(attempts=(seen, attempt(1, 0.05, cycle_id=2, seen=True)))
    after = laws.told(start, attempt(2, 0.03), OK)
    assert [(a.cycle_id, a.grasp, a.source) for a in after.attempts] == [(1, 2, "told"), (2, 1, "seen")]


def test_only_so_many_are_kept_and_the_oldest_go_first() -> None:
    small = attempt()
    kept = Memory(attempts=tuple(small.model_copy(update={"cycle_id": n}) for n in range(1, laws.KEPT + 1)))
    more = laws.told(kept, small.model_copy(update={"cycle_id": laws.KEPT + 1}), MISSED)
    assert (len(more.attempts), more.attempts[0].cycle_id) == (laws.KEPT, 2)


def test_a_memory_reads_back_as_it_was_written() -> None:
    grid = Grid.of(laws.tenths(bin_map()))
    memory = Memory(attempts=(attempt(), attempt(2, seen=True)), look=Look(heights=grid, parts=grid, attempts=(attempt(3),)))
    assert Memory.model_validate_json(memory.model_dump_json()) == memory
    assert np.array_equal(grid.cells, laws.tenths(bin_map()))


@pytest.mark.parametrize("change", [{"packed": "AAAA"}, {"packed": "no base64!"}, {"rows": 79}, {"cols": -1}])
def test_a_damaged_grid_is_refused(change: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        Grid.model_validate(Grid.of(laws.tenths(bin_map())).model_dump() | change)


def test_an_instant_that_is_none_is_refused() -> None:
    for instant in ("yesterday", "2026-01-01T00:00:00"):
        with pytest.raises(ValidationError):
            Attempt.model_validate(attempt().model_dump() | {"captured_at": instant})


LAID = (("block", geometry.translation(0.0, 0.0, 0.0075)), ("block", geometry.translation(0.08, 0.03, 0.0075)))


@pytest.fixture(scope="module")
def inputs(photograph: Callable[..., CycleInput]) -> CycleInput:
    return photograph(LAID)


@pytest.fixture(scope="module")
def first(inputs: CycleInput) -> CycleResult:
    return pipeline.run(inputs)


def spots(cycle: CycleResult) -> np.ndarray:
    return np.array([g.position_m for g in cycle.result.grasps])


def test_a_first_cycle_remembers_what_it_published(first: CycleResult) -> None:
    assert first.result.return_code.code is Code.OK
    assert first.memory is not None
    assert first.memory.look is not None
    assert first.memory.attempts == ()
    assert np.allclose([a.position_m for a in first.memory.look.attempts], spots(first), atol=1e-6)
    assert {a.outcome for a in first.memory.look.attempts} == {0}
    assert all(0.015 < a.reach_m < 0.03 for a in first.memory.look.attempts)         # a block of 60 x 40 mm
    assert first.result.funnel is not None
    assert first.result.funnel.counts["history"] == 0


def test_a_miss_is_not_offered_again_and_the_other_part_comes_first(inputs: CycleInput, first: CycleResult) -> None:
    missed = spots(first)[0]
    second = pipeline.run(replace(inputs, cycle_id=2, memory=laws.after(Memory(), first, {1: MISSED})))
    assert second.result.return_code.code is Code.OK
    assert np.linalg.norm(spots(second) - missed, axis=1).min() > laws.SAME_SPOT_M
    assert np.linalg.norm(spots(second)[0] - missed) > 0.06
    assert second.result.funnel is not None
    assert second.result.funnel.counts["history"] > 0


def test_when_all_has_failed_the_code_is_104_until_the_bin_is_stirred(
        inputs: CycleInput, first: CycleResult, photograph: Callable[..., CycleInput]) -> None:
    remembered, cycle = Memory(), first
    for cycle_id in range(2, 12):
        remembered = laws.after(remembered, cycle, dict.fromkeys(range(1, len(cycle.result.grasps) + 1), MISSED))
        cycle = pipeline.run(replace(inputs, cycle_id=cycle_id, memory=remembered))
        if not cycle.result.grasps:
            break
    assert cycle.result.return_code.code is Code.ALL_BLOCKED_BY_HISTORY
    assert "stir the bin" in cycle.result.return_code.message
    assert cycle.result.funnel is not None
    assert cycle.result.funnel.dominating == "history"
    assert cycle.memory is not None
    assert cycle.memory.attempts == remembered.attempts
    stirred = photograph(((LAID[0][0], LAID[0][1] @ geometry.translation(0.012, 0.008, 0.0)), LAID[1]))
    again = pipeline.run(replace(stirred, cycle_id=20, memory=remembered))
    assert again.result.return_code.code is Code.OK
    assert np.linalg.norm(spots(again)[:, :2] - [0.012, 0.008], axis=1).max() < 0.03


def test_skipped_grasps_change_nothing_and_the_answer_is_the_same_byte_for_byte(inputs: CycleInput, first: CycleResult) -> None:
    remembered = laws.after(Memory(), first, {1: SKIPPED})
    again = pipeline.run(replace(inputs, memory=remembered))
    assert again.result.timeless_bytes() == first.result.timeless_bytes()
    told = laws.after(Memory(), first, {1: MISSED})
    read_back = Memory.model_validate_json(told.model_dump_json())
    one, other = (pipeline.run(replace(inputs, cycle_id=2, memory=m)) for m in (told, read_back))
    assert one.result.timeless_bytes() == other.result.timeless_bytes()
    assert one.memory == other.memory


def test_pick_starts_from_what_a_recording_remembers_unless_told_to_start_fresh(
        inputs: CycleInput, first: CycleResult, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    missed = replace(inputs, cycle_id=2, memory=laws.after(Memory(), first, {1: MISSED}))
    recording.save(tmp_path / "two", missed, pipeline.run(missed).result)
    # pick asks a cell file for the job
    cell = settings.Cell(bins=(inputs.job.bin,), tools=inputs.job.tools, recipes=(inputs.job.recipe,))
    (tmp_path / "cell.yaml").write_text(yaml.safe_dump(cell.model_dump(mode="json", exclude_unset=True)), encoding="utf-8")
    pick = importlib.import_module("binpick.cli.pick")
    found = {}
    for fresh in (False, True):
        pick.pick(left=tmp_path / "two/left.png", right=tmp_path / "two/right.png", rig=tmp_path / "two/rig.json",
                  cell=tmp_path / "cell.yaml", out=tmp_path / "out", fresh=fresh)
        found[fresh] = Result.model_validate_json((tmp_path / "out/result.json").read_bytes())
    assert "nothing is remembered" in capsys.readouterr().err
    stored = recording.load(tmp_path / "two")[1]
    assert found[False].grasps == stored.grasps
    assert [g.position_m for g in found[True].grasps] == [g.position_m for g in first.result.grasps]
