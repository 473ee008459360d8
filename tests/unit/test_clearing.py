"""Bins emptied: what the figures count, what a rerun finds again, and what two fingers could have taken."""

import io
import json
import math

import numpy as np
import pytest
from rich.console import Console

from binpick import geometry
from binpick.data import Light
from binpick.lab import clearing, harvest
from binpick.lab.archive import Archive
from binpick.lab.clearing import TASKS, Clearing, Cycle, Left, Taken
from binpick.settings import SuctionTool, TwoFingerTool
from binpick.sim import exam as frozen
from binpick.sim import oracle
from binpick.sim.world import ScenePart, WorldScene

FINGERS = TwoFingerTool(kind="two_finger")
PICKED = Cycle(0, 1000.0, Taken("suction", "block", "", 0.0, lifted=True))
DROPPED = Cycle(0, 1000.0, Taken("suction", "bracket", "", 0.0))
MISSED = Cycle(0, 1000.0, Taken("suction", "block", "the cup is not on one part", 0.0))
HIT = Cycle(0, 1000.0, Taken("suction", "block", "the tool collides", 0.0021))


def emptied(*cycles, left=(), code=102, task=TASKS[0]):
    return Clearing(task.kinds, task.tools, 1, 3, (*cycles, Cycle(code, 500.0, None)), left)


def test_what_left_and_what_could_have_left_are_counted():
    row = harvest.row([emptied(PICKED, MISSED, PICKED, left=(Left("bolt", True, 90), Left("tee", False, 5)), code=103)])
    assert (row["removed"]["good"], row["removed"]["of"]) == (2, 3)
    assert (row["held"]["good"], row["held"]["of"]) == (2, 3)
    assert row["stayed"] == {"bolt": 1}
    assert row["misses"] == {"the cup is not on one part": 1}
    assert (row["cycles"], row["codes"]) == (4, {"103": 1})
    assert row["parts_per_hour"] == round(2 / 3.5 * 3600)


def test_grasps_that_hold_are_lifted_or_not():
    row = harvest.row([emptied(PICKED, DROPPED, MISSED, HIT)])
    assert (row["lifted"]["good"], row["lifted"]["of"]) == (1, 2)


def test_a_collision_counts_and_a_part_that_an_empty_bin_shows_too():
    row = harvest.row([emptied(HIT), emptied(PICKED, left=(Left("bolt", False, 1),)), emptied(left=(Left("bolt", True, 0),))])
    assert (row["collisions"], row["penetration_max_mm"]) == (1, 2.1)
    assert row["empty_with_part_in_view"] == 1, "of a part that nobody sees nothing can be known"


def test_tasks_are_told_apart_and_shown():
    rows = json.loads(json.dumps(harvest.figures([emptied(PICKED), emptied(PICKED, HIT, task=TASKS[4])])))
    assert rows["suction: block"]["bins"] == rows["suction + two_finger: mixed"]["bins"] == 1
    assert (rows["all"]["bins"], rows["all"]["removed"]["good"]) == (2, 2)
    console = Console(width=250, record=True, file=io.StringIO())
    console.print(harvest.table(rows))
    says = console.export_text()
    assert "suction + two_finger: mixed" in says
    assert "1 (2.1 mm)" in says
    assert "tee" not in says


def test_a_finished_sheet_is_not_made_again(tmp_path):
    made = []

    def make():
        made.append(1)
        missed = Cycle(0, 10.0, Taken("suction", "", "there is no part", math.pi))
        return emptied(PICKED, missed, left=(Left("bolt", True, 90),))

    first = Archive(tmp_path).sheet(Clearing, {"seed": 1}, make)
    assert Archive(tmp_path).sheet(Clearing, {"seed": 1}, make) == first == make()
    assert len(made) == 2, "once for the archive, once for this comparison"
    Archive(tmp_path).sheet(Clearing, {"seed": 2}, make)
    assert len(made) == 3
    Archive().sheet(Clearing, {"seed": 1}, make)
    assert len(made) == 4, "without a folder nothing is kept"
    (unfinished,) = list((tmp_path / "sheets").glob("*.json"))[:1]
    unfinished.replace(unfinished.with_suffix(".part"))
    Archive(tmp_path).sheet(Clearing, {"seed": 1}, make)
    Archive(tmp_path).sheet(Clearing, {"seed": 2}, make)
    assert len(made) == 5, "what was not finished is made anew"


def test_a_kept_picture_is_the_same_to_the_bit(tmp_path):
    scene = WorldScene("B", (ScenePart(1, "block", geometry.translation(0.0, 0.0, 0.0075)),), 1, 1)
    light = Light(6000.0, 0.0, True)
    image = np.random.default_rng(1).integers(0, 255, (40, 60), dtype=np.uint8)
    keep, rig = Archive(tmp_path), frozen.rig("B")
    first = keep.picture(rig, scene, 0, light, 1, lambda: image)
    again = keep.picture(rig, scene, 0, light, 1, lambda: np.zeros_like(image))
    np.testing.assert_array_equal(first, image)
    np.testing.assert_array_equal(again, image)
    other = keep.picture(rig, scene, 0, light, 2, lambda: np.zeros_like(image))
    assert not other.any(), "another shot is another picture"


LYING = geometry.frame_of_axes(np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 0.012]))


def test_two_fingers_could_take_a_bar_in_the_open_but_not_one_between_blocks():
    walls = tuple(ScenePart(i, "block", geometry.make(np.eye(3), np.array([0.0, y, 0.0075 + 0.015 * level])))
                  for i, (y, level) in enumerate([(y, level) for y in (-0.0325, 0.0325) for level in (0, 1)], start=2))
    narrow = FINGERS.model_copy(update={"fingers": FINGERS.fingers.model_copy(update={"stroke_max_m": 0.050})})
    bar = ScenePart(1, "cylinder", LYING)
    assert 1 in oracle.pickable(WorldScene("A", (bar,), 1, 1), [narrow])
    assert 1 not in oracle.pickable(WorldScene("A", (bar, *walls), 1, 1), [narrow])


def test_either_tool_will_do():
    flat = WorldScene("A", (ScenePart(1, "block", geometry.translation(0.0, 0.0, 0.0075)),), 1, 1)
    thin = FINGERS.model_copy(update={"fingers": FINGERS.fingers.model_copy(update={"stroke_max_m": 0.010})})
    assert oracle.pickable(flat, [thin]) == frozenset()
    assert oracle.pickable(flat, [thin, SuctionTool()]) == {1}


@pytest.mark.slow
def test_a_few_parts_are_taken_one_after_the_other_and_a_rerun_remembers(tmp_path):
    keep = Archive(tmp_path)
    first = next(clearing.sit("B", [1], 4, keep))
    assert first.removed == 4
    assert first.cycles[-1].code == 102
    assert not first.left
    assert not any(cycle.taken.collides for cycle in first.cycles if cycle.taken)
    pictures = len(list((tmp_path / "pictures").iterdir()))
    assert pictures == 2 * len(first.cycles)
    assert next(clearing.sit("B", [1], 4, keep)) == first
    again = clearing.clear(TASKS[0], "B", 1, 4, keep)
    assert [cycle.taken for cycle in again.cycles] == [cycle.taken for cycle in first.cycles]
    assert len(list((tmp_path / "pictures").iterdir())) == pictures
