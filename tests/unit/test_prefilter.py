"""Pre-filters are judged by what they do to noise, to weak contrast and to edges."""

import numpy as np
import pytest

from binpick.stereo.prefilter import prefilter


def stepped(noise: float, low: int = 60, high: int = 180) -> np.ndarray:
    image = np.full((96, 128), low, dtype=np.float64)
    image[:, 64:] = high
    return np.clip(image + np.random.default_rng(1).normal(0, noise, image.shape), 0, 255).astype(np.uint8)


def test_none_leaves_the_image_alone():
    image = stepped(5)
    assert prefilter(image, "none") is image
    assert image.flags.writeable


@pytest.mark.parametrize("kind", ["gaussian", "clahe", "bilateral"])
def test_the_image_stays_as_it_is_and_the_result_is_a_new_value(kind):
    image = stepped(5)
    before = image.copy()
    filtered = prefilter(image, kind)
    assert (image == before).all()
    assert filtered.shape == image.shape
    assert not filtered.flags.writeable


def test_gaussian_lowers_noise():
    image = stepped(8)
    assert prefilter(image, "gaussian")[:, :56].std() < 0.75 * image[:, :56].std()


def test_bilateral_lowers_noise_and_keeps_the_edge():
    image = stepped(4)
    filtered = prefilter(image, "bilateral").astype(int)
    assert filtered[:, :56].std() < 0.6 * image[:, :56].std()
    step = filtered[:, 64].mean() - filtered[:, 63].mean()
    blurred = prefilter(image, "gaussian").astype(int)
    assert step > 110 > blurred[:, 64].mean() - blurred[:, 63].mean()


def test_clahe_raises_weak_contrast_locally():
    image = stepped(2, low=100, high=110)
    assert prefilter(image, "clahe")[:, :56].std() > 1.5 * image[:, :56].std()
