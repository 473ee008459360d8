"""Shots become what is matched: exposures merge without saturation or seam, glare leaves, patterns must agree."""

from dataclasses import replace

import hypothesis.extra.numpy as arrays
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from binpick.data import Depth, Image, Light, Rectified, Window
from binpick.stereo import shots

ROWS, COLS, MARGIN, LOW = 40, 60, 32, 100
LONG, SHORT, PLAIN = Light(6000.0, 0.0, True), Light(1200.0, 0.0, True), Light(6000.0, 0.0, False)


def rectified(left: Image, right: Image | None = None) -> Rectified:
    return Rectified(left, left if right is None else right, Window(5, 7, COLS, ROWS, LOW, MARGIN), MARGIN, 1000.0, 0.1, 50.0,
                     20.0, np.eye(4))


def exposed(radiance: np.ndarray, light: Light) -> Image:
    """Grey levels of a linear sensor without noise; radiance 1 fills 6 ms."""
    return np.clip(np.rint(radiance * 255 * light.exposure_us / 6000 * 10 ** (light.gain_db / 20)), 0, 255).astype(np.uint8)


def ramp(top: float) -> np.ndarray:
    return np.tile(np.linspace(0, top, COLS + MARGIN), (ROWS, 1))


def test_one_shot_is_matched_as_it_is() -> None:
    shot = rectified(exposed(ramp(2.0), LONG))
    taken = shots.combine((shot,), (LONG,))
    assert taken.matched.left is shot.left
    assert taken.matched.right is shot.right
    assert (len(taken.pairs), taken.guide) == (1, None)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_exposures_merge_into_one_rising_scale_without_a_seam(order: tuple[int, int]) -> None:
    radiance = ramp(4.5)
    lights = (LONG, SHORT)
    views = tuple(rectified(exposed(radiance, lights[k])) for k in order)
    merged = shots.combine(views, tuple(lights[k] for k in order)).matched.left
    expected = 255 * np.sqrt(radiance / 5)
    assert np.abs(merged - expected).max() < 6          # five steps of 6 ms are one of 1.2 ms
    assert np.all(np.diff(merged.astype(int), axis=1) >= 0)
    assert merged.max() < 250


def test_gain_counts_as_exposure() -> None:
    brighter = Light(1200.0, 20 * np.log10(5.0), True)
    radiance = ramp(0.7)
    merged = shots.combine((rectified(exposed(radiance, LONG)), rectified(exposed(radiance, brighter))), (LONG, brighter))
    assert np.abs(merged.matched.left - 255 * radiance).max() <= 1.01


def test_both_views_are_mapped_alike() -> None:
    rng = np.random.default_rng(3)
    radiance = rng.uniform(0, 4, (ROWS, COLS + MARGIN))
    shifted = np.roll(radiance, 9, axis=1)
    views = tuple(rectified(exposed(radiance, light), exposed(shifted, light)) for light in (LONG, SHORT))
    pair = shots.combine(views, (LONG, SHORT)).matched
    assert np.array_equal(np.roll(pair.left, 9, axis=1)[:, 12:-3], pair.right[:, 12:-3])


@pytest.mark.parametrize("plain_us", [6000.0, 3000.0])
def test_glare_of_the_plain_light_is_taken_out_and_the_rest_stays(plain_us: float) -> None:
    rng = np.random.default_rng(1)
    ambient, dots = rng.uniform(0.1, 0.2, (ROWS, COLS + MARGIN)), rng.uniform(0, 0.4, (ROWS, COLS + MARGIN))
    glare = np.zeros_like(ambient)
    glare[10:20, 50:60] = 0.4
    plain = replace(PLAIN, exposure_us=plain_us)
    views = (rectified(exposed(ambient + glare + dots, LONG)), rectified(exposed(ambient + glare, plain)))
    taken = shots.combine(views, (LONG, plain))
    usual = np.median(ambient + glare)
    left = np.maximum(ambient + glare - 2 * usual, 0)
    assert np.abs(taken.matched.left - 255 * (ambient + glare + dots - left)).max() <= 4
    assert np.array_equal(taken.matched.left[glare == 0], views[0].left[glare == 0])
    assert taken.guide is views[1].left


def test_patterns_stay_apart_each_with_its_exposures() -> None:
    views = tuple(rectified(exposed(ramp(top), light)) for top, light in ((0.2, LONG), (0.4, LONG), (0.4, SHORT)))
    taken = shots.combine(views, (LONG, replace(LONG, pattern=3), replace(SHORT, pattern=3)))
    assert len(taken.pairs) == 2
    assert taken.pairs[0].left is views[0].left
    assert np.abs(taken.pairs[1].left - 255 * np.sqrt(ramp(0.4) / 5)).max() <= 8


def test_without_a_projector_the_plain_shots_are_matched() -> None:
    taken = shots.combine((rectified(exposed(ramp(0.5), PLAIN)),), (PLAIN,))
    assert np.array_equal(taken.matched.left, exposed(ramp(0.5), PLAIN))
    assert taken.guide is None


def test_gray_code_alone_leaves_nothing_to_match() -> None:
    with pytest.raises(ValueError, match="no shot to match"):
        shots.combine((rectified(exposed(ramp(0.5), LONG)),), (replace(LONG, pattern=8),))


FIELDS = arrays.arrays(np.float32, (3, 4), elements=st.one_of(st.just(np.nan), st.floats(0, 300, width=32)))


@given(st.lists(FIELDS, min_size=1, max_size=4))
def test_what_is_agreed_lies_between_what_was_measured(fields: list[np.ndarray]) -> None:
    sigmas = tuple(np.where(np.isnan(field), field, np.float32(0.2 + 0.1 * k)) for k, field in enumerate(fields))
    disparity, sigma = shots.agree(tuple(fields), sigmas)
    measured = np.isfinite(disparity)
    stack = np.array(fields)
    assert np.array_equal(measured, np.isfinite(sigma))
    assert np.isfinite(stack[:, measured]).all()
    assert (disparity[measured] >= stack.min(axis=0)[measured] - 1e-3).all()
    assert (disparity[measured] <= stack.max(axis=0)[measured] + 1e-3).all()
    assert (sigma[measured] <= np.float32(0.2) + 1e-6).all()
    close = np.isfinite(stack).all(axis=0) & (np.ptp(stack, axis=0) <= 1)
    assert measured[close].all()
    limit = max(1.0, 3 * np.sqrt(2) * (0.2 + 0.1 * (len(fields) - 1)))
    assert not measured[np.ptp(stack, axis=0) > limit + 1e-3].any() or len(fields) == 1


def test_agreement_weighs_by_certainty() -> None:
    disparities = tuple(np.full((1, 1), value, np.float32) for value in (10.0, 10.9))
    sigmas = tuple(np.full((1, 1), value, np.float32) for value in (0.1, 0.3))
    disparity, sigma = shots.agree(disparities, sigmas)
    assert disparity[0, 0] == pytest.approx((10.0 * 100 + 10.9 / 0.09) / (100 + 1 / 0.09), abs=1e-4)
    assert sigma[0, 0] == pytest.approx(1 / np.sqrt(100 + 1 / 0.09), abs=1e-5)


def test_fused_depth_is_measured_where_the_patterns_agree() -> None:
    def depth(value: float, confidence: int) -> Depth:
        disparity = np.full((2, 2), value, np.float32)
        return Depth(disparity=disparity, fill=lambda: disparity, confidence=np.full((2, 2), confidence, np.uint8),
                     measured=np.ones((2, 2), bool), sigma_px=np.full((2, 2), 0.1, np.float32))

    one = depth(20.0, 255)
    assert shots.fuse((one,)) is one
    near, far = shots.fuse((one, depth(20.4, 200))), shots.fuse((one, depth(24.0, 200)))
    assert near.measured.all()
    assert np.allclose(near.disparity, 20.2, atol=1e-4)
    assert np.allclose(near.filled, 20.2, atol=1e-4)
    assert (near.confidence == 200).all()
    assert not far.measured.any()
    assert np.isnan(far.disparity).all()
