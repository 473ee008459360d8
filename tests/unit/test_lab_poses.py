"""Poses against the truth: what counts as off, what counts as found, and the command that prints it."""

import io
import json
import sys

import numpy as np
import pytest
from rich.console import Console

from binpick import cli, geometry
from binpick.grasp import shape
from binpick.lab import poses
from binpick.lab.poses import Given, Sheet
from binpick.result import PartMessage, PoseMessage
from binpick.settings.mesh import Mesh


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    return shape.load(Mesh(file=poses.written(tmp_path_factory.mktemp("meshes"), "block"), unit="mm"))


def given(part_id=1, adds_m=0.0005, mssd_m=0.001):
    return Given(part_id, 0.9, adds_m, mssd_m)


def test_a_slide_along_a_face_is_less_off_than_a_lift(block):
    slid, lifted = (geometry.translation(*by) for by in ((0.004, 0.0, 0.0), (0.0, 0.0, 0.004)))
    assert poses.adds_m(np.eye(4), np.eye(4), block) < 1e-4
    assert 0.0002 < poses.adds_m(slid, np.eye(4), block) < 0.001
    assert poses.adds_m(lifted, np.eye(4), block) > 0.002
    assert poses.mssd_m(slid, np.eye(4), block) == pytest.approx(0.004, abs=2e-4)
    assert poses.mssd_m(lifted, np.eye(4), block) == pytest.approx(0.004, abs=2e-4)


def test_half_a_turn_of_a_block_is_no_error(block):
    turned = geometry.make(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    assert poses.mssd_m(turned, np.eye(4), block) < 2e-4
    assert poses.mssd_m(geometry.make(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.zeros(3)), np.eye(4), block) > 0.01


def test_a_pose_is_held_against_the_nearest_part_of_its_kind(block):
    pose = PoseMessage(position_m=(0.1, 0.0, 0.001), quaternion_xyzw=(0.0, 0.0, 0.0, 1.0))
    part = PartMessage(id=4, part_ids=(4,), label="block", frame="bin", score=0.8, T_frame_part=pose)
    true = {7: geometry.translation(0.1, 0.0, 0.0), 8: geometry.translation(-0.1, 0.0, 0.0)}
    found = poses.judged(part, true, block)
    assert (found.part_id, found.score) == (7, 0.8)
    assert found.adds_m < 0.001
    assert poses.judged(part, {}, block).adds_m == float("inf"), "there is none of its kind"


def test_found_are_parts_with_a_good_pose_by_what_is_seen_of_them():
    sheet = Sheet("block", "block", 1, (given(1), given(1), given(2, 0.0025), given(0, float("inf"), float("inf"))),
                  {1: 1.0, 2: 0.9, 3: 0.75, 4: 0.6, 5: 0.1}, 90.0)
    row = poses.row([sheet, Sheet("block", "block", 2, (given(3, mssd_m=0.005),), {3: 0.8}, 110.0)])
    assert row["poses"] == 5
    assert [row["within_mm"][mm]["good"] for mm in ("1", "2", "3")] == [3, 3, 4]
    assert row["every_point_within_4_mm"]["good"] == 3
    assert {name: (share["good"], share["of"]) for name, share in row["recall"].items()} == {
        "0.85": (1, 2), "0.70": (1, 2), "0.50": (0, 1), "plain": (2, 4)}
    assert row["first_ms"] == 100.0


def test_the_table_pools_bins_and_knows_what_is_missing():
    run = json.loads(json.dumps(poses.figures("A", 25, [
        Sheet("block", "block", 1, (given(),), {1: 1.0}, 90.0), Sheet("mixed", "tee", 1, (), {}, 110.0)])))
    assert list(run["bins"]) == ["block", "mixed", "all"]
    console = Console(width=220, record=True, file=io.StringIO())
    console.print(poses.table(run))
    says = console.export_text()
    assert "1/1 (100%)" in says
    assert "-" in says


def test_a_bin_without_a_pose_has_no_time_until_the_first():
    run = json.loads(json.dumps(poses.figures("A", 25, [
        Sheet("block", "block", 1, (given(),), {1: 1.0}, 90.0), Sheet("mixed", "tee", 1, (), {}, float("nan"))])))
    assert [run["bins"][name]["first_ms"] for name in ("block", "mixed", "all")] == [90.0, None, 90.0]
    console = Console(width=220, record=True, file=io.StringIO())
    console.print(poses.table(run))
    assert [line.split()[-2] for line in console.export_text().splitlines() if " mixed " in line] == ["-"]


@pytest.mark.slow
def test_the_command_prints_its_figures(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["binpick", "bench", "pose", "--tuning", "--world", "B", "--scenes", "1", "--parts", "3",
                                      "--json"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert not ended.value.code
    run = json.loads(capsys.readouterr().out)
    assert (run["world"], run["parts"], run["seeds"]) == ("B", 3, [1])
    assert run["bins"]["all"]["poses"] > 0
