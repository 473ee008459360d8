"""Bare metal mirrors by the law of reflection, glares where it faces the light, and is otherwise dark."""

import numpy as np
import pytest

from binpick import geometry
from binpick.data import Light
from binpick.sim import exam, mirror
from binpick.sim.mesh import Caster, rounded
from binpick.sim.render import Renderer
from binpick.sim.world import ScenePart, WorldScene

ALONG = np.array([1.0, 0.0, 0.0])
ACROSS = np.array([0.0, 1.0, 0.0])


def leaning(slope, x, z):
    """The pose of a block whose large face looks up, and aside along the bin."""
    return geometry.frame_of_axes(np.array([slope, 0.0, 1.0]), ACROSS, np.array([x, 0.0, z]))


# a block of steel in the middle of the bin; one that faces both it and the projector
STEEL = ScenePart(1, "steel-block", leaning(0.45, 0.0, 0.03))
BESIDE = ScenePart(2, "block", leaning(-0.8, 0.06, 0.07))


@pytest.fixture(scope="module")
def renderer():
    return Renderer(exam.rig("A"), "A")


def pixels(renderer, scene, part_id, index=0):
    """The pixels of a part in the whole picture: rows, columns."""
    renderer.radiance(scene, index, None)
    view = renderer._views[index]
    mine = Caster(scene).cast(view.rays).part_id == part_id
    row, column = np.divmod(np.flatnonzero(mine), view.crop[1].stop - view.crop[1].start)
    return row + view.crop[0].start, column + view.crop[1].start


def test_rays_leave_as_steeply_as_they_came_and_never_into_the_surface():
    up = np.array([[0, 0, 1], [0, 0, 1]], np.float32)
    looking = np.array([[0.6, 0, -0.8], [np.sqrt(1 - 1e-4), 0, -0.01]], np.float32)
    leaning = np.array([[0, 0, 1], [0.1, 0, 1]], np.float32)
    rays, cosine = mirror._bounced(np.zeros((2, 3), np.float32), up, leaning, looking)
    assert rays[0, 3:] == pytest.approx([0.6, 0, 0.8], abs=1e-6)
    assert cosine[0] == pytest.approx(0.8)
    # the second facet leans away from where it is looked at: what it would send into the surface grazes it
    assert rays[1, 5] > -1e-6
    assert np.linalg.norm(rays[:, 3:], axis=1) == pytest.approx(1, abs=1e-6)


def test_a_cylinder_is_round_whatever_its_facets():
    part = ScenePart(1, "steel-cylinder", geometry.frame_of_axes(np.array([0.0, 1.0, 0.2]), ALONG, np.array([0.0, 0.0, 0.02])))
    scene = WorldScene("A", (part,), 1, 1)
    across = np.linspace(-0.011, 0.011, 200)
    origins = geometry.transform(part.T_bin_part, np.column_stack([across, np.full(200, -0.1), np.full(200, 0.01)]))
    down = geometry.rotate(part.T_bin_part, np.array([[0.0, 1.0, 0.0]]))
    rays = np.hstack([origins, np.repeat(down, 200, axis=0)]).astype(np.float32)
    hits = Caster(scene).cast(rays)
    points = rays[:, :3] + rays[:, 3:] * hits.distance[:, None]
    normals = geometry.rotate(geometry.inverse(part.T_bin_part), rounded(scene, points, hits).astype(np.float64))
    assert normals[:, 0] == pytest.approx(across / 0.012, abs=2e-3)
    assert np.abs(normals[:, 2]).max() < 1e-5
    # facets are 3.75 degrees wide: half of that is the most they can be off
    assert 0.9 < np.degrees(np.arccos(np.einsum("ij,ij->i", geometry.rotate(
        geometry.inverse(part.T_bin_part), hits.normal.astype(np.float64)), normals).clip(-1, 1))).max() < 2.0


def test_steel_shows_what_stands_beside_it(renderer):
    changes = []
    for part in (STEEL, ScenePart(1, "block", STEEL.T_bin_part)):
        alone, beside = (WorldScene("A", parts, 1, 1) for parts in ((part,), (part, BESIDE)))
        at = pixels(renderer, beside, 1)
        pattern = [renderer.radiance(scene, 0, 0)[at] for scene in (alone, beside)]
        changes.append(np.abs(pattern[1] - pattern[0]).mean() / pattern[0].mean())
    assert changes[0] > 0.15
    assert changes[0] > 3 * changes[1]


def test_steel_is_dark_under_the_projector_where_it_does_not_glare(renderer):
    contrast = []
    for kind in ("steel-block", "block"):
        scene = WorldScene("A", (ScenePart(1, kind, leaning(0.3, 0.0, 0.03)),), 1, 1)
        picture = renderer.radiance(scene, 0, 0) - renderer.radiance(scene, 0, None)
        contrast.append(picture[pixels(renderer, scene, 1)].std())
    assert contrast[0] < contrast[1] / 2


def test_where_steel_faces_the_light_the_sensor_saturates(renderer):
    T_bin_camera = geometry.inverse(exam.setup("A").T_camera_bin)
    at = np.array([0.0, 0.0, 0.03])
    eye, light = (geometry.transform(T_bin_camera, np.array(p)) - at for p in ((0, 0, 0.0), exam.OPTICS.projector_position_m))
    halfway = eye / np.linalg.norm(eye) + light / np.linalg.norm(light)
    part = ScenePart(1, "steel-block", geometry.frame_of_axes(halfway, ACROSS, at))
    scene = WorldScene("A", (part,), 1, 1)
    row, column = pixels(renderer, scene, 1)
    lit, dark = (renderer.expose(scene, 0, Light(6000.0, 0.0, on), 1)[row, column] for on in (True, False))
    assert (lit == 255).mean() > 0.8
    assert (dark == 255).mean() == 0


def test_a_world_without_metal_has_no_mirrors(renderer):
    scene = WorldScene("A", (BESIDE,), 1, 1)
    renderer.radiance(scene, 0, 0)
    assert renderer._seen[scene.digest, 0].metal is None
    mixed = WorldScene("A", (STEEL, BESIDE), 1, 1)
    renderer.radiance(mixed, 0, 0)
    metal = renderer._seen[mixed.digest, 0].metal
    assert len(metal.pixels) == len(pixels(renderer, mixed, 1)[0])
