"""Poses by CAD: laws of motion and symmetry on ray-cast segments, what is refused, and a rendered bin end to end."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import open3d as o3d
import pytest
from scipy.spatial.transform import Rotation

from binpick import geometry, pipeline, recording
from binpick.data import Segments
from binpick.errors import InputError
from binpick.grasp import cad, shape, sight
from binpick.grasp.solid import Solid
from binpick.lab import poses
from binpick.settings.mesh import Axis, Mesh, TaughtGrasp
from binpick.sim import exam
from binpick.sim.mesh import Caster, part_mesh
from binpick.sim.world import ScenePart, WorldScene

ROOM = (np.array([-0.3, -0.2, -0.0025]), np.array([0.3, 0.2, np.inf]))
FOCAL_PX, SIDE_PX = 870.0, 240
LYING = geometry.make(Rotation.from_euler("zyx", [0.7, 0.25, 0.1]).as_matrix(), np.array([0.02, 0.01, 0.05]))


@dataclass(frozen=True)
class Scene:
    """What a camera 1 m above the bin sees of some parts, without noise: every part one segment."""

    segments: Segments
    seen: sight.Sight


@pytest.fixture(scope="module")
def look():
    def make(*parts) -> Scene:
        scene = WorldScene("A", tuple(ScenePart(i, kind, T) for i, (kind, T) in enumerate(parts, start=1)), 1, 1)
        T_bin_rect = geometry.make(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 1.0]))
        u, v = np.meshgrid(*[np.arange(SIDE_PX) - (SIDE_PX - 1) / 2] * 2)
        rays = geometry.rotate(T_bin_rect, np.stack([u / FOCAL_PX, v / FOCAL_PX, np.ones_like(u)], axis=-1).reshape(-1, 3))
        origin = np.broadcast_to(T_bin_rect[:3, 3], rays.shape)
        hits = Caster(scene).cast(np.concatenate([origin, rays], axis=1).astype(np.float32))
        xyz = (origin + rays * hits.distance[:, None]).astype(np.float32)
        towards = np.sign(-np.einsum("ni,ni->n", hits.normal, rays))[:, None]
        labels = np.maximum(hits.part_id, 0).astype(np.int32)
        grid = (SIDE_PX, SIDE_PX)
        segments = Segments(
            xyz=xyz.reshape(*grid, 3), normal=(hits.normal * towards).astype(np.float32).reshape(*grid, 3),
            faces=labels.reshape(grid), parts=labels.reshape(grid),
            part_points={int(i): xyz[labels == i] for i in np.unique(labels[labels > 0])},
            part_confidence={int(i): 1.0 for i in np.unique(labels[labels > 0])})
        depth = geometry.transform(geometry.inverse(T_bin_rect), segments.xyz)[..., 2]
        centre = ((SIDE_PX - 1) / 2, (SIDE_PX - 1) / 2)
        return Scene(segments, sight.Sight(np.ascontiguousarray(depth), segments.parts, geometry.inverse(T_bin_rect),
                                           FOCAL_PX, centre))

    return make


@pytest.fixture(scope="module")
def models():
    return {kind: shape.of(solid(kind)) for kind in ("block", "bracket", "cylinder", "bolt")}


def solid(kind):
    mesh = part_mesh(kind)
    return Solid(np.asarray(mesh.vertices, dtype=np.float64), mesh.triangles.astype(np.int64))


def stl(path, vertices, triangles):
    corners, faces = o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(triangles.astype(np.int32))
    mesh = o3d.geometry.TriangleMesh(corners, faces)
    mesh.compute_triangle_normals()
    assert o3d.io.write_triangle_mesh(path, mesh)
    return path


def locate(model, scene, most=8):
    order = sorted(scene.segments.part_points, key=lambda label: -len(scene.segments.part_points[label]))
    return cad.locate(model, scene.seen, scene.segments, order, most, ROOM)


def test_the_pose_goes_where_the_part_goes(models, look):
    moved = geometry.make(Rotation.from_euler("z", 2.1).as_matrix(), np.array([-0.03, 0.02, 0.02]))
    for T in (LYING, moved @ LYING):
        (part,) = locate(models["bracket"], look(("bracket", T)))
        assert part.T_bin_part is not None
        assert poses.mssd_m(part.T_bin_part, T, models["bracket"]) < 0.0015
        assert part.score > 0.8


def test_parts_that_look_alike_get_the_same_pose(models, look):
    turned = geometry.make(models["block"].symmetry.turns[2], np.zeros(3))
    (one,), (other,) = (locate(models["block"], look(("block", T))) for T in (LYING, LYING @ turned))
    assert np.allclose(one.T_bin_part, other.T_bin_part, atol=5e-4)


@pytest.mark.parametrize("kind", ["block", "bracket", "cylinder", "bolt"])
def test_symmetric_rotations_have_one_canonical_form(models, kind):
    symmetry = models[kind].symmetry
    for R in Rotation.from_rotvec([[0.3, -0.2, 1.1], [2.0, 0.4, -0.5], [-0.1, 0.1, 0.05]]).as_matrix():
        forms = np.stack([symmetry.canonical(R @ S) for S in symmetry.sampled])
        assert np.abs(forms - forms[0]).max() < 0.02
        assert np.trace(forms[0]) >= max(np.trace(R @ S) for S in symmetry.sampled) - 1e-3


def test_symmetries_are_found_or_given(models):
    assert [len(models[kind].symmetry.turns) for kind in ("block", "bracket", "bolt")] == [4, 1, 6]
    cylinder = models["cylinder"].symmetry
    assert cylinder.axis is not None
    assert abs(cylinder.axis[2]) > 0.9999
    assert len(cylinder.turns) == 2
    given = shape.of(solid("block"), (Axis(axis=(0, 0, 2), fold=2),)).symmetry
    assert len(given.turns) == 2
    assert len(shape.of(solid("block"), ()).symmetry.turns) == 1


@pytest.mark.parametrize(("mesh", "there"), [("block", "cylinder"), ("bracket", "block"), ("cylinder", "block"),
                                             ("bolt", "bracket")])
def test_another_part_is_not_taken_for_it(models, look, mesh, there):
    (part,) = locate(models[mesh], look((there, geometry.make(LYING[:3, :3], np.array([0.0, 0.0, 0.06])))))
    assert part.T_bin_part is None


def test_a_part_in_two_pieces_is_one_part(models, look):
    scene = look(("block", LYING))
    split = scene.segments.parts.copy()
    split[(split == 1) & (scene.segments.xyz[..., 0] > 0.035)] = 2
    points = {i: scene.segments.xyz[split == i] for i in (1, 2)}
    parted = Scene(replace(scene.segments, parts=split, part_points=points), replace(scene.seen, parts=split))
    (part,) = locate(models["block"], parted)
    assert part.part_ids == (1, 2)
    assert poses.adds_m(part.T_bin_part, LYING, models["block"]) < 0.002


def test_only_so_many_are_looked_for(models, look):
    shift = geometry.translation(0.07, 0.0, 0.0)
    scene = look(("block", LYING), ("block", shift @ LYING))
    assert len(locate(models["block"], scene, 1)) == 1
    assert len(locate(models["block"], scene, 2)) == 2


def test_units_say_the_same_part(tmp_path):
    mesh = part_mesh("block")
    in_mm, in_m = (shape.load(Mesh(file=stl(tmp_path / f"{unit}.stl", mesh.vertices * factor, mesh.triangles), unit=unit))
                   for unit, factor in (("mm", 1000), ("m", 1)))
    assert in_mm.size_m == pytest.approx(0.060, abs=1e-6)
    assert in_m.size_m == pytest.approx(0.060, abs=1e-6)


@pytest.mark.parametrize("ending", ["stl", "obj", "ply"])
def test_a_mesh_inside_out_is_turned(tmp_path, ending):
    mesh = part_mesh("block")
    path = stl(tmp_path / f"part.{ending}", mesh.vertices * 1000, mesh.triangles[:, ::-1])
    model = shape.load(Mesh(file=path, unit="mm", symmetry=()))
    assert model.field.at(np.zeros((1, 3), np.float32))[0][0] == pytest.approx(-0.0075, abs=3e-4)


def test_a_wrong_unit_is_refused_with_the_right_one(tmp_path):
    mesh = part_mesh("block")
    path = stl(tmp_path / "part.stl", mesh.vertices * 1000, mesh.triangles)
    with pytest.raises(InputError, match=r"part\.stl: with unit: m its largest side is .*unit: mm would make it 60 mm"):
        shape.load(Mesh(file=path, unit="m"))


def test_an_open_mesh_is_refused(tmp_path):
    mesh = part_mesh("block")
    path = stl(tmp_path / "part.stl", mesh.vertices * 1000, mesh.triangles[1:])
    with pytest.raises(InputError, match="the mesh is not closed: 3 of its edges"):
        shape.load(Mesh(file=path, unit="mm"))


def test_a_sheet_with_two_sides_is_refused(tmp_path):
    corners = np.array([[0.0, 0, 0], [50, 0, 0], [50, 40, 0], [0, 40, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [2, 1, 0], [3, 2, 0]])
    path = stl(tmp_path / "sheet.stl", corners, faces)
    with pytest.raises(InputError, match="the mesh has no volume"):
        shape.load(Mesh(file=path, unit="mm"))


def test_what_is_no_mesh_is_refused(tmp_path):
    (tmp_path / "text.stl").write_text("nothing")
    with pytest.raises(InputError, match="holds no triangles"):
        shape.load(Mesh(file=tmp_path / "text.stl", unit="mm"))
    with pytest.raises(InputError, match="cannot be read"):
        shape.load(Mesh(file=tmp_path / "missing.stl", unit="mm"))


@pytest.fixture(scope="module")
def bin_of_brackets(photograph):
    flat = geometry.translation(0.05, 0.02, 0.015)
    leaning = geometry.make(Rotation.from_euler("zy", [1.0, 0.0]).as_matrix(), np.array([-0.06, -0.03, 0.015]))
    parts = (("bracket", flat), ("bracket", leaning), ("block", geometry.translation(-0.05, 0.05, 0.0075)))
    return photograph(parts), {1: flat, 2: leaning}


@pytest.fixture(scope="module")
def bracket_file(tmp_path_factory):
    return poses.written(tmp_path_factory.mktemp("meshes"), "bracket")


@pytest.fixture(scope="module")
def model(bracket_file):
    return shape.load(Mesh(file=bracket_file, unit="mm"))


@pytest.fixture(scope="module")
def posed(bin_of_brackets, bracket_file):
    inputs = poses.by_mesh(bin_of_brackets[0], Mesh(file=bracket_file, unit="mm"))
    return inputs, pipeline.run(inputs)


def test_a_rendered_bin_has_its_poses(bin_of_brackets, posed, model):
    found = [part for part in posed[1].result.parts if part.T_frame_part is not None]
    given = [poses.judged(part, bin_of_brackets[1], model) for part in found]
    assert {each.part_id for each in given} == {1, 2}
    assert len(given) == 2, "the block is none of them"
    assert max(each.adds_m for each in given) < 0.001
    assert {part.label for part in found} == {"bracket"}


def test_poses_do_not_change_the_grasps(bin_of_brackets, posed):
    plain = pipeline.run(bin_of_brackets[0]).result
    assert plain.grasps == posed[1].result.grasps
    assert not plain.parts
    assert "pose" in posed[1].result.timing_ms
    ranked = list(dict.fromkeys(grasp.part_id for grasp in plain.grasps))
    assert [part.id for part in posed[1].result.parts][:len(ranked)] == ranked


def test_a_recording_with_a_mesh_gives_the_same_bytes(posed, tmp_path):
    recording.save(tmp_path / "cycle", posed[0], posed[1].result)
    inputs, stored = recording.load(tmp_path / "cycle")
    assert pipeline.run(inputs).result.timeless_bytes() == stored.timeless_bytes()


def test_one_thread_gives_the_same_poses(posed):
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        assert pipeline.run(posed[0]).result.timeless_bytes() == posed[1].result.timeless_bytes()
    finally:
        cv2.setNumThreads(threads)


def test_frames_tell_the_same_part(posed):
    inputs, outcome = posed
    request = inputs.request.model_copy(update={"frame": "camera"})
    there = pipeline.run(replace(inputs, request=request)).result.parts
    for one, other in zip(outcome.result.parts, there, strict=True):
        if one.T_frame_part is not None:
            expected = inputs.job.bin.T_parent_bin @ matrix(one.T_frame_part)
            assert np.allclose(matrix(other.T_frame_part), expected, atol=1e-9)


def test_taught_grasps_are_taken_to_every_part(bin_of_brackets, bracket_file):
    # from above onto the plate, where nothing would be found by itself: 10 mm beside its middle
    down = TaughtGrasp.model_validate({"tool": 1, "T_part_tcp": {"position_m": [0.01, 0.006, -0.011],
                                                                 "rotvec_rad": [3.14159265358979, 0, 0]}})
    inputs = poses.by_mesh(bin_of_brackets[0], Mesh(file=bracket_file, unit="mm", grasps=(down,)))
    result = pipeline.run(inputs).result
    assert result.funnel.counts["taught"] == 2
    wanted = [matrix(part.T_frame_part) @ down.T_part_tcp.T_parent_this for part in result.parts if part.T_frame_part]
    near = [min(np.linalg.norm(np.array(grasp.position_m) - T[:3, 3]) for grasp in result.grasps) for T in wanted]
    assert min(near) < 1e-9, "beside grasps that were found on the same part"


def test_two_fingers_are_taught_too(bin_of_brackets, bracket_file):
    # the upright wall between the pads, from above
    grip = TaughtGrasp.model_validate({"tool": 1, "open_m": 0.02, "close_m": 0.004, "T_part_tcp": {
        "position_m": [-0.023, 0.0, 0.006], "rotvec_rad": [3.14159265358979, 0, 0]}})
    inputs = poses.by_mesh(bin_of_brackets[0], Mesh(file=bracket_file, unit="mm", grasps=(grip,)))
    tools = exam.cell("B", tools=[{"kind": "two_finger"}]).tools
    result = pipeline.run(replace(inputs, job=inputs.job.model_copy(update={"tools": tools}))).result
    wanted = {part.id: matrix(part.T_frame_part) @ grip.T_part_tcp.T_parent_this for part in result.parts if part.T_frame_part}
    taken = [grasp for grasp in result.grasps if grasp.part_id in wanted
             and np.linalg.norm(np.array(grasp.position_m) - wanted[grasp.part_id][:3, 3]) < 1e-9]
    assert taken
    assert (taken[0].open_m, taken[0].close_m) == (0.02, 0.004)


def matrix(pose):
    return geometry.from_quaternion(np.array(pose.position_m), np.array(pose.quaternion_xyzw))


def test_the_exam_has_a_mesh_of_every_kind():
    assert set(poses.BINS) == {*exam.MIXTURES["mixed"], "mixed"}
