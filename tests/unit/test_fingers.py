"""Two fingers on planted boxes: where they close, how wide, and what keeps them away."""

from dataclasses import replace

import numpy as np
import pytest

from binpick import geometry
from binpick.grasp import bars, clearance, fingers, rank, slices
from binpick.scene import heightmap, segment
from binpick.scene.surface import surface
from binpick.settings import TwoFingerTool

TOOL = TwoFingerTool(kind="two_finger")
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])


def seen(planted):
    grid = surface(planted.depth, planted.rectified, planted.T_bin_camera)
    scene = clearance.obstacles(heightmap.height_map(grid.xyz, planted.job.bin), planted.job.bin)
    return grid, scene, segment.segment(grid, planted.job.bin, planted.job.recipe.part, planted.job.recipe.segment)


def found(planted, tool=TOOL):
    grid, scene, segments = seen(planted)
    grasps, counts = fingers.candidates(segments, tool, grid.sigma_z_m, scene, planted.job.recipe.limits.margin_m)
    return rank.rank(grasps, segments, tool), counts, scene


def test_a_block_is_gripped_across_its_middle_below_its_top(plant, slab):
    grasps, counts, _ = found(plant([slab(0.02, 0.01, 0.06, 0.03, 0.03)], noise_px=0.1))
    best = grasps[0]
    assert counts["pinched"] >= len(grasps) > 0
    assert geometry.is_rigid(best.T_bin_tcp)
    # closes across the narrow side or the long one; z down
    assert max(abs(best.T_bin_tcp[:2, 0])) > 0.99
    assert best.T_bin_tcp[2, 2] < -0.99
    across = int(np.abs(best.T_bin_tcp[:2, 0]).argmax())
    assert best.T_bin_tcp[across, 3] == pytest.approx((0.02, 0.01)[across], abs=0.001)
    # the planted depth ends two pixels before every edge
    assert best.close_m == pytest.approx((0.06, 0.03)[across] - 0.0023, abs=0.002)
    assert best.close_m + 0.005 < best.open_m <= TOOL.fingers.stroke_max_m
    # the fingertips reach below the top, by no more than the pads, and not to the floor
    grip = 0.03 - best.T_bin_tcp[2, 3]
    assert 0.003 < grip <= TOOL.fingers.pad_depth_m
    assert best.T_bin_tcp[2, 3] > 0.002


def test_a_tilted_block_is_gripped_along_its_own_normal(plant, slab):
    grid, scene, segments = seen(plant([slab(0.0, 0.0, 0.05, 0.03, 0.05, 0.35)], noise_px=0.1))
    grasps, _ = fingers.candidates(segments, TOOL, grid.sigma_z_m, scene, 0.002)
    across = [grasp.T_bin_tcp[:3, 2] for grasp in grasps if abs(grasp.T_bin_tcp[0, 0]) < 0.1]
    normal = np.array([0.0, -np.sin(0.35), np.cos(0.35)])
    # straight down, the ends across the slope are 20° off the closing axis
    assert across
    assert np.degrees(np.arccos(np.clip(-np.array(across) @ normal, -1, 1))).max() < 4


def test_no_approach_leans_further_than_the_tool_may(plant, slab):
    upright = TOOL.model_copy(update={"max_tilt_rad": 0.2})
    grasps, *_ = found(plant([slab(0.0, 0.0, 0.05, 0.04, 0.05, 0.35)], noise_px=0.1), upright)
    assert all(np.arccos(-grasp.T_bin_tcp[2, 2]) <= 0.2 + 1e-9 for grasp in grasps)


def test_a_scene_that_moves_takes_its_grasps_along(plant, slab):
    here, there = ((-0.06, -0.03), (0.05, 0.02))
    (a, *_), (b, *_) = (found(plant([slab(*at, 0.06, 0.03, 0.03)]))[0] for at in (here, there))
    shift = b.T_bin_tcp[:3, 3] - a.T_bin_tcp[:3, 3]
    np.testing.assert_allclose(shift, [0.11, 0.05, 0.0], atol=0.003)
    assert abs(a.T_bin_tcp[:3, 0] @ b.T_bin_tcp[:3, 0]) > 0.999
    assert a.close_m == pytest.approx(b.close_m, abs=0.0015)


def test_a_part_wider_than_the_stroke_is_refused_and_counted(plant, slab):
    grasps, counts, _ = found(plant([slab(0, 0, 0.10, 0.09, 0.03)]))
    assert not grasps
    assert counts["outside_stroke"] > 0
    assert counts["pinched"] == 0


def test_a_part_narrower_than_the_closed_fingers_is_refused_and_counted(plant, slab):
    wide = TOOL.model_copy(update={"fingers": TOOL.fingers.model_copy(update={"stroke_min_m": 0.04})})
    grasps, counts, _ = found(plant([slab(0, 0, 0.06, 0.03, 0.03)]), wide)
    assert counts["outside_stroke"] > 0
    assert all(grasp.close_m > 0.04 for grasp in grasps)


def test_a_neighbour_where_a_finger_would_go_keeps_it_away(plant, slab):
    block = slab(0, 0, 0.06, 0.03, 0.03)
    beside = [slab(0, y, 0.08, 0.02, 0.03) for y in (-0.031, 0.031)]
    mine = [grasp for grasp in found(plant([block, *beside]))[0] if abs(grasp.T_bin_tcp[1, 3]) < 0.01]
    # across y both fingers would land on the neighbours; along x they are free
    assert all(abs(grasp.T_bin_tcp[0, 0]) > 0.9 for grasp in mine)
    shut_in = [*beside, *(slab(x, 0, 0.02, 0.08, 0.03) for x in (-0.046, 0.046))]
    grasps, counts, _ = found(plant([block, *shut_in]))
    assert not [g for g in grasps if np.abs(g.T_bin_tcp[:2, 3]).max() < 0.01]
    assert counts["no_room"] > 0


def test_unseen_space_beside_a_part_is_an_obstacle(plant, slab):
    block, tall = slab(0, 0, 0.03, 0.09, 0.03), slab(0.06, 0, 0.03, 0.09, 0.06)
    free = found(plant([block, tall]))[0]
    hidden = found(plant([block, tall], unseen=((0.03, 0.0, 0.035),)))[0]
    assert any(abs(g.T_bin_tcp[0, 3]) < 0.01 for g in free)
    assert not any(abs(g.T_bin_tcp[0, 3]) < 0.01 and abs(g.T_bin_tcp[1, 3]) < 0.02 for g in hidden)


def test_half_a_turn_about_the_approach_is_the_same_grip(plant, slab):
    grasps, _, scene = found(plant([slab(0.02, 0.01, 0.06, 0.03, 0.03), slab(0.02, -0.05, 0.06, 0.03, 0.05)]))
    for grasp in grasps:
        turned = replace(grasp, T_bin_tcp=grasp.T_bin_tcp @ HALF_TURN)
        assert clearance.clearance(turned, TOOL, scene) == pytest.approx(clearance.clearance(grasp, TOOL, scene), abs=1e-9)
        assert grasp.T_bin_tcp[0, 0] >= 0, "of both, always the same one is published"


def test_the_clearance_is_that_of_the_open_fingers(plant, slab):
    grasps, _, scene = found(plant([slab(0.0, 0.0, 0.06, 0.03, 0.03)]))
    at = geometry.frame_of_axes(np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 0.015]))
    for open_m, distance_m in ((0.042, 0.006), (0.05, 0.010), (0.02, -0.001)):
        grasp = replace(grasps[0], T_bin_tcp=at, open_m=open_m)
        # the height map's cells are 2 mm wide
        assert clearance.clearance(grasp, TOOL, scene) < distance_m + 0.001
        assert clearance.clearance(grasp, TOOL, scene) > distance_m - 0.008


def test_what_lies_under_another_part_is_not_lifted(plant, slab):
    below, above = slab(0.0, 0.0, 0.09, 0.03, 0.02), slab(0.05, 0.0, 0.03, 0.06, 0.06)
    _, scene, segments = seen(plant([below, above]))
    shares = clearance.covered(segments, scene)
    low, high = sorted(shares, key=lambda label: segments.part_points[label][:, 2].mean())
    assert shares[low] > fingers.MAX_COVERED
    assert shares[high] == 0
    grasps, counts, _ = found(plant([below, above]))
    assert counts["covered"] > 0
    assert all(grasp.T_bin_tcp[2, 3] > 0.02 for grasp in grasps)


def test_a_scene_without_parts_has_no_grasps(plant):
    assert found(plant([]))[0] == []


def test_a_round_bar_is_as_wide_as_its_circle_and_one_whose_top_alone_is_seen_is_no_hold():
    def seen_of(share, radius=0.012):
        x = np.linspace(-share * radius, share * radius, 41)
        z = radius - np.sqrt(radius**2 - x**2)
        of = bars.moments(x, z).sum(axis=1)[:, None]
        return bars.circles(of, x[:1], x[-1:])

    most, cap, flat = seen_of(0.9), seen_of(0.5), seen_of(0.02)
    assert most.round.all()
    assert most.radius_m[0] == pytest.approx(0.012, abs=1e-5)
    assert (most.x_m[0], most.z_m[0]) == pytest.approx((0.0, 0.012), abs=1e-5)
    assert cap.cap.all()
    assert not cap.round.any()
    assert not flat.round.any()
    assert not flat.cap.any()


def test_beside_a_wall_the_gripper_also_comes_from_further_inside(plant, slab):
    _, scene, segments = seen(plant([slab(0.0, 0.06, 0.04, 0.03, 0.03)]))
    z = slices.cut(segments, 0.012, 0.6, scene.half_m).R_bin_tcp[:, :, 2]
    assert z[:, 1].max() == pytest.approx(np.sin(0.57), abs=1e-6)
    assert z[:, 1].min() > -0.1, "never towards the wall from outside"
    assert np.arccos(-z[:, 2]).max() <= 0.6
