"""The lift in MuJoCo: what is held rises with the hand, what is not stays where it lies."""

import numpy as np
import pytest

from binpick.geometry import frame_of_axes, translation
from binpick.settings import SuctionTool, TwoFingerTool
from binpick.settings.tool import Cup
from binpick.sim.lift import lift
from binpick.sim.mesh import Caster
from binpick.sim.world import World

DOWN = np.array([0.0, 0.0, -1.0])


@pytest.fixture(scope="module")
def blocks():
    return World("A", "block", 3, seed=1).scene()


@pytest.fixture(scope="module")
def cylinders():
    return World("A", "cylinder", 3, seed=2).scene()


def on_top(scene, part, beside=(0.0, 0.0)):
    """A pose on the part's surface, seen from above, with the approach against its normal."""
    x, y, _ = part.T_bin_part[:3, 3] + part.T_bin_part[:3, :3] @ [*beside, 0.0]
    hit = Caster(scene).cast(np.array([[x, y, 0.4, 0, 0, -1]], np.float32))
    return frame_of_axes(-hit.normal[0].astype(float), np.array([1.0, 0.1, 0.0]), np.array([x, y, 0.4 - hit.distance[0]]))


def across(part):
    """A pose with the fingers to both sides of a lying cylinder."""
    return frame_of_axes(DOWN, np.cross(part.T_bin_part[:3, 2], DOWN), part.T_bin_part[:3, 3] + [0, 0, -0.004])


def test_a_cup_lifts_a_block(blocks):
    tool = SuctionTool()
    for part in blocks.parts:
        up = lift(blocks, on_top(blocks, part), tool, part.part_id)
        assert up.held
        assert up.others == 0
        assert up.raised_m == pytest.approx(tool.lift_m, abs=0.002)


def test_a_cup_too_weak_leaves_the_part(blocks):
    part = blocks.parts[0]
    up = lift(blocks, on_top(blocks, part), SuctionTool(cups=(Cup(radius_m=0.0015),)), part.part_id)
    assert not up.held
    assert up.raised_m < 0.05


def test_two_fingers_lift_a_cylinder(cylinders):
    tool = TwoFingerTool(kind="two_finger")
    lying = [part for part in cylinders.parts if abs(part.T_bin_part[2, 2]) < 0.3]
    assert lying
    for part in lying:
        up = lift(cylinders, across(part), tool, part.part_id, open_m=0.05)
        assert up.held
        assert up.raised_m == pytest.approx(tool.lift_m, abs=0.002)


def test_fingers_above_a_part_come_up_empty(cylinders):
    part = cylinders.parts[0]
    above = across(part) @ translation(0.0, 0.0, -0.03)
    up = lift(cylinders, above, TwoFingerTool(kind="two_finger"), part.part_id, open_m=0.05)
    assert not up.held
    assert up.raised_m < 0.005
