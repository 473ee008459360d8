"""Round bars: a part's points tell the axis that a lip's own plane misses."""

import numpy as np
import pytest

from binpick.grasp.bars import bar

RADIUS_M, LENGTH_M, NOISE_M = 0.012, 0.06, 0.0003
MIDDLE = np.array([0.03, -0.02, 0.015])


def seen_from_above(axis, half_angle_rad=1.2, aside_rad=0.0):
    """Points and normals of the upper side of a bar along `axis`, more of it to one side than to the other."""
    rng = np.random.default_rng(1)
    axis = np.array(axis) / np.linalg.norm(axis)
    up = np.array([0, 0, 1.0]) - axis * axis[2]
    up /= np.linalg.norm(up)
    angle = aside_rad + rng.uniform(-half_angle_rad, half_angle_rad, 900)
    normals = np.cos(angle)[:, None] * up + np.sin(angle)[:, None] * np.cross(axis, up)
    along = rng.uniform(-LENGTH_M / 2, LENGTH_M / 2, 900)
    return MIDDLE + along[:, None] * axis + (RADIUS_M + rng.normal(0, NOISE_M, 900))[:, None] * normals, normals


@pytest.mark.parametrize("axis", [(1, 0, 0), (0.3, 0.9, 0.0), (0.6, -0.5, 0.4)])
@pytest.mark.parametrize("aside_rad", [0.0, 0.25])
def test_a_bar_has_its_axis(axis, aside_rad):
    found = bar(*seen_from_above(axis, 0.95, aside_rad))
    assert found is not None
    direction = np.array(axis) / np.linalg.norm(axis)
    assert abs(found.axis @ direction) > np.cos(np.radians(1))
    off = np.cross(found.middle - MIDDLE, direction)
    assert np.linalg.norm(off) < 0.0006


def test_outwards_is_away_from_the_axis():
    points, normals = seen_from_above((1, 0, 0))
    away = bar(points, normals).outwards(points)
    assert np.degrees(np.arccos(np.clip(np.einsum("nc,nc->n", away, normals), -1, 1))).max() < 3


def test_a_flat_face_is_no_bar():
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(-0.03, 0.03, 900), rng.uniform(-0.01, 0.01, 900), rng.normal(0, NOISE_M, 900)])
    normals = np.array([0, 0, 1.0]) + rng.normal(0, 0.03, (900, 3))
    assert bar(points, normals / np.linalg.norm(normals, axis=1, keepdims=True)) is None


def test_two_sides_of_a_roof_are_no_bar():
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-0.012, 0.012, 900), rng.uniform(-0.03, 0.03, 900)
    points = np.column_stack([x, y, -np.abs(x) * 1.0])
    normals = np.column_stack([np.sign(x), np.zeros(900), np.ones(900)]) / np.sqrt(2)
    assert bar(points, normals) is None


def test_points_that_no_circle_comes_near_are_no_bar():
    rng = np.random.default_rng(4)
    x, z = np.tile([-0.02, 0.02, 0.0, 0.0], 225), np.tile([0.0, 0.0, 0.02, -0.03], 225)
    normals = np.column_stack([rng.normal(0, 0.3, 900), np.zeros(900), np.ones(900)])
    points = np.column_stack([x, rng.uniform(-0.02, 0.02, 900), z])
    assert bar(points, normals / np.linalg.norm(normals, axis=1, keepdims=True)) is None


def test_a_standing_bar_shows_no_side():
    assert bar(*seen_from_above((0.1, 0.0, 1.0))) is None
