"""Depth inside solids, and of a tool along its motion."""

import numpy as np
import pytest

from binpick import geometry
from binpick.settings import Box, SuctionTool
from binpick.sim import exam, mesh
from binpick.sim.collision import Prism, Surroundings, _pieces
from binpick.sim.world import ScenePart, WorldScene

DOWN, ALONG = np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0])


def at(x, y, z, axis=DOWN):
    return geometry.frame_of_axes(np.asarray(axis, dtype=float), ALONG, np.array([x, y, z], dtype=float))


@pytest.mark.parametrize("prism", [Prism("box", (0.06, 0.04, 0.015)), Prism("cylinder", (0.024, 0.024, 0.06)),
                                   Prism("hexagon", (0.019, 0.019, 0.0075))])
def test_depth_is_nothing_on_the_surface_and_half_the_thinnest_side_in_the_middle(prism):
    assert np.abs(prism.depth(prism.surface())).max() < 2e-4
    assert prism.depth(np.zeros((1, 3)))[0] == pytest.approx(min(prism.size_m) / 2)
    assert prism.depth(np.array([[0.1, 0.0, 0.0]]))[0] < 0


@pytest.mark.parametrize("kind", exam.MIXTURES["mixed"])
def test_solids_and_triangles_are_the_same_shape(kind):
    corners = mesh.part_mesh(kind).vertices
    depths = [prism.depth(geometry.transform(geometry.inverse(T), corners)) for prism, T in _pieces(kind)]
    assert np.max(depths, axis=0).min() > -1e-9


def test_a_free_way_down_to_the_floor_is_clear():
    assert Surroundings(WorldScene("A", (), 1, 1)).penetration(at(0, 0, 0), SuctionTool()) == 0


def test_a_wall_and_the_floor_are_in_the_way():
    empty = Surroundings(WorldScene("A", (), 1, 1))
    length = exam.setup("A").bin_size_m[0]
    # the holder's radius is 12 mm
    assert empty.penetration(at(length / 2 - 0.009, 0, 0), SuctionTool()) == pytest.approx(0.003, abs=3e-4)
    # its lowest body ends 2 mm above the TCP
    assert empty.penetration(at(0, 0, -0.005), SuctionTool()) == pytest.approx(0.003, abs=1e-6)


def test_a_corner_thinner_than_the_samples_of_a_body_is_found():
    spike = geometry.frame_of_axes(np.array([1.0, 1.0, 1.0]), ALONG, np.array([0.0, 0.0, 0.05]))
    around = Surroundings(WorldScene("A", (ScenePart(1, "block", spike),), 1, 1))
    top = (mesh.part_mesh("block").vertices @ spike[:3, :3].T + spike[:3, 3])[:, 2].argmax()
    x, y, z = (mesh.part_mesh("block").vertices @ spike[:3, :3].T + spike[:3, 3])[top]
    plate = SuctionTool(bodies=(Box(shape="box", size_m=(0.1, 0.1, 0.02), T_tcp_body={"position_m": (0, 0, -0.01)}),))
    assert around.penetration(at(x + 0.0013, y + 0.0011, z - 0.002), plate) == pytest.approx(0.002, abs=1e-6)


def test_the_way_out_is_straight_up():
    beside = ScenePart(1, "block", geometry.translation(0.0, 0.0, 0.06))
    around = Surroundings(WorldScene("A", (beside,), 1, 1))
    # slipped in slantwise under the block: the way in is clear of it, the lift is not
    slant = at(0.0, 0.0, 0.02, [-0.98, 0.0, -0.2])
    short = SuctionTool(bodies=(Box(shape="box", size_m=(0.01, 0.01, 0.01), T_tcp_body={"position_m": (0, 0, -0.01)}),))
    assert around.penetration(slant, short.model_copy(update={"lift_m": 0.01})) == 0
    assert around.penetration(slant, short) > 0.004
