"""The classics find planted shifts."""

import cv2
import numpy as np
import pytest

from binpick.data import Rectified, Window
from binpick.lab import classics


def pair(shift: float, gain: float = 1.0) -> Rectified:
    """A random texture seen by both views, `shift` px apart beyond 40; the right view `gain` times as bright."""
    texture = cv2.GaussianBlur(np.random.default_rng(3).uniform(0, 255, (60, 240)).astype(np.float32), (0, 0), 1.0)
    texture = 3 * (texture - texture.mean()) + 110
    u, v = np.meshgrid(np.arange(132, dtype=np.float32), np.arange(60, dtype=np.float32))
    left, right = (cv2.remap(texture, u + 40 + du, v, cv2.INTER_CUBIC) for du in (0.0, shift))
    left, right = (np.clip(image, 0, 255).astype(np.uint8) for image in (left, gain * right))
    return Rectified(left, right, Window(0, 0, 100, 60, 40, 32), 32, 1000.0, 0.1, 50.0, 30.0, np.eye(4))


@pytest.mark.parametrize("costs", [classics.ssd, classics.ncc])
@pytest.mark.parametrize("shift", [3.0, 12.25, 29.5])
def test_a_planted_shift_is_found_between_pixels(costs, shift):
    found = classics.match(pair(shift), costs, 9)
    assert found.shape == (60, 100)
    assert np.median(np.abs(found - (40 + shift))[5:-5, 5:-5]) < 0.05


def test_correlation_does_not_mind_another_brightness():
    dimmed = pair(12.0, gain=0.3)
    by_ssd, by_ncc = (np.abs(classics.match(dimmed, costs, 9) - 52)[5:-5, 5:-5] > 1 for costs in (classics.ssd, classics.ncc))
    assert by_ncc.mean() < 0.01
    assert by_ssd.mean() > 0.2


def test_the_winner_lies_where_the_parabola_is_lowest_and_is_whole_at_the_ends_of_the_range():
    lowest = np.array([[1.25, 2.0, 0.0, 3.0]])
    costs = (np.float32((k - lowest) ** 2) for k in range(4))
    assert classics.winner(costs).tolist() == [[1.25, 2.0, 0.0, 3.0]]
    flat = (np.ones((1, 2), dtype=np.float32) for _ in range(3))
    assert classics.winner(flat).tolist() == [[0.0, 0.0]]
