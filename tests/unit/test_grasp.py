"""Planted boxes: suction finds the faces, clearance the obstacles, the gate what must not leave."""

from dataclasses import replace

import numpy as np
import pytest

from binpick import geometry
from binpick.grasp import clearance, gate, rank, suction
from binpick.result import GraspMessage, PoseMessage, Sigma, ToolMessage
from binpick.scene import heightmap, segment
from binpick.scene.surface import surface
from binpick.settings import SuctionTool
from binpick.settings.recipe import TiltLimit
from binpick.settings.tool import Cup, Wrist
from binpick.stereo import cloud


def found(planted):
    points = cloud.reproject(planted.depth, planted.rectified)
    heights = heightmap.height_map(geometry.transform(planted.T_bin_camera, points.xyz), planted.job.bin)
    grid = surface(planted.depth, planted.rectified, planted.T_bin_camera)
    segments = segment.segment(grid, planted.job.bin, planted.job.recipe.part, planted.job.recipe.segment)
    grasps, counts = suction.candidates(segments, planted.job.tool, grid.sigma_z_m)
    return heights, segments, grasps, counts


@pytest.mark.parametrize("tilt", [0.0, 0.4])
def test_a_face_is_grasped_on_its_surface_along_its_normal(plant, slab, tilt):
    planted = plant([slab(0.02, 0.01, 0.06, 0.04, 0.05, tilt)], noise_px=0.15)
    _, segments, grasps, _ = found(planted)
    best = rank.rank(grasps, segments, planted.job.tool)[0]
    normal = np.array([0, -np.sin(tilt), np.cos(tilt)])
    assert np.degrees(np.arccos(-best.T_bin_tcp[:3, 2] @ normal)) < 3
    assert abs((best.T_bin_tcp[:3, 3] - [0.02, 0.01, 0.05]) @ normal) < 0.0006
    assert geometry.is_rigid(best.T_bin_tcp)
    # x lies along the long extent
    assert abs(best.T_bin_tcp[0, 0]) > 0.95


def test_a_face_narrower_than_the_cup_is_not_offered(plant, slab):
    _, _, grasps, counts = found(plant([slab(0, 0, 0.06, 0.010, 0.05)], noise_px=0.1))
    assert not grasps
    assert counts["rim_not_on_one_part"] > 0


def test_a_face_too_steep_is_not_offered(plant, slab):
    planted = plant([slab(0, 0, 0.06, 0.06, 0.06, 0.75)], noise_px=0.1)
    _, _, grasps, counts = found(planted)
    assert not grasps
    assert counts["tilt"] > 0


def test_a_free_part_is_clear_and_a_part_in_a_shaft_is_not(plant, slab):
    free = plant([slab(0, 0, 0.06, 0.04, 0.02)])
    heights, segments, grasps, _ = found(free)
    best = rank.rank(grasps, segments, free.job.tool)[0]
    # its own face beside the foot is the nearest thing
    assert clearance.clearance(best, free.job.tool, clearance.obstacles(heights, free.job.bin)) > 0.004
    walls = [slab(x, y, 0.02, 0.10, 0.095) for x, y in ((-0.021, 0), (0.021, 0))]
    shaft = plant([slab(0, 0, 0.022, 0.06, 0.02), *walls])
    heights, segments, grasps, _ = found(shaft)
    deep = [g for g in grasps if g.T_bin_tcp[2, 3] < 0.05]
    assert deep, "the part at the bottom of the shaft is seen and would seal"
    scene = clearance.obstacles(heights, shaft.job.bin)
    assert max(clearance.clearance(g, shaft.job.tool, scene) for g in deep) < 0.002


def test_unseen_space_is_an_obstacle(plant, slab):
    boxes = [slab(0, 0, 0.06, 0.04, 0.02), slab(0.055, 0, 0.03, 0.05, 0.09)]
    # what is hidden may be as high as the tall box beside it, up to the border of the unseen disc
    for unseen, free in (((), True), (((0.032, 0.0, 0.024),), False)):
        planted = plant(boxes, unseen=unseen)
        heights, _, grasps, _ = found(planted)
        T_bin_tcp = geometry.frame_of_axes(np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.02]))
        grasp = replace(grasps[0], T_bin_tcp=T_bin_tcp)
        distance_m = clearance.clearance(grasp, planted.job.tool, clearance.obstacles(heights, planted.job.bin))
        assert (distance_m > 0.004) == free


def test_the_sieve_never_stops_what_the_exact_check_passes(plant, slab):
    boxes = [slab(-0.08, 0, 0.06, 0.04, 0.03), slab(0.0, 0.03, 0.05, 0.04, 0.05, 0.3), slab(0.08, -0.03, 0.05, 0.04, 0.015)]
    planted = plant(boxes, noise_px=0.15)
    heights, _, grasps, _ = found(planted)
    scene = clearance.obstacles(heights, planted.job.bin)
    for grasp, hit in zip(grasps, clearance.blocked(grasps, planted.job.tool, heights), strict=True):
        if hit:
            assert clearance.clearance(grasp, planted.job.tool, scene) < planted.job.recipe.limits.margin_m


def test_the_order_does_not_depend_on_the_order_of_candidates(plant, slab):
    boxes = [slab(-0.08, 0, 0.06, 0.04, 0.03), slab(0.0, 0.03, 0.06, 0.04, 0.03), slab(0.08, -0.03, 0.06, 0.04, 0.03)]
    planted = plant(boxes, noise_px=0.15)
    _, segments, grasps, _ = found(planted)
    ranked = [g.T_bin_tcp.tobytes() for g in rank.rank(grasps, segments, planted.job.tool)]
    assert ranked == [g.T_bin_tcp.tobytes() for g in rank.rank(grasps[::-1], segments, planted.job.tool)]


def message(**changes):
    position_m = changes.get("position_m", (0.0, 0.0, 0.05))
    turn = changes.get("quaternion_xyzw", (1.0, 0.0, 0.0, 0.0))
    behind = geometry.from_quaternion(np.array(position_m), np.array(turn)) @ geometry.translation(0.0, 0.0, -0.08)
    before = PoseMessage(position_m=tuple(behind[:3, 3].tolist()), quaternion_xyzw=tuple(geometry.quaternion(behind).tolist()))
    fields = {"id": "1-1", "rank": 1, "tool": ToolMessage(number=1, name="suction", kind="suction"), "frame": "bin",
              "position_m": position_m, "quaternion_xyzw": turn, "T_frame_pregrasp": before,
              "approach_m": 0.08, "lift_m": 0.15, "open_m": 0.0,
              "close_m": 0.0, "quality": 0.5, "clearance_m": 0.01, "part_id": 1,
              "sigma": Sigma(xy_m=0.001, z_m=0.001, tilt_rad=0.01)}
    return GraspMessage(**{**fields, **changes})


@pytest.mark.parametrize(("changes", "objection"), [
    ({}, ""),
    ({"quaternion_xyzw": (1.0, 0.0, 0.0, 0.1)}, "quaternion"),
    ({"position_m": (0.2, 0.0, 0.05)}, "outside_bin"),
    ({"position_m": (0.0, 0.0, -0.03)}, "outside_bin"),
    ({"quaternion_xyzw": (0.0, 0.0, 0.0, 1.0)}, "tilt"),
    ({"position_m": (0.0, 0.09, 0.05)}, "out_of_reach"),
    # the pose itself is within reach, where the robot would come from is not
    ({"position_m": (0.0, 0.0, 0.11)}, "out_of_reach"),
    ({"T_frame_pregrasp": PoseMessage(position_m=(0.0, 0.001, 0.13), quaternion_xyzw=(1.0, 0.0, 0.0, 0.0))}, "pregrasp"),
    ({"T_frame_pregrasp": PoseMessage(position_m=(0.0, 0.0, 0.13), quaternion_xyzw=(0.0, 1.0, 0.0, 0.0))}, "pregrasp"),
])
def test_the_last_gate(job, changes, objection):
    limits = job.recipe.limits.model_copy(update={"reach": job.recipe.limits.reach.model_copy(
        update={"max_m": (10.0, 0.08, 0.18)})})
    assert gate.objection(message(**changes), np.eye(4), np.eye(4), job.bin, job.tool, limits) == objection


def test_the_last_gate_knows_the_robots_cone(job):
    limits = job.recipe.limits.model_copy(update={"tilt": TiltLimit(towards=(0.5, 0.0, -1.0), max_rad=0.3)})
    assert gate.objection(message(), np.eye(4), np.eye(4), job.bin, job.tool, limits) == "tilt"


def test_the_last_gate_stops_what_is_not_finite(job):
    nan = message().model_copy(update={"position_m": (float("nan"), 0.0, 0.0)})
    assert gate.objection(nan, np.eye(4), np.eye(4), job.bin, job.tool, job.recipe.limits) == "not_finite"


def test_the_last_gate_stops_what_cannot_be_written_as_a_pose(plant, slab):
    *_, grasps, _ = found(plant([slab(0, 0, 0.06, 0.04, 0.05)]))
    sound = replace(grasps[0], clearance_m=0.01)
    lost, mirrored = sound.T_bin_tcp.copy(), sound.T_bin_tcp.copy()
    lost[0, 3], mirrored[:3, 0] = np.nan, -mirrored[:3, 0]
    assert [gate.malformed(grasp) for grasp in (
        sound, replace(sound, T_bin_tcp=lost), replace(sound, T_bin_tcp=mirrored), replace(sound, sigma_z_m=float("inf")),
    )] == ["", "not_finite", "quaternion", "not_finite"]


def test_a_grasp_is_a_value(plant, slab):
    planted = plant([slab(0, 0, 0.06, 0.04, 0.05)])
    *_, grasps, _ = found(planted)
    assert replace(grasps[0], quality=0.5).quality == 0.5
    assert grasps[0].quality == 0.0


@pytest.mark.parametrize("aside_m", [-0.0006, 0.0, 0.0006])
def test_a_lip_sits_in_the_middle_of_a_narrow_face(plant, slab, aside_m):
    # half a millimetre is left on either side of the lip; a half-resolution pixel is 1.1 mm
    planted = plant([slab(0.0, aside_m, 0.06, 0.015, 0.05)], noise_px=0.05)
    _, segments, grasps, _ = found(planted)
    best = rank.rank(grasps, segments, planted.job.tool)[0]
    assert abs(best.T_bin_tcp[1, 3] - aside_m) < 0.0004


ROW = SuctionTool(cups=(Cup(x_m=0.018), Cup(x_m=-0.018)), wrist=Wrist(symmetry=2))


def by_row(planted, tool=ROW):
    grid = surface(planted.depth, planted.rectified, planted.T_bin_camera)
    segments = segment.segment(grid, planted.job.bin, planted.job.recipe.part, planted.job.recipe.segment)
    return suction.candidates(segments, tool, grid.sigma_z_m)


def test_a_row_of_cups_is_laid_along_the_part_with_every_lip_on_it(plant, slab):
    grasps, _ = by_row(plant([slab(0.0, 0.0, 0.07, 0.03, 0.05), slab(0.0, 0.06, 0.07, 0.03, 0.05)], noise_px=0.1))
    assert {grasp.part_id for grasp in grasps} == {1, 2}
    for grasp in grasps:
        assert abs(grasp.T_bin_tcp[0, 0]) > 0.95, "square to the part the outer lips would hang beside it"
        lips = geometry.transform(grasp.T_bin_tcp, np.array([[0.018, 0.0, 0.0], [-0.018, 0.0, 0.0]]))
        assert (np.abs(lips[:, 0]) < 0.0285).all()
        assert (np.abs(lips[:, 2] - 0.05) < 0.0006).all()


def test_a_row_of_cups_is_also_tried_square_to_the_part(plant, slab):
    grasps, _ = by_row(plant([slab(0.0, 0.0, 0.07, 0.06, 0.05)], noise_px=0.1))
    along = [abs(grasp.T_bin_tcp[0, 0]) > 0.95 for grasp in grasps]
    assert any(along)
    assert not all(along)


def test_no_row_of_cups_fits_a_part_that_one_cup_holds(plant, slab):
    planted = plant([slab(0.0, 0.0, 0.036, 0.036, 0.05), slab(0.0375, 0.0, 0.036, 0.036, 0.051)], noise_px=0.1)
    *_, single, _ = found(planted)
    assert single
    grasps, counts = by_row(planted)
    assert not grasps, "one lip would lie on the neighbour, or on the edge"
    assert counts["rim_not_on_one_part"] == counts["spots"]


def test_two_lips_are_more_certain_than_one(plant, slab):
    planted = plant([slab(0.0, 0.0, 0.07, 0.03, 0.05)], noise_px=0.15)
    *_, single, _ = found(planted)
    grasps, _ = by_row(planted)
    assert np.mean([grasp.sigma_tilt_rad for grasp in grasps]) < np.mean([grasp.sigma_tilt_rad for grasp in single])
