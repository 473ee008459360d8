"""Bad scenes end with their own code and a funnel that says why, never with an exception and never with a pose too many."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from binpick import geometry, pipeline
from binpick.errors import Code
from binpick.settings import Cylinder


def lying(x, y, z, yaw_deg=0.0, tilt_deg=0.0):
    return geometry.make(Rotation.from_euler("ZX", [yaw_deg, tilt_deg], degrees=True).as_matrix(), np.array([x, y, z]))


BLOCK = ("block", lying(0.0, 0.0, 0.0075, 20.0))
BOLTS = [("bolt", lying(0.05 * i - 0.1, 0.035 * j - 0.07, 0.0095, 30.0 * i, 90.0)) for i in range(5) for j in range(5)]
TOWER = [("block", lying(0.0, 0.0, 0.0075 + 0.015 * i)) for i in range(9)]


def seen(inputs):
    result = pipeline.run(inputs).result
    assert bool(result.grasps) == result.return_code.code.carries_poses
    return result


def spoilt(inputs, *regions, grey=0):
    """With parts of both images covered, given in the left rectified view's place on the floor (x, y, radius)."""
    frames = []
    for index, frame in enumerate((inputs.pair.left, inputs.pair.right)):
        camera = inputs.rig.cameras[index]
        T_cam_bin = camera.T_camera_rig @ inputs.job.bin.T_parent_bin
        image = frame.image.copy()
        for x, y, radius in regions:
            ring = np.array([[x + radius * np.cos(a), y + radius * np.sin(a), 0.0] for a in np.linspace(0, 2 * np.pi, 40)])
            pixels = cv2.projectPoints(geometry.transform(T_cam_bin, ring), np.zeros(3), np.zeros(3), camera.K_px,
                                       camera.distortion_coefficients)[0]
            cv2.fillConvexPoly(image, np.rint(pixels).astype(np.int32), grey)
        frames.append(replace(frame, image=image))
    return replace(inputs, pair=replace(inputs.pair, left=frames[0], right=frames[1]))


def test_an_empty_bin_is_proved_empty(photograph):
    result = seen(photograph())
    assert result.return_code.code is Code.BIN_EMPTY
    assert result.bin.coverage > 0.95
    assert all(cell.coverage > 0.9 and cell.level < 0.05 for cell in result.bin.cells)


def test_a_dark_spot_that_could_be_a_part_is_not_proved_empty(photograph):
    """A black part leaves nothing but a hole in what was measured."""
    result = seen(spoilt(photograph(), (0.05, 0.02, 0.02)))
    assert result.return_code.code is Code.BIN_UNKNOWN
    assert result.bin.coverage > 0.9


def test_half_a_bin_covered_is_not_proved_empty(photograph):
    result = seen(spoilt(photograph(), (-0.09, 0.0, 0.09)))
    assert result.return_code.code is Code.BIN_UNKNOWN
    levels = {cell.x_m < 0: cell.coverage for cell in result.bin.cells}
    assert levels[True] < 0.3 < 0.9 < levels[False]


@pytest.mark.parametrize("grey", [0, 255])
def test_covered_and_dazzled_cameras_have_no_depth(photograph, grey):
    result = seen(spoilt(photograph([BLOCK]), (0.0, 0.0, 0.4), grey=grey))
    assert result.return_code.code is Code.NO_DEPTH


def test_parts_without_a_surface_for_the_tool(photograph):
    result = seen(photograph(BOLTS))
    assert result.return_code.code is Code.NOTHING_GRASPABLE
    assert result.funnel.dominating == "rim_not_on_one_part"
    assert result.funnel.counts["spots"] == sum(result.funnel.counts[k] for k in ("rim_not_on_one_part", "no_seal", "tilt"))


def test_a_part_at_a_wall_that_only_a_slimmer_tool_could_reach(photograph):
    inputs = photograph([("block", lying(0.128, 0.078, 0.0075, 90.0))])
    wide = Cylinder(shape="cylinder", radius_m=0.06, length_m=0.1,
                    T_tcp_body={"position_m": (0.0, 0.0, -0.06)})
    tool = inputs.job.tool.model_copy(update={"bodies": (wide,)})
    result = seen(replace(inputs, job=inputs.job.model_copy(update={"tools": (tool,)})))
    assert result.return_code.code is Code.ALL_COLLIDE
    assert result.funnel.dominating == "collide"
    assert result.funnel.counts["collide"] > result.funnel.counts["clear"] == 0


def test_parts_out_of_reach_are_stopped_by_the_last_gate(photograph):
    inputs = photograph([BLOCK])
    limits = inputs.job.recipe.limits
    recipe = inputs.job.recipe.model_copy(update={"limits": limits.model_copy(
        update={"reach": limits.reach.model_copy(update={"min_m": (9.0, 9.0, 9.0)})})})
    result = seen(replace(inputs, job=inputs.job.model_copy(update={"recipe": recipe})))
    assert result.return_code.code is Code.ALL_OUT_OF_REACH
    assert result.funnel.dominating == "gate_out_of_reach"


def test_a_tower_above_the_rim_is_picked_and_flagged(photograph):
    result = seen(photograph(TOWER))
    assert result.return_code.code is Code.OVERFILLED
    assert result.grasps[0].position_m[2] == pytest.approx(0.135, abs=0.002)


def test_fill_is_told_where_it_lies(photograph):
    result = seen(photograph([("block", lying(0.1 + 0.03 * i, 0.06 * j, 0.0075 + 0.015 * k, 90.0))
                              for i in range(2) for j in (-1, 0, 1) for k in range(4)]))
    cells = result.bin.cells
    assert len(cells) == 3 * 2
    assert sum(cell.size_m[0] * cell.size_m[1] for cell in cells) == pytest.approx(0.3 * 0.2)
    high = [cell.level for cell in cells if cell.x_m > 0.05]
    low = [cell.level for cell in cells if cell.x_m < 0.05]
    assert min(high) > 0.25 > 0.05 > max(low)


def test_a_bin_that_is_not_there_is_not_found(photograph, expecting):
    result = seen(expecting(photograph([BLOCK]), lying(0.2, 0.12, 0.0)))
    assert result.return_code.code is Code.BIN_NOT_FOUND
    assert not result.bin.found
    assert result.bin.T_camera_bin is None
    assert result.bin.fill_level is None


def test_a_tilted_bin_is_not_its_model(photograph, expecting):
    result = seen(expecting(photograph([BLOCK]), lying(0.0, 0.0, 0.0, 0.0, 6.0)))
    assert result.return_code.code is Code.BIN_MISMATCH
    assert "tilted by 6." in result.return_code.message
    assert not result.bin.found
    assert min(result.bin.rim.seen) > 0.5
