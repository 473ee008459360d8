"""Tool bodies from CAD files: read as their hull or refused in a sentence, and kept clear of things as boxes are."""

import numpy as np
import open3d as o3d
import pytest

from binpick import geometry, settings
from binpick.errors import SettingsError
from binpick.grasp import clearance, rank, suction
from binpick.scene import heightmap, segment
from binpick.scene.surface import surface
from binpick.settings import Box, Mesh, SuctionTool
from binpick.settings.base import Placement
from binpick.sim.collision import Surroundings
from binpick.sim.world import ScenePart, WorldScene
from binpick.stereo import cloud

SIZE_M = (0.05, 0.03, 0.04)
ABOVE = Placement(position_m=(0.01, 0.0, -0.03))
CELL = """
bin: {{inner_size_m: [0.3, 0.2, 0.1], pose: {{position_m: [0, 0, 1]}}}}
gripper: {{bodies: [{{shape: mesh, file: {file}, unit: {unit}, T_tcp_body: {{position_m: [0.01, 0, -0.03]}}}}]}}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A box in millimetres, and the same as a flat sheet."""
    there = tmp_path_factory.mktemp("cad")
    box = o3d.geometry.TriangleMesh.create_box(*(1000 * side for side in SIZE_M)).translate(-500 * np.array(SIZE_M))
    box.compute_triangle_normals()
    for name in ("box.stl", "box.obj", "box.ply"):
        assert o3d.io.write_triangle_mesh(str(there / name), box)
    sheet = o3d.geometry.TriangleMesh(box)
    sheet.vertices = o3d.utility.Vector3dVector(np.asarray(box.vertices) * [1, 1, 0])
    assert o3d.io.write_triangle_mesh(str(there / "flat.ply"), sheet)
    (there / "empty.stl").write_text("nothing of a mesh\n")
    return there


def loaded(folder, file, unit="mm"):
    (folder / "cell.yaml").write_text(CELL.format(file=file, unit=unit))
    return settings.load(folder / "cell.yaml")


@pytest.fixture(scope="module")
def tool(folder):
    return loaded(folder, "box.stl").tools[0]


BOX = SuctionTool(bodies=(Box(shape="box", size_m=SIZE_M, T_tcp_body=ABOVE),))


@pytest.mark.parametrize("file", ["box.stl", "box.obj", "box.ply"])
def test_a_cad_file_becomes_its_corners_in_metres(folder, file):
    [body] = loaded(folder, file).tools[0].bodies
    half = np.array(SIZE_M) / 2
    assert np.allclose(body.corners_m, sorted(map(tuple, geometry.box_corners(-half, half).tolist())), atol=2e-6)
    assert loaded(folder, file).tools[0].bodies == (body,), "the same file gives the same settings"


@pytest.mark.parametrize(("file", "unit", "fault"), [
    ("none.stl", "mm", "there is no such file"), ("empty.stl", "mm", "not readable"), ("flat.ply", "mm", "flat"),
    ("box.stl", "m", "is `unit` right"),
])
def test_a_file_that_cannot_be_a_tool_is_refused(folder, file, unit, fault):
    with pytest.raises(SettingsError, match=fault):
        loaded(folder, file, unit)


def test_a_recorded_job_holds_the_tool_without_its_file(folder):
    job = settings.resolve(loaded(folder, "box.stl"))
    again = settings.Job.model_validate_json(job.model_dump_json())
    assert again == job
    assert len(again.tool.bodies[0].corners_m) == 8


def test_a_mesh_that_was_never_read_is_not_taken_for_free():
    body = Mesh(shape="mesh", file="box.stl", unit="mm")
    with pytest.raises(SettingsError, match="was not read"):
        _ = body.corners_m


def test_a_mesh_keeps_clear_as_a_box_of_its_size_does(plant, slab, tool):
    planted = plant([slab(0.0, 0.0, 0.06, 0.04, 0.02), slab(0.055, 0.0, 0.03, 0.05, 0.06)])
    points = cloud.reproject(planted.depth, planted.rectified)
    heights = heightmap.height_map(geometry.transform(planted.T_bin_camera, points.xyz), planted.job.bin)
    grid = surface(planted.depth, planted.rectified, planted.T_bin_camera)
    segments = segment.segment(grid, planted.job.bin, planted.job.recipe.part, planted.job.recipe.segment)
    grasps = rank.ordered(suction.candidates(segments, BOX, grid.sigma_z_m)[0], segments, BOX)
    scene = clearance.obstacles(heights, planted.job.bin)
    pairs = [(clearance.clearance(grasp, BOX, scene), clearance.clearance(grasp, tool, scene)) for grasp in grasps]
    inside = [pair for pair in pairs if pair[0] <= 0]
    free = [pair for pair in pairs if pair[0] > 0]
    assert inside
    assert free
    assert np.allclose(*np.transpose(inside), atol=1e-5)
    assert all(0 < mesh_m <= box_m + 1e-5 for box_m, mesh_m in free), "never said to be further away than it is"


def test_a_round_hull_is_held_by_few_planes():
    ball = o3d.geometry.TriangleMesh.create_sphere(0.05, resolution=40)
    planes = geometry.hull_planes(np.asarray(ball.vertices))
    assert len(planes) < 400
    assert (np.asarray(ball.vertices) @ planes[:, :3].T <= planes[:, 3] + 1e-12).all()
    assert np.abs(planes[:, 3] - 0.05).max() < 0.0005
    around = np.random.default_rng(1).normal(size=(2000, 3))
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    reach = (planes[:, 3] / np.maximum(around @ planes[:, :3].T, 1e-9)).min(axis=1)
    assert reach.max() < 0.052, "and hardly larger than it"


def test_the_judge_knows_the_mesh(tool):
    around = Surroundings(WorldScene("A", (ScenePart(1, "block", geometry.translation(0.05, 0.0, 0.03)),), 1, 1))
    for x in (0.0, 0.012):
        down = geometry.frame_of_axes(np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0]), np.array([x, 0.0, 0.02]))
        assert around.penetration(down, tool) == pytest.approx(around.penetration(down, BOX), abs=1e-5)
    assert around.penetration(down, tool) > 0.001
