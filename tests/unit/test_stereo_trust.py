"""Trust is a linear law of the evidence: what it says, what it allows, and that no match is measured that is none."""

import math

import hypothesis.extra.numpy as arrays
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from binpick.stereo import trust
from binpick.stereo.evidence import OF_CELLS, OF_PIXELS, Evidence
from binpick.stereo.trust import Trust
from binpick.stereo.weights import FULL, HALF, Law, Laws, Model

SHAPE = (12, 14)
ODDS = arrays.arrays(np.float32, SHAPE, elements=st.floats(-8, 8, width=32))
RISK = st.floats(0.01, 1.0)
FOUND = arrays.arrays(np.float32, SHAPE, elements=st.one_of(st.just(np.nan), st.floats(0, 60, width=32)))


def judged(odds: np.ndarray) -> Trust:
    return Trust(odds, np.full(odds.shape, 0.1, np.float32))


@given(FOUND, ODDS, RISK, RISK)
def test_more_risk_never_measures_less(disparity: np.ndarray, odds: np.ndarray, one: float, other: float) -> None:
    few, more = (trust.believed(disparity, judged(odds), risk) for risk in sorted((one, other)))
    assert not (few & ~more).any()
    assert not (more & np.isnan(disparity)).any()
    assert np.array_equal(trust.believed(disparity, judged(odds), 1.0), np.isfinite(disparity))


@given(FOUND, ODDS, RISK, st.integers(0, 20))
def test_only_what_is_believed_is_a_speckle(disparity: np.ndarray, odds: np.ndarray, risk: float, size: int) -> None:
    sound = trust.believed(disparity, judged(odds), risk)
    speckled = trust.speckled(disparity, sound, size)
    assert not (speckled & ~sound).any()
    assert size or not speckled.any()


def test_a_risk_is_the_probability_at_which_a_match_is_dropped() -> None:
    odds = np.linspace(-3, 3, 24, dtype=np.float32).reshape(2, 12)
    for risk in (0.1, 0.4, 0.8):
        probability = 1 / (1 + np.exp(-odds.astype(float)))
        assert np.array_equal(trust.believed(np.ones_like(odds), judged(odds), risk), probability <= risk)


def test_islands_smaller_than_asked_are_speckles_and_larger_ones_not() -> None:
    disparity = np.full((30, 30), np.nan, np.float32)
    disparity[2:5, 2:5] = 8.0
    disparity[10:20, 10:20] = 8.0
    disparity[14:16, 14:16] = 30.0
    speckled = trust.speckled(disparity, np.isfinite(disparity), 20)
    assert speckled[2:5, 2:5].all()
    assert speckled[14:16, 14:16].all()
    assert speckled.sum() == 9 + 4


def law(constant: float, seed: int) -> Law:
    rng = np.random.default_rng(seed)
    return Law(constant, tuple(rng.uniform(-1, 1, len(OF_PIXELS)).tolist()), tuple(rng.uniform(-1, 1, len(OF_CELLS)).tolist()))


def evidence(rows: int, cols: int) -> Evidence:
    rng = np.random.default_rng(9)
    return Evidence(rng.uniform(-1, 1, (len(OF_PIXELS), rows, cols)).astype(np.float32),
                    rng.uniform(-1, 1, (len(OF_CELLS), rows // 2, cols // 2)).astype(np.float32),
                    rng.uniform(size=(rows, cols)) < 0.3)


def test_between_surfaces_the_law_has_every_product_once() -> None:
    size = len(OF_PIXELS) + len(OF_CELLS)
    rng = np.random.default_rng(3)
    measures, pairs = rng.uniform(-1, 1, (size, 50)).astype(np.float32), rng.uniform(-1, 1, size * (size + 1) // 2)
    linear = law(0.5, 5)
    quadratic = Law(linear.constant, linear.pixels, linear.cells, tuple(pairs.tolist()))
    first, second = np.triu_indices(size)
    wanted = (0.5 + np.array(linear.pixels + linear.cells) @ measures
              + pairs @ (measures[first] * measures[second]))
    assert np.allclose(trust._contest(measures, quadratic), wanted, atol=1e-4)


@pytest.mark.parametrize("shape", [(10, 12), (11, 13), (2, 2)])
def test_the_law_of_the_place_is_applied_to_every_pixel(shape: tuple[int, int]) -> None:
    model = Model(Laws(law(-1.0, 1), law(-2.0, 2)), Laws(law(0.5, 3), law(-1.5, 4)))
    seen = evidence(*shape)
    result = trust.judge(seen, model)
    rows, cols = (np.minimum(np.arange(side) // 2, side // 2 - 1) for side in shape)
    for v in range(shape[0]):
        for u in range(shape[1]):
            laws = model.between if seen.two[v, u] else model.alone
            measures = np.concatenate([seen.pixels[:, v, u], seen.cells[:, rows[v], cols[u]]])
            odds, log_sigma = (one.constant + measures @ (*one.pixels, *one.cells) for one in (laws.wrong, laws.sigma))
            assert result.odds[v, u] == pytest.approx(odds, abs=1e-4)
            assert result.sigma_px[v, u] == pytest.approx(np.clip(math.exp(log_sigma), 0.02, 3.0), rel=1e-4)


def test_sigma_stays_within_what_can_be_known() -> None:
    seen = evidence(10, 12)
    for constant in (-50.0, 50.0):
        extreme = Laws(law(constant, 1), law(constant, 2))
        sigma = trust.judge(seen, Model(extreme, extreme)).sigma_px
        assert (sigma >= np.float32(trust.LEAST_SIGMA_PX)).all()
        assert (sigma <= np.float32(trust.MOST_SIGMA_PX)).all()


@pytest.mark.parametrize("model", [FULL, HALF], ids=["full", "half"])
def test_the_fitted_laws_know_every_measure_and_their_signs_make_sense(model: Model) -> None:
    for laws in (model.alone, model.between):
        for one in (laws.wrong, laws.sigma):
            assert (len(one.pixels), len(one.cells)) == (len(OF_PIXELS), len(OF_CELLS))
    wrong = dict(zip((*OF_PIXELS, *OF_CELLS), (*model.alone.wrong.pixels, *model.alone.wrong.cells), strict=True))
    # images that differ, planes that depart or do not fit, and holes around never speak for a match
    assert min(wrong[name] for name in ("departure", "mismatch", "misfit", "holes")) > 0
    assert model.alone.wrong.pixels[OF_PIXELS.index("rival")] == 0, "where one surface is seen, it has no rival"
