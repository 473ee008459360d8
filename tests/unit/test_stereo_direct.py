"""A projector nobody calibrated is found from what most points say; what is seen in a mirror does not fit it."""

import numpy as np
import pytest

from binpick.stereo import direct

CAMERA = np.array([[0.9, 0.02, -0.45, 120.0], [-0.01, 0.92, 0.2, 60.0], [1e-5, -2e-5, 3e-5, 1.3]])
"""Column, row and disparity to the projector's column and row."""


def scene(count: int = 3000, seed: int = 0, noise_px: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """Points of a heap, and where in the projector's picture their light comes from, rows in whole pixels."""
    rng = np.random.default_rng(seed)
    points = np.stack([rng.uniform(0, 1400, count), rng.uniform(0, 1000, count), rng.uniform(250, 330, count)], axis=-1)
    seen = np.concatenate([points, np.ones((count, 1))], axis=1) @ CAMERA.T
    places = seen[:, :2] / seen[:, 2:]
    places[:, 0] += rng.normal(0, noise_px, count)
    places[:, 1] = np.floor(places[:, 1])
    return points, places


@pytest.mark.parametrize("share", [0.0, 0.1, 0.35])
def test_points_off_by_more_than_their_noise_are_told_apart(share: float) -> None:
    points, places = scene()
    mirrored = np.arange(len(points)) < share * len(points)
    points[mirrored, 2] -= np.linspace(4, 40, mirrored.sum())
    seen = direct.seen(points, places)
    assert seen[~mirrored].mean() > 0.97
    assert seen[mirrored].sum() <= 0.02 * len(points)


def test_what_lies_close_to_its_mirror_is_as_good_as_direct() -> None:
    points, places = scene()
    points[:300, 2] -= 0.3
    assert direct.seen(points, places)[:300].mean() > 0.9


def test_a_plane_alone_is_all_direct() -> None:
    points, places = scene()
    points[:, 2] = 280 + points[:, 0] / 100 + points[:, 1] / 80
    seen = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ CAMERA.T
    places = np.stack([seen[:, 0] / seen[:, 2], np.floor(seen[:, 1] / seen[:, 2])], axis=-1)
    assert direct.seen(points, places).mean() > 0.97


@pytest.mark.parametrize("count", [0, 1, 50])
def test_too_few_points_tell_nothing(count: int) -> None:
    points, places = scene(count)
    assert direct.seen(points, places).all()


def test_chaos_is_not_trusted_to_condemn() -> None:
    rng = np.random.default_rng(1)
    points, places = rng.uniform(0, 1000, (500, 3)), rng.uniform(0, 1000, (500, 2))
    assert direct.seen(points, places).all()


def test_the_same_points_give_the_same_answer() -> None:
    points, places = scene(noise_px=0.5)
    assert np.array_equal(direct.seen(points, places), direct.seen(points, places))
