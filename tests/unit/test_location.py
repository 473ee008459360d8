"""A bin is located by its rim wherever it may stand, however full, and everything downstream follows it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from binpick import geometry, pipeline, recording
from binpick.errors import Code
from binpick.scene import location
from binpick.sim import exam


def offset(seed: int) -> geometry.Transform:
    """Within the tolerances: 30 mm, 10 mm, 10 degrees about z, 3 about x and y."""
    u = np.random.default_rng([seed, 7]).uniform(-1, 1, 6)
    R = Rotation.from_euler("z", 10 * u[3], degrees=True) * Rotation.from_rotvec(np.radians(3) * np.array([u[4], u[5], 0]))
    return geometry.make(R.as_matrix(), u[:3] * [0.03, 0.03, 0.01])


def strewn(count: int, top_m: float, seed: int = 0) -> list[tuple[str, geometry.Transform]]:
    """Parts at random up to a height, as a pile looks from above."""
    rng = np.random.default_rng(seed)
    length, width, _ = exam.setup("B").bin_size_m
    return [(kind, geometry.make(Rotation.random(rng=rng).as_matrix(), np.array([
        *rng.uniform(-0.5, 0.5, 2) * [length - 0.05, width - 0.05], top_m - rng.uniform(0, 0.04)])))
        for kind in exam.kinds("mixed", count)]


def apart(T_a: geometry.Transform, T_b: geometry.Transform) -> tuple[float, float]:
    """The largest distance of the large bin's corners, metres, and the angle, degrees."""
    corners = geometry.box_corners(np.array([-0.3, -0.2, 0.0]), np.array([0.3, 0.2, 0.18]))
    step = np.linalg.norm(geometry.transform(T_a, corners) - geometry.transform(T_b, corners), axis=1).max()
    angle = Rotation.from_matrix(T_a[:3, :3].T @ T_b[:3, :3]).magnitude()
    return float(step), float(np.degrees(angle))


def pose(message) -> geometry.Transform:
    return geometry.from_quaternion(np.array(message.position_m), np.array(message.quaternion_xyzw))


@pytest.mark.parametrize(("parts", "seed"), [([], 1), (strewn(25, 0.05), 2), (strewn(70, 0.11), 3), (strewn(70, 0.125), 4)],
                         ids=["empty", "some", "full", "overfull"])
def test_a_bin_is_located_to_2_mm_wherever_it_may_stand(photograph, expecting, parts, seed):
    """One depth map, expected from sixteen other places: the whole of the large bin stays within 2 mm and 0.4 degrees."""
    inputs = photograph(parts, seed)
    T_camera_bin = inputs.job.bin.T_parent_bin
    cloud = pipeline.run(expecting(inputs, np.eye(4))).cloud.xyz
    for k in range(16):
        model = expecting(inputs, offset(k)).job.bin
        found = location.locate(cloud, model, model.T_parent_bin)
        assert found.fault is None, found.message
        step, angle = apart(model.T_parent_bin @ found.T_expected_bin, T_camera_bin)
        assert step < 0.002
        assert angle < 0.4


def test_everything_downstream_follows_the_located_bin(photograph, expecting):
    inputs = photograph([("block", geometry.translation(0.05, 0.03, 0.0075))])
    straight, moved = (pipeline.run(i).result for i in (inputs, expecting(inputs, offset(3))))
    assert moved.return_code.code is Code.OK
    assert moved.bin.found
    assert apart(pose(moved.bin.T_camera_bin), inputs.job.bin.T_parent_bin)[0] < 0.002
    # frame `bin` is the located bin's: the same block is gripped at the same place in it
    assert np.allclose(moved.grasps[0].position_m, straight.grasps[0].position_m, atol=0.004)
    assert moved.bin.fill_level == pytest.approx(straight.bin.fill_level, abs=0.005)
    shift = offset(3)[:3, 3]
    assert np.allclose(moved.bin.rim.shift_m, shift, atol=0.002)
    assert min(moved.bin.rim.seen) > 0.5
    assert straight.bin.rim is None


def test_the_located_bin_is_the_same_in_base(photograph, expecting):
    inputs = expecting(photograph([("block", geometry.translation(0.05, 0.03, 0.0075))]), offset(5))
    in_bin, in_base = (pipeline.run(replace(inputs, request=inputs.request.model_copy(update={"frame": frame}))).result
                       for frame in ("bin", "base"))
    T_base_bin = np.array(inputs.rig.T_base_rig) @ pose(in_bin.bin.T_camera_bin)
    assert np.allclose(pose(in_base.grasps[0]), T_base_bin @ pose(in_bin.grasps[0]), atol=1e-9)


def test_a_recording_of_a_located_bin_gives_the_same_bytes(photograph, expecting, tmp_path):
    inputs = expecting(photograph(strewn(25, 0.05), 2), offset(1))
    live = pipeline.run(inputs).result
    recording.save(tmp_path / "cycle", inputs, live)
    again, stored = recording.load(tmp_path / "cycle")
    assert pipeline.run(again).result.timeless_bytes() == stored.timeless_bytes() == live.timeless_bytes()


def test_nothing_measured_is_no_bin(job):
    nothing = np.full((60, 80, 3), np.nan, np.float32)
    found = location.locate(nothing, job.bin, job.bin.T_parent_bin)
    assert found.fault is Code.BIN_NOT_FOUND


def test_a_rim_of_which_one_side_is_hardly_seen_is_enough(photograph, expecting):
    """Parallel to the baseline a rim may vanish; what is left of it must only not speak against the model."""
    inputs = photograph(strewn(25, 0.05), 2)
    model = inputs.job.bin
    cloud = pipeline.run(expecting(inputs, np.eye(4))).cloud.xyz.copy()
    q = geometry.transform(geometry.inverse(model.T_parent_bin), cloud)
    cloud[(q[..., 1] > 0.08) & (q[..., 0] > -0.1)] = np.nan
    found = location.locate(cloud, model, model.T_parent_bin)
    assert found.fault is None
    assert found.seen.there[3] < 0.3
    cloud[q[..., 1] > 0.08] = np.nan
    assert location.locate(cloud, model, model.T_parent_bin).fault is Code.BIN_MISMATCH


@pytest.fixture(scope="module")
def measured(photograph, expecting):
    """Inputs and cloud of a bin with some parts, and of a full one."""
    scenes = [photograph(strewn(25, 0.05), 2), photograph(strewn(70, 0.118), 3)]
    return [(inputs, pipeline.run(expecting(inputs, np.eye(4))).cloud.xyz) for inputs in scenes]


@pytest.mark.parametrize(("T_expected_bin", "code", "says"), [
    (geometry.translation(0.045, 0.0, 0.0), Code.BIN_NOT_FOUND, "too far"),
    (geometry.translation(0.0, -0.045, 0.0), Code.BIN_NOT_FOUND, "too far"),
    (geometry.translation(0.0, 0.0, 0.02), Code.BIN_NOT_FOUND, "20 mm"),
    (geometry.make(Rotation.from_euler("z", 15, degrees=True).as_matrix(), np.zeros(3)), Code.BIN_NOT_FOUND, "15 degrees"),
    (geometry.make(Rotation.from_euler("x", 6, degrees=True).as_matrix(), np.zeros(3)), Code.BIN_MISMATCH, "tilted by"),
    (geometry.make(Rotation.from_euler("y", -6, degrees=True).as_matrix(), np.zeros(3)), Code.BIN_MISMATCH, "tilted by"),
], ids=["x", "y", "z", "yaw", "tilt x", "tilt y"])
def test_a_bin_beyond_the_tolerances_is_refused_and_says_by_how_much(measured, expecting, T_expected_bin, code, says):
    inputs, cloud = measured[0]
    model = expecting(inputs, T_expected_bin).job.bin
    found = location.locate(cloud, model, model.T_parent_bin)
    assert found.fault is code
    assert says in found.message


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_a_bin_of_another_size_is_refused(measured, expecting, factor):
    """By 10 %: 30 and 20 mm. Inside of a full bin a smaller model finds no rim, only parts that go on."""
    for inputs, cloud in measured:
        for size in ((factor, 1.0, 1.0), (1.0, factor, 1.0)):
            for k in range(4):
                model = expecting(inputs, offset(k), size).job.bin
                assert location.locate(cloud, model, model.T_parent_bin).fault in (Code.BIN_MISMATCH, Code.BIN_NOT_FOUND)


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_a_bin_of_another_height_is_told_by_its_floor(measured, expecting, factor):
    inputs, cloud = measured[0]
    rim_is_right = geometry.translation(0.0, 0.0, 0.12 * (factor - 1))
    model = expecting(inputs, rim_is_right, (1.0, 1.0, factor)).job.bin
    found = location.locate(cloud, model, model.T_parent_bin)
    assert found.fault is Code.BIN_MISMATCH
    assert "120 mm below its rim" in found.message
