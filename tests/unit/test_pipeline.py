"""The whole pipeline on rendered pairs: the same bytes again, the right code for a scene without grasps, frames that agree."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from binpick import answer, geometry, pipeline, recording
from binpick.cycle import CycleInput
from binpick.data import Grasp, Light, StereoPair
from binpick.errors import Code, FlangePoseMissing, FrameUnavailable, ImageError
from binpick.frames import Frames
from binpick.lab import exam
from binpick.result import PoseMessage, Request
from binpick.settings import SuctionTool, TwoFingerTool
from binpick.settings.recipe import Shot
from binpick.sim import score


@pytest.fixture(scope="module")
def paper() -> exam.Paper:
    return exam.paper("A", 1, parts=10)


@pytest.fixture(scope="module")
def outcome(paper):
    return pipeline.run(paper.inputs)


def with_images(inputs: CycleInput, left, right) -> CycleInput:
    pair = inputs.pair
    return replace(inputs, pair=StereoPair(replace(pair.left, image=left), replace(pair.right, image=right), pair.captured_at,
                                           pair.skew_us, pair.sigma_us, pair.proof))


def test_a_filled_bin_gives_grasps_in_order(outcome):
    result = outcome.result
    assert result.return_code.code is Code.OK
    assert [g.rank for g in result.grasps] == list(range(1, len(result.grasps) + 1))
    assert [g.quality for g in result.grasps] == sorted((g.quality for g in result.grasps), reverse=True)
    assert result.funnel.counts["published"] == len(result.grasps)


def test_a_recording_gives_the_same_bytes(paper, outcome, tmp_path):
    recording.save(tmp_path / "cycle", paper.inputs, outcome.result)
    inputs, stored = recording.load(tmp_path / "cycle")
    assert pipeline.run(inputs).result.timeless_bytes() == stored.timeless_bytes() == outcome.result.timeless_bytes()


def test_one_thread_gives_the_same_bytes(paper, outcome):
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        assert pipeline.run(paper.inputs).result.timeless_bytes() == outcome.result.timeless_bytes()
    finally:
        cv2.setNumThreads(threads)


def test_frames_tell_the_same_pose(paper, outcome):
    rig, T_camera_bin = paper.inputs.rig, paper.inputs.job.bin.T_parent_bin
    T_bin_tcp = pose(outcome.result.grasps[0])
    for frame, T_frame_bin in (("camera", T_camera_bin), ("base", np.array(rig.T_base_rig) @ T_camera_bin)):
        request = Request.model_validate({"frame": frame})
        there = pipeline.run(replace(paper.inputs, request=request)).result.grasps[0]
        assert there.frame == frame
        assert np.allclose(pose(there), T_frame_bin @ T_bin_tcp, atol=1e-9)


def pose(grasp):
    return geometry.from_quaternion(np.array(grasp.position_m), np.array(grasp.quaternion_xyzw))


def test_black_images_have_no_depth(paper):
    black = np.zeros_like(paper.inputs.pair.left.image)
    result = pipeline.run(with_images(paper.inputs, black, black)).result
    assert result.return_code.code is Code.NO_DEPTH
    assert not result.grasps


def test_an_empty_bin_is_empty():
    result = pipeline.run(exam.paper("A", 1, parts=0).inputs).result
    assert result.return_code.code is Code.BIN_EMPTY
    assert result.bin.coverage > 0.7


def test_a_covered_empty_bin_is_not_called_empty():
    inputs = exam.paper("A", 1, parts=0).inputs
    left, right = (image.copy() for image in (inputs.pair.left.image, inputs.pair.right.image))
    for image in (left, right):
        image[:, 700:1300] = 0
    assert pipeline.run(with_images(inputs, left, right)).result.return_code.code in (Code.BIN_UNKNOWN, Code.NO_DEPTH)


def test_images_of_another_size_are_refused(paper):
    small = np.ascontiguousarray(paper.inputs.pair.left.image[::2, ::2])
    with pytest.raises(ImageError, match="968x608"):
        pipeline.run(with_images(paper.inputs, small, small))


def test_a_base_that_is_not_known_is_refused(paper):
    rig = paper.inputs.rig.model_copy(update={"T_base_rig": None})
    with pytest.raises(FrameUnavailable):
        pipeline.run(replace(paper.inputs, rig=rig, request=Request.model_validate({"frame": "base"})))


def test_a_rig_on_the_flange_needs_and_uses_its_pose(paper):
    T_base_rig = np.array(paper.inputs.rig.T_base_rig)
    T_flange_rig = geometry.translation(0.01, 0.02, 0.03)
    T_base_flange = T_base_rig @ geometry.inverse(T_flange_rig)
    rig = paper.inputs.rig.model_copy(update={"T_base_rig": None, "T_flange_rig": tuple(map(tuple, T_flange_rig.tolist()))})
    asked = Request.model_validate({"frame": "base"})
    with pytest.raises(FlangePoseMissing):
        pipeline.run(replace(paper.inputs, rig=rig, request=asked))
    flange = PoseMessage(position_m=tuple(T_base_flange[:3, 3].tolist()),
                         quaternion_xyzw=tuple(geometry.quaternion(T_base_flange).tolist()))
    on_flange = pipeline.run(replace(paper.inputs, rig=rig, request=asked.model_copy(update={"T_base_flange": flange})))
    fixed = pipeline.run(replace(paper.inputs, request=asked))
    assert np.allclose(pose(on_flange.result.grasps[0]), pose(fixed.result.grasps[0]), atol=1e-9)


def test_poses_out_of_reach_are_stopped_and_counted(paper, outcome):
    limits = paper.inputs.job.recipe.limits
    nowhere = limits.reach.model_copy(update={"min_m": (9.0, 9.0, 9.0)})
    recipe = paper.inputs.job.recipe.model_copy(update={"limits": limits.model_copy(update={"reach": nowhere})})
    result = pipeline.run(replace(paper.inputs, job=paper.inputs.job.model_copy(update={"recipe": recipe}))).result
    assert result.return_code.code is Code.ALL_OUT_OF_REACH
    assert result.stopped == {"out_of_reach": len(outcome.result.grasps)}
    assert not result.grasps


def test_poses_of_a_pair_older_than_its_trigger_are_stopped(paper):
    stale = replace(paper.inputs.pair.right, received_ns=paper.inputs.pair.right.triggered_ns)
    result = pipeline.run(replace(paper.inputs, pair=replace(paper.inputs.pair, right=stale))).result
    assert result.return_code.code is Code.ALL_OUT_OF_REACH
    assert set(result.stopped) == {"older_than_trigger"}


def test_a_pose_that_is_none_costs_itself_alone(paper):
    T_bin_tcp = geometry.from_quaternion(np.array([0.0, 0.0, 0.05]), np.array([1.0, 0.0, 0.0, 0.0]))
    sound = Grasp(T_bin_tcp=T_bin_tcp, tool=1, part_id=1, open_m=0.0, close_m=0.0, quality=0.5, seal_m=0.0,
                  room=1.0, sigma_xy_m=1e-4, sigma_z_m=1e-4, sigma_tilt_rad=0.01, clearance_m=0.01)
    lost = replace(sound, T_bin_tcp=np.full((4, 4), np.nan))
    messages, counts = answer.publishable([lost, sound], paper.inputs, Frames.of(paper.inputs))
    assert [message.id for message in messages] == ["1-1"]
    assert counts == {"gate_not_finite": 1, "published": 1}


def test_time_can_run_out_between_stages(paper):
    class OutOfTime(Exception):
        pass

    asked = []

    def proceed():
        asked.append(1)
        if len(asked) == 3:
            raise OutOfTime

    with pytest.raises(OutOfTime):
        pipeline.run(paper.inputs, proceed)


def shot(paper: exam.Paper, light: Light, number: int) -> StereoPair:
    images = [exam.renderer("A").expose(paper.scene, index, light, number) for index in (0, 1)]
    inputs = with_images(paper.inputs, *images)
    return replace(inputs.pair, skew_us=-40.0 * number, left=replace(inputs.pair.left, resends=number))


@pytest.fixture(scope="module")
def several(paper) -> CycleInput:
    """The first shot, a short one, and one without the projector."""
    recipe = paper.inputs.job.recipe.model_copy(update={"shots": (Shot(), Shot(exposure_us=1200.0), Shot(projector=False))})
    more = tuple(shot(paper, light, number) for number, light in enumerate(recipe.lights[1:], start=1))
    return replace(paper.inputs, job=paper.inputs.job.model_copy(update={"recipe": recipe}), more=more)


def test_several_shots_are_measured_together(several, outcome):
    result = pipeline.run(several)
    assert result.result.return_code.code is Code.OK
    assert not np.array_equal(result.rectified.left, outcome.rectified.left)
    assert abs(float(result.depth.measured.mean()) - float(outcome.depth.measured.mean())) < 0.1
    both = result.depth.measured & outcome.depth.measured
    assert np.median(np.abs(result.depth.disparity - outcome.depth.disparity)[both]) < 0.2
    assert result.shown.shape == result.depth.disparity.shape            # people see the shot without the pattern
    assert result.shown.mean() < 0.6 * outcome.rectified.left.mean()
    assert outcome.shown is None
    sync = result.result.sync
    assert [shot.projector for shot in sync.shots] == [True, True, False]
    assert (sync.skew_us, sync.resends) == (-80.0, 3)          # the worst pair's, and all of them


def test_a_recording_of_several_shots_gives_the_same_bytes(several, tmp_path):
    live = pipeline.run(several).result
    recording.save(tmp_path / "cycle", several, live)
    inputs, _ = recording.load(tmp_path / "cycle")
    assert pipeline.run(inputs).result.timeless_bytes() == live.timeless_bytes()


def test_a_later_shot_older_than_its_trigger_stops_the_poses(several):
    first, last = several.more
    stale = replace(last, left=replace(last.left, received_ns=last.left.triggered_ns))
    assert set(pipeline.run(replace(several, more=(first, stale))).result.stopped) == {"older_than_trigger"}


def test_every_grasp_of_two_tools_says_which_it_is_for_and_only_fingers_open(paper):
    tools = (SuctionTool(number=3), TwoFingerTool(number=8, kind="two_finger", approach_m=0.06))
    for chosen in (tools, tools[1:]):
        job = paper.inputs.job.model_copy(update={"tools": chosen})
        result = pipeline.run(replace(paper.inputs, job=job, request=Request(frame="bin", max_grasps=20))).result
        kinds = {tool.number: tool.kind for tool in chosen}
        assert {g.tool.number for g in result.grasps} == set(kinds)
        for grasp in result.grasps:
            assert grasp.tool.kind == kinds[grasp.tool.number]
            assert (grasp.tool.kind == "suction") == (grasp.open_m == grasp.close_m == 0)
            assert grasp.open_m >= grasp.close_m
            assert grasp.approach_m == (0.08 if grasp.tool.number == 3 else 0.06)
            assert grasp.clearance_m >= job.recipe.limits.margin_m
        assert [g.quality for g in result.grasps] == sorted((g.quality for g in result.grasps), reverse=True)
        verdicts = [score.judge(paper.scene, pose(g), job.tool_numbered(g.tool.number), g.open_m, g.close_m)
                    for g in result.grasps[:3] if g.tool.number == 8]
        assert all(v.ok for v in verdicts), [v.reason for v in verdicts]
