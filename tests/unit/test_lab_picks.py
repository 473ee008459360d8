"""Grasps over kinds of parts: shares with their intervals, pooled by hand; a bin of two tools is rendered once."""

import io
import json
import math
import sys
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from binpick import cli, geometry
from binpick.lab import exam, picks, tally
from binpick.lab.exam import Paper
from binpick.lab.parts import PartScore
from binpick.lab.picks import Grip, Pick, Sheet, Tried
from binpick.sim.world import ScenePart, WorldScene

TIMES = {"rectify": 10.0, "match": 100.0, "bin": 5.0, "segment": 20.0, "grasp": 30.0, "clearance": 40.0, "compute": 205.0}


# Newcombe 1998, table I, method 3
@pytest.mark.parametrize(("good", "of", "low", "high"), [
    (81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718),
])
def test_a_share_has_wilsons_interval(good, of, low, high):
    assert exam.wilson(good, of) == (pytest.approx(low, abs=5e-5), pytest.approx(high, abs=5e-5))
    assert exam.wilson(of - good, of) == (pytest.approx(1 - high, abs=5e-5), pytest.approx(1 - low, abs=5e-5))


def test_nothing_is_known_of_nothing():
    assert exam.wilson(0, 0) == (0.0, 1.0)


def grip(ok=True, penetration_m=0.0, off_m=0.0):
    return Grip(ok, penetration_m, off_m, 0.0002)


def pick(*grips, tool="suction", code=0, timing_ms=TIMES):
    return Pick(tool, code, grips, timing_ms)


def part(iou, visibility=1.0):
    return PartScore(1, "block", visibility, iou, 1.0)


def test_a_scene_without_a_grasp_is_a_first_grasp_that_is_not_good():
    row = tally.row("suction", [pick(grip(), grip(ok=False, penetration_m=0.0021)), pick(grip(ok=False)), pick(code=103)])
    assert row["p_at_1"] == {"good": 1, "of": 3, "share": 0.333, "interval": [0.061, 0.792]}
    assert (row["p_at_5"]["good"], row["p_at_5"]["of"]) == (1, 3)
    assert (row["with_grasp"]["good"], row["with_grasp"]["of"]) == (2, 3)
    assert (row["collisions"], row["penetration_max_mm"]) == (1, 2.1)
    assert row["codes"] == {"0": 2, "103": 1}


def test_only_the_first_five_count():
    row = tally.row("suction", [pick(*[grip()] * 5, *[grip(ok=False, penetration_m=0.002)] * 3)])
    assert (row["p_at_5"]["good"], row["p_at_5"]["of"]) == (5, 5)
    assert row["collisions"] == 3, "every pose that is published must be free"


def test_sigma_and_width_are_asked_of_grasps_that_hold():
    some = [pick(grip(off_m=0.0001), grip(off_m=-0.0003), grip(off_m=0.0009), grip(ok=False, off_m=float("nan")))]
    suction, fingers = tally.row("suction", some), tally.row("two_finger", some)
    assert [suction["sigma_z"][key]["good"] for key in ("within_1", "within_2")] == [1, 2]
    assert suction["sigma_z"]["within_1"]["of"] == 3
    assert suction["sigma_z"]["median_mm"] == 0.2
    assert fingers["sigma_z"] is None, "fingertips hang below the surface that it speaks of"
    assert suction["off_mm"] == fingers["off_mm"] == {"median": 0.1, "worst": 0.9}


def test_times_are_of_cycles_that_came_to_the_end():
    slow = TIMES | {"grasp": 50.0, "clearance": 60.0, "compute": 245.0}
    cut_short = {"rectify": 10.0, "match": 100.0, "bin": 5.0, "compute": 115.0}
    row = tally.row("suction", [pick(timing_ms=TIMES), pick(timing_ms=slow), pick(timing_ms=cut_short)])
    assert row["stages_ms"] == {"bin": 5.0, "segment": 20.0, "grasp": 40.0, "clearance": 50.0, "sum": 115.0, "cycle": 225.0}


def sheets():
    """A bin of every kind: blocks are picked, brackets are not, mixed serve both tools."""
    both = (pick(grip(), grip()), pick(grip(ok=False), tool="two_finger"))
    picked = {"block": (pick(grip()),), "mixed": both, "bracket": (pick(code=103),)}
    return [Sheet(mix, 1, (part(0.9), part(0.4), part(0.1, 0.5)), picked.get(mix, (pick(grip(), tool="two_finger"),)))
            for mix in picks.MIXES]


def test_kinds_are_pooled_per_tool_and_mixed_parts_counted_once():
    run = json.loads(json.dumps(tally.figures("A", 25, sheets())))
    assert {tool: list(rows) for tool, rows in run["tools"].items()} == {
        "suction": ["block", "mixed", "bracket", "all"], "two_finger": ["cylinder", "tee", "mixed", "all"]}
    suction, fingers = (run["tools"][tool]["all"] for tool in ("suction", "two_finger"))
    assert [(share["good"], share["of"]) for share in (suction["p_at_1"], suction["p_at_5"])] == [(2, 3), (3, 3)]
    assert [(share["good"], share["of"]) for share in (fingers["p_at_1"], fingers["p_at_5"])] == [(2, 3), (2, 3)]
    assert list(run["segments"]) == ["block", "mixed", "bracket", "cylinder", "tee", "all"]
    assert (run["segments"]["all"]["good"], run["segments"]["all"]["of"]) == (5, 10)


def test_segmenters_stand_beside_each_other():
    by_other = Tried("open3d", (part(0.4), part(0.9)), (pick(grip(ok=False), timing_ms=TIMES | {"segment": 60.0}),))
    run = tally.figures("A", 25, [replace(sheet, others=(by_other,)) for sheet in sheets()])
    grid, other = run["methods"]["grid"], run["methods"]["open3d"]
    assert grid["segments"] == run["segments"]["all"]
    assert grid["p_at_1"] == {tool: rows["all"]["p_at_1"] for tool, rows in run["tools"].items()}
    assert (other["segments"]["good"], other["segments"]["of"]) == (5, 10)
    assert (other["p_at_1"]["suction"]["good"], other["p_at_1"]["suction"]["of"]) == (0, 5)
    assert (grid["segment_ms"], other["segment_ms"]) == (20.0, 60.0)


def test_the_table_says_the_same_and_knows_what_is_missing():
    empty = [Sheet(mix, 1, (), (pick(tool=tool, code=105, timing_ms={"compute": 115.0}),))
             for tool, mixes in picks.KINDS.items() for mix in mixes]
    console = Console(width=150, record=True, file=io.StringIO())
    console.print(tally.tables(tally.figures("A", 25, sheets())))
    says = console.export_text()
    assert "2/3 (0.21-0.94)" in says
    assert "5/10" in says
    assert "0: 2 103: 1" in says
    console.print(tally.tables(tally.figures("A", 25, empty)))
    assert "105: 3" in console.export_text()


@pytest.fixture(scope="module")
def two_parts(photograph):
    lying = geometry.frame_of_axes(np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), np.array([-0.06, 0.02, 0.012]))
    parts = (("block", geometry.translation(0.06, 0.0, 0.0075)), ("cylinder", lying))
    scene = WorldScene("B", tuple(ScenePart(i, kind, T) for i, (kind, T) in enumerate(parts, start=1)), 1, 1)
    return Paper(photograph(parts), scene)


def test_one_rendering_serves_both_tools(two_parts):
    sheet = picks.sheet(two_parts, "mixed")
    assert [each.tool for each in sheet.picks] == ["suction", "two_finger"]
    assert tally.recall(sheet.parts)["good"] == 2
    for each in sheet.picks:
        assert each.code == 0
        assert each.grips[0].ok
        assert set(tally.STAGES) < set(each.timing_ms)
    assert all(math.isfinite(grip.off_m) for grip in sheet.picks[0].grips if grip.ok)
    assert sheet.picks[0].grips != sheet.picks[1].grips
    (other,) = sheet.others
    assert [each.code for each in other.picks] == [0, 0]
    assert tally.recall(other.parts)["of"] == 2


def test_another_tool_sees_the_same_frames(two_parts):
    other = exam.for_tool(two_parts, "two_finger")
    assert (two_parts.inputs.job.tool.kind, other.inputs.job.tool.kind) == ("suction", "two_finger")
    assert other.inputs.pair is two_parts.inputs.pair
    assert other.scene is two_parts.scene
    assert other.inputs.job.recipe == two_parts.inputs.job.recipe


@pytest.mark.slow
def test_the_command_prints_its_figures(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(sys, "argv", ["binpick", "bench", "grasp", "--tuning", "--world", "B", "--scenes", "1", "--parts", "3",
                                      "--folder", str(tmp_path), "--json"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert not ended.value.code
    run, = json.loads(capsys.readouterr().out)["series"]
    assert (run["world"], run["parts"], run["seeds"]) == ("B", 3, [1])
    assert run["tools"]["suction"]["all"]["scenes"] == run["tools"]["two_finger"]["all"]["scenes"] == 3
    assert run["segments"]["all"]["of"] > 0
