"""Trust in a match: what the evidence says of it, what it allows, and that no match is measured that is none."""

import math

import cv2
import hypothesis.extra.numpy as arrays
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from binpick.stereo import islands, trust
from binpick.stereo.evidence import OF_CELLS, OF_PIXELS, Evidence
from binpick.stereo.strip import joined, strips
from binpick.stereo.trust import Trust
from binpick.stereo.weights import FULL, HALF, Law, Model, Network

SHAPE = (12, 14)
MEASURES = len(OF_PIXELS) + len(OF_CELLS)
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


@settings(deadline=None)
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


def network(constant: float, seed: int, units: int = 3) -> Network:
    rng = np.random.default_rng(seed)
    out, offsets, hidden = (rng.uniform(-1, 1, shape) for shape in (units, units, (units, MEASURES)))
    return Network(constant, tuple(out.tolist()), tuple(offsets.tolist()), tuple(map(tuple, hidden.tolist())))


def answer(net: Network, measures: np.ndarray) -> float:
    """The formula of the docstring, in doubles."""
    return float(net.constant + np.array(net.out) @ np.maximum(np.array(net.hidden) @ measures + np.array(net.offsets), 0))


def test_a_network_answers_every_column() -> None:
    net = network(0.5, 5)
    measures = np.random.default_rng(3).uniform(-1, 1, (MEASURES, 9)).astype(np.float32)
    answers = trust.answer(net, measures)
    for k in range(9):
        assert answers[k] == pytest.approx(answer(net, measures[:, k]), abs=1e-5)
    assert trust.answer(net, measures[:, :0]).shape == (0,)


@pytest.mark.parametrize("shape", [(10, 12), (11, 13), (2, 2)])
def test_what_holds_at_the_place_is_said_of_every_pixel(shape: tuple[int, int]) -> None:
    model = Model(law(-1.0, 1), network(-2.0, 2), network(0.5, 3), network(-1.5, 4))
    seen = evidence(*shape)
    result = trust.judge(seen, model)
    rows, cols = (np.minimum(np.arange(side) // 2, side // 2 - 1) for side in shape)
    for v in range(shape[0]):
        for u in range(shape[1]):
            down, across = rows[v], cols[u]
            cell = seen.cells[:, down, across]
            pixels = seen.pixels[:, v, u]
            if seen.two[v, u]:
                odds, log_sigma = (answer(net, np.concatenate([pixels, cell]))
                                   for net in (model.wrong_between, model.sigma_between))
            else:
                odds = model.wrong.constant + pixels @ model.wrong.pixels + cell @ model.wrong.cells
                means = seen.pixels[:, 2 * down:2 * down + 2, 2 * across:2 * across + 2].mean(axis=(1, 2))
                log_sigma = answer(model.sigma, np.concatenate([means, cell]))
            assert result.odds[v, u] == pytest.approx(odds, abs=1e-4)
            assert result.sigma_px[v, u] == pytest.approx(np.clip(math.exp(log_sigma), 0.02, 3.0), rel=1e-4)


def test_sigma_stays_within_what_can_be_known() -> None:
    seen = evidence(10, 12)
    for constant in (-50.0, 50.0):
        extreme = network(constant, 2)
        sigma = trust.judge(seen, Model(law(constant, 1), extreme, extreme, extreme)).sigma_px
        assert (sigma >= np.float32(trust.LEAST_SIGMA_PX)).all()
        assert (sigma <= np.float32(trust.MOST_SIGMA_PX)).all()


@pytest.mark.parametrize("model", [FULL, HALF], ids=["full", "half"])
def test_what_was_fitted_knows_every_measure_and_the_signs_of_the_law_make_sense(model: Model) -> None:
    assert (len(model.wrong.pixels), len(model.wrong.cells)) == (len(OF_PIXELS), len(OF_CELLS))
    for net in (model.sigma, model.wrong_between, model.sigma_between):
        assert len(net.out) == len(net.offsets) == len(net.hidden)
        assert {len(unit) for unit in net.hidden} == {MEASURES}
    wrong = dict(zip((*OF_PIXELS, *OF_CELLS), (*model.wrong.pixels, *model.wrong.cells), strict=True))
    # images that differ, planes that depart or do not fit, and holes around never speak for a match
    assert min(wrong[name] for name in ("departure", "mismatch", "misfit", "holes")) > 0
    assert wrong["rival"] == 0, "where one surface is seen, it has no rival"


@settings(deadline=None)
@given(arrays.arrays(np.float32, SHAPE, elements=st.floats(0, 7, width=32)), arrays.arrays(np.bool_, SHAPE), st.integers(1, 20))
def test_islands_are_those_of_opencv(disparity: np.ndarray, sound: np.ndarray, most_px: int) -> None:
    fixed = np.where(sound, disparity * 16, -1000).astype(np.int16)
    cv2.filterSpeckles(fixed, -1000, most_px, 32)
    assert np.array_equal(islands.small(disparity, sound, most_px), sound & (fixed == -1000))


@pytest.mark.parametrize("seed", range(5))
def test_strips_find_the_speckles_of_the_whole(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sound = cv2.GaussianBlur(rng.normal(size=(130, 70)), (0, 0), 2.0) > 0.02
    disparity = np.cumsum(rng.normal(0, 0.9, sound.shape), axis=0).astype(np.float32) + 40
    whole = trust.speckled(disparity, sound, 20)
    pieces = ((strip.inner(trust.speckled(disparity[strip.seen], sound[strip.seen], 20)),) for strip in strips(130, 32, 20))
    assert whole.any()
    assert (sound & ~whole).any()
    assert np.array_equal(joined(pieces)[0], whole)
