"""Gauges among measured points: found beside other things, fitted to their size, and what is wrong is told."""

import numpy as np
import pytest

from binpick.errors import InputError
from binpick.rigcheck import gauge
from binpick.rigcheck.rows import Rows
from binpick.rigcheck.verdict import judged

Z_M, RADIUS_M = 0.9, 0.05
CENTRE = np.array([0.05, -0.04, Z_M - RADIUS_M])


def view(sphere: bool = True, noise_m: float = 0.0003, scale: float = 1.0, bend_m: float = 0.0, step: int = 4) -> np.ndarray:
    """What a camera of 1400 px measures of a table at 0.9 m, bent towards its sides, and of a sphere on it; with outliers."""
    noise = np.random.default_rng(3)
    u, v = np.meshgrid(np.arange(-500, 500, step), np.arange(-350, 350, step))
    rays = np.stack([u / 1400, v / 1400, np.ones(u.shape)], axis=-1).reshape(-1, 3)
    table = Z_M - bend_m * (rays[:, 0] / rays[:, 0].max())**2
    z = table.copy()
    if sphere:
        # |t ray − centre| = radius, the nearer t
        a, b = (rays**2).sum(1), rays @ CENTRE
        inside = b**2 - a * (CENTRE @ CENTRE - RADIUS_M**2)
        z = np.where(inside > 0, (b - np.sqrt(np.clip(inside, 0, None))) / a, z)
    z = z + noise.normal(0, noise_m, z.shape)
    wrong = noise.random(z.shape) < 0.02
    z[wrong] += noise.uniform(-0.1, 0.1, int(wrong.sum()))
    return rays * z[:, None] * scale


def test_a_sphere_is_found_and_measured() -> None:
    found = gauge.sphere(view(), RADIUS_M)
    assert found.centre == pytest.approx(CENTRE, abs=0.0003)
    assert found.radius_m == pytest.approx(RADIUS_M, abs=0.0003)
    assert abs(found.radius_m - RADIUS_M) < 3 * found.sigma_m
    assert found.rms_m == pytest.approx(0.00025, rel=0.15)     # noise is along z, and counts square to the sphere


def test_a_wrong_scale_shows_in_a_sphere() -> None:
    # the smaller the noise and the finer the view, the less error of scale it takes to be sure of it
    told = judged(gauge.of_sphere(view(scale=1.02, noise_m=0.00005, step=2), RADIUS_M, Rows()))
    assert told.scale_permille == pytest.approx(20, abs=3)
    assert told.level == "fault"
    assert "The scale is off: distances come out" in told.sentence
    assert "or the sphere is not of the size given" in told.sentence
    coarse = judged(gauge.of_sphere(view(), RADIUS_M, Rows(row_px=0.05, sigma_px=0.01, points=100, off_px=0.05)))
    assert coarse.level == "ok"
    assert coarse.sentence.startswith("Rows off by 0.05 px, scale off by ")
    assert coarse.sentence.endswith("Nothing is wrong, but this sphere is too small to tell the scale.")


def test_without_a_sphere_none_is_found() -> None:
    with pytest.raises(InputError, match="no sphere with a radius of 50 mm"):
        gauge.sphere(view(sphere=False, step=8), RADIUS_M)
    with pytest.raises(InputError, match="no sphere with a radius of 100 mm"):
        gauge.sphere(view(step=8), 0.1)


def test_a_flat_is_found_beside_other_things() -> None:
    found = gauge.flat(view())
    assert found.normal == pytest.approx([0, 0, -1], abs=0.001)
    assert found.bend_m < 0.0001
    assert found.inside.mean() > 0.85
    told = judged(gauge.of_flat(view(), Rows()))
    assert told.level == "ok"
    assert np.isnan(told.scale_permille)


def test_a_flat_that_is_not_flat() -> None:
    told = judged(gauge.of_flat(view(bend_m=0.003), Rows()))
    assert told.bend_m == pytest.approx(0.003, abs=0.0005)
    assert told.level == "warn"
    assert told.sentence.startswith("The flat is bent by ")


def test_no_flat() -> None:
    scattered = np.random.default_rng(1).uniform(-1, 1, (5000, 3)) + np.array([0, 0, 2])
    with pytest.raises(InputError, match="no flat is seen"):
        gauge.flat(scattered)
    with pytest.raises(InputError, match="too few for a flat"):
        gauge.flat(scattered[:50])


def test_the_same_points_give_the_same_answer() -> None:
    points = view()
    once, again = gauge.sphere(points, RADIUS_M), gauge.sphere(points, RADIUS_M)
    assert once.radius_m == again.radius_m
    assert (once.inside == again.inside).all()
