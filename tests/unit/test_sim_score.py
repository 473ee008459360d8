"""The judge accepts what would hold and says what is wrong with the rest."""

import numpy as np
import pytest

from binpick import geometry
from binpick.settings import SuctionTool
from binpick.sim import score
from binpick.sim.world import ScenePart, WorldScene

TOP = 0.015
TOOL = SuctionTool()
BLOCK = WorldScene("A", (ScenePart(3, "block", geometry.translation(0.1, 0.05, 0.0075)),), 1, 1)


def grasp(x=0.1, y=0.05, z=TOP, tilt_deg=0.0):
    tilt = np.radians(tilt_deg)
    return geometry.frame_of_axes(np.array([np.sin(tilt), 0.0, -np.cos(tilt)]), np.array([1.0, 0, 0]), np.array([x, y, z]))


def test_a_grasp_on_top_of_a_block_holds():
    verdict = score.judge(BLOCK, grasp(), TOOL)
    assert verdict.ok
    assert verdict.reason == ""
    assert (verdict.part_id, verdict.kind) == (3, "block")
    assert verdict.distance_m == pytest.approx(0, abs=1e-6)
    assert verdict.angle_rad == pytest.approx(0, abs=1e-3)
    assert verdict.ring_rms_m < 1e-6
    assert verdict.penetration_m == 0


def test_a_little_high_and_a_little_tilted_is_measured_and_accepted():
    verdict = score.judge(BLOCK, grasp(z=TOP + 0.002, tilt_deg=5), TOOL)
    assert verdict.ok
    assert verdict.distance_m == pytest.approx(0.002 / np.cos(np.radians(5)), abs=1e-6)
    assert np.degrees(verdict.angle_rad) == pytest.approx(5, abs=0.05)


@pytest.mark.parametrize(("pose", "reason", "part_id"), [
    (grasp(tilt_deg=20), "tilted", 3),
    (grasp(x=0.2), "no part", 0),
    (grasp(x=0.126), "not on one part", 3),
    (grasp(z=TOP + 0.010), "too far", 3),
    (grasp(z=TOP - 0.006), "too far", 3),
])
def test_what_is_wrong_is_said(pose, reason, part_id):
    verdict = score.judge(BLOCK, pose, TOOL)
    assert not verdict.ok
    assert reason in verdict.reason
    assert verdict.part_id == part_id


def test_a_tool_in_the_wall_collides():
    by_the_wall = WorldScene("A", (ScenePart(1, "block", geometry.translation(0.27, 0.0, 0.0075)),), 1, 1)
    verdict = score.judge(by_the_wall, grasp(x=0.291, y=0.0), TOOL)
    assert not verdict.ok
    assert verdict.reason == "the tool collides"
    assert verdict.penetration_m == pytest.approx(0.003, abs=3e-4)


def test_an_upright_neighbour_is_in_the_way_of_the_tool_but_not_of_the_cup():
    upright = geometry.frame_of_axes(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]), np.array([0.1, 0.067, 0.045]))
    verdict = score.judge(WorldScene("A", (*BLOCK.parts, ScenePart(4, "block", upright)), 1, 1), grasp(), TOOL)
    assert verdict.reason == "the tool collides"


def test_a_thick_cylinder_holds_within_the_cups_compliance_and_a_bolt_does_not():
    lying = geometry.frame_of_axes(np.array([1.0, 0.0, 0.0]), np.array([0.0, 0, 1.0]), np.array([0.0, 0.0, 0.012]))
    scene = WorldScene("A", (ScenePart(1, "cylinder", lying),), 1, 1)
    assert score.judge(scene, grasp(0, 0, 0.024), TOOL).ok
    bolt = WorldScene("A", (ScenePart(1, "bolt", geometry.translation(0.0, 0.0, -0.006) @ lying),), 1, 1)
    assert not score.judge(bolt, grasp(0, 0, 0.012), TOOL).ok


def test_pickable_leaves_out_what_no_cup_can_hold():
    thin_edge_up = geometry.frame_of_axes(np.array([0.0, 1.0, 0.0]), np.array([1.0, 0, 0]), np.array([-0.1, 0.0, 0.020]))
    lying = geometry.frame_of_axes(np.array([1.0, 0.0, 0.0]), np.array([0.0, 0, 1.0]), np.array([0.0, -0.1, 0.006]))
    in_the_corner = geometry.translation(-0.27, -0.18, 0.0075)
    scene = WorldScene("A", (*BLOCK.parts, ScenePart(1, "bracket", thin_edge_up), ScenePart(2, "bolt", lying),
                             ScenePart(5, "block", in_the_corner)), 1, 1)
    found = score.pickable(scene, TOOL)
    assert {3, 5} <= found
    assert 2 not in found
