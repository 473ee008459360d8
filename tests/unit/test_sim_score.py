"""The judge accepts what would hold and says what is wrong with the rest."""

import numpy as np
import pytest

from binpick import geometry
from binpick.settings import SuctionTool, TwoFingerTool
from binpick.sim import score
from binpick.sim.world import ScenePart, WorldScene

TOP = 0.015
TOOL = SuctionTool()
FINGERS = TwoFingerTool(kind="two_finger")
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


def pinched(x=0.1, y=0.05, z=0.004, turn_deg=0.0, open_m=0.05, scene=BLOCK, close_m=0.04):
    """The verdict on fingers that close across the block's 40 mm."""
    turn = np.radians(90 + turn_deg)
    pose = geometry.frame_of_axes(np.array([0.0, 0.0, -1.0]), np.array([np.cos(turn), np.sin(turn), 0.0]), np.array([x, y, z]))
    return score.judge(scene, pose, FINGERS, open_m, close_m)


def test_two_fingers_hold_a_block_across_its_sides():
    verdict = pinched()
    assert verdict.ok, verdict.reason
    assert (verdict.part_id, verdict.kind, verdict.penetration_m) == (3, "block", 0)
    assert verdict.angle_rad == pytest.approx(0, abs=1e-3)
    assert verdict.distance_m == pytest.approx(0, abs=1e-5)
    assert pinched(close_m=0.037).distance_m == pytest.approx(0.003, abs=1e-5)
    assert pinched(turn_deg=180).ok, "half a turn about the approach is the same grip"
    assert pinched(open_m=0.036).penetration_m == pytest.approx(0.002, abs=1e-6)


@pytest.mark.parametrize(("changes", "reason"), [
    ({"z": 0.02}, "nothing between"), ({"x": 0.2}, "nothing between"), ({"open_m": 0.09}, "cannot open"),
    ({"turn_deg": 30, "open_m": 0.065}, "slips"), ({"z": -0.004}, "collides"),
    ({"y": 0.057, "open_m": 0.05}, "collides"),
])
def test_what_is_wrong_with_a_pinch_is_said(changes, reason):
    verdict = pinched(**changes)
    assert not verdict.ok
    assert reason in verdict.reason


def test_a_neighbour_stops_the_fingers_on_their_way_in_and_when_they_close():
    on_edge = geometry.frame_of_axes(np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0]), np.array([0.1, 0.086, 0.02]))
    beside = WorldScene("A", (*BLOCK.parts, ScenePart(4, "block", on_edge)), 1, 1)
    assert pinched(scene=beside).reason == "the tool collides"
    # as wide as both, they meet one on either side
    assert "one part" in pinched(scene=beside, y=0.062, open_m=0.07).reason


def test_a_part_that_meets_the_fingers_above_their_pads_is_not_held():
    bar_up = geometry.frame_of_axes(np.array([0.0, -1.0, 0.0]), np.array([1.0, 0.0, 0.0]), np.array([0.1, 0.05, 0.03]))
    scene = WorldScene("A", (ScenePart(3, "tee", bar_up),), 1, 1)

    def reason(z):
        down = geometry.frame_of_axes(np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0]), np.array([0.1, 0.05, z]))
        return score.judge(scene, down, FINGERS, 0.069, 0.064).reason

    # the bar hangs over the stem, from 44 mm up; a pad is 18 mm deep
    assert (reason(0.04), reason(0.02)) == ("", "the part touches a finger above its pad")
