"""What a recipe and a wrist do not allow is not published, and the answer says why."""

from dataclasses import replace

import numpy as np
import pytest

from binpick import geometry
from binpick.data import Grasp
from binpick.errors import Code, SettingsError
from binpick.grasp import admission, sigma, wrist
from binpick.pipeline import run
from binpick.settings import Box, Cylinder, SuctionTool, TwoFingerTool, parse
from binpick.settings.base import Placement
from binpick.settings.recipe import SigmaLimits, TiltLimit
from binpick.settings.tool import Cup, Wrist

BLOCKS = [("block", geometry.translation(x, 0.0, 0.0075)) for x in (-0.08, 0.0, 0.08)]
ROUND = SuctionTool().bodies
ELBOW = (*ROUND, Box(shape="box", size_m=(0.06, 0.02, 0.02), T_tcp_body=Placement(position_m=(0.04, 0.0, -0.1))))


def grasp(tilt=0.0, heading=0.0, **changes):
    T_bin_tcp = geometry.frame_of_axes(np.array([np.sin(tilt), 0.0, -np.cos(tilt)]),
                                       np.array([np.cos(heading), np.sin(heading), 0.0]), np.array([0.0, 0.0, 0.05]))
    sound = Grasp(T_bin_tcp=T_bin_tcp, tool=1, part_id=1, open_m=0.0, close_m=0.0, quality=0.5, seal_m=0.0, room=1.0,
                  sigma_xy_m=0.0003, sigma_z_m=0.0002, sigma_tilt_rad=0.03)
    return replace(sound, **changes)


def limited(job, tool=None, **limits):
    recipe = job.recipe.model_copy(update={"limits": job.recipe.limits.model_copy(update=limits)})
    return job.model_copy(update={"recipe": recipe} | ({"tools": (tool,)} if tool else {}))


def headings(ways):
    return np.degrees([np.arctan2(way.T_bin_tcp[1, 0], way.T_bin_tcp[0, 0]) for way in ways]).round(6).tolist()


@pytest.mark.parametrize("changes", [{"sigma_xy_m": 0.002}, {"sigma_z_m": 0.002}, {"sigma_tilt_rad": 0.2}])
def test_what_is_too_uncertain_in_any_way_is_left_out(job, changes):
    strict = limited(job, sigma=SigmaLimits(xy_m=0.001, z_m=0.001, tilt_rad=0.1))
    kept, counts = admission.admitted([grasp(), grasp(**changes)], strict)
    assert (len(kept), counts) == (1, {"uncertain": 1, "aslant": 0, "wrist": 0})
    assert len(admission.admitted([grasp(**changes)], job)[0]) == 1, "the recipe's own limits let such a grasp through"


def test_the_robots_cone_is_about_its_own_axis(job):
    # the robot stands at negative x: it comes aslant from there
    cone = TiltLimit(towards=(0.5, 0.0, -1.0), max_rad=0.3)
    kept, counts = admission.admitted([grasp(tilt=0.4), grasp(), grasp(tilt=-0.4)], limited(job, tilt=cone))
    assert (len(kept), counts["aslant"]) == (1, 2)


def test_a_wrist_turns_to_where_it_may_point():
    gripper = TwoFingerTool(kind="two_finger", wrist=Wrist(symmetry=2, limits_rad=(np.pi / 2, 3 * np.pi / 2)))
    assert headings(wrist.equivalents(grasp(heading=0.2), gripper)) == [pytest.approx(np.degrees(0.2) - 180)]
    assert headings(wrist.equivalents(grasp(heading=2.0), gripper)) == [pytest.approx(np.degrees(2.0))]
    stiff = gripper.model_copy(update={"wrist": Wrist(symmetry=1, limits_rad=(np.pi / 2, 3 * np.pi / 2))})
    assert wrist.equivalents(grasp(heading=0.2), stiff) == []


def test_turns_that_change_nothing_are_not_tried_twice():
    four = Wrist(symmetry=4)
    assert len(wrist.equivalents(grasp(), SuctionTool(wrist=four))) == 1
    assert len(wrist.equivalents(grasp(), SuctionTool(wrist=four, bodies=ELBOW))) == 4
    across = (*ROUND, Cylinder(shape="cylinder", radius_m=0.01, length_m=0.1, T_tcp_body=Placement(
        position_m=(0.0, 0.0, -0.1), rotvec_rad=(0.0, np.pi / 2, 0.0))))
    assert len(wrist.equivalents(grasp(), SuctionTool(wrist=four, bodies=across))) == 2
    assert len(wrist.equivalents(grasp(), TwoFingerTool(kind="two_finger"))) == 1


def test_a_rig_file_says_how_far_its_poses_in_the_base_are_off(rig):
    T_camera_bin = geometry.frame_of_axes(np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    found = [grasp()]
    assert rig.quality is None
    assert sigma.calibrated(found, rig, T_camera_bin) is found
    known = rig.model_validate(rig.model_dump() | {"quality": {
        "rms_px": 0.1, "row_error_px": 0.1, "hand_eye_rms_m": 0.0004, "hand_eye_rms_rad": 0.04}})
    [told] = sigma.calibrated([grasp()], known, T_camera_bin)
    deep_m = 0.95**2 * 0.1 / (rig.cameras[0].K[0][0] * 0.15)
    assert told.sigma_z_m == pytest.approx(np.sqrt(0.0002**2 + deep_m**2 + 0.0004**2), rel=0.02)
    assert told.sigma_tilt_rad == pytest.approx(0.05)
    assert told.sigma_xy_m > grasp().sigma_xy_m


def test_when_only_uncertain_grasps_are_left_the_code_says_so(photograph):
    inputs = photograph(BLOCKS)
    sure = run(inputs).result
    assert sure.return_code.code is Code.OK
    assert sure.funnel.counts["uncertain"] == 0
    strict = run(replace(inputs, job=limited(inputs.job, sigma=SigmaLimits(tilt_rad=0.001)))).result
    assert strict.return_code.code is Code.ALL_UNCERTAIN
    assert (strict.grasps, strict.funnel.counts["uncertain"]) == ((), sure.funnel.counts["sealed"])
    nowhere = run(replace(inputs, job=limited(inputs.job, tilt=TiltLimit(towards=(0.0, 0.0, 1.0), max_rad=0.1)))).result
    assert nowhere.return_code.code is Code.ALL_OUT_OF_REACH


@pytest.mark.parametrize(("tool", "fault"), [
    ("cups: [{x_m: 0.02}]", "the middle of the cups"), ("cups: [{x_m: 0.005}, {x_m: -0.005}]", "no two may overlap"),
    ("cups: [{x_m: 0.02}, {x_m: -0.02}], wrist: {symmetry: 4}", "wrist.symmetry"),
    ("kind: two_finger, wrist: {symmetry: 3}", "half a turn"), ("wrist: {limits_rad: [1, 0]}", "below the second"),
])
def test_tools_that_cannot_be_are_refused(tool, fault):
    cell = f"bin: {{inner_size_m: [0.3, 0.2, 0.1], pose: {{}}}}\ngripper: {{{tool}}}\n"
    with pytest.raises(SettingsError, match=fault):
        parse(cell, "cell.yaml")


def test_a_direction_of_nothing_is_no_cone():
    with pytest.raises(ValueError, match="not zero"):
        TiltLimit(towards=(0.0, 0.0, 0.0))


def test_cups_may_stand_in_a_row():
    row = SuctionTool(cups=(Cup(x_m=0.02), Cup(x_m=-0.02)), wrist=Wrist(symmetry=2))
    assert len(row.cups) == 2
