"""The fit finds the laws that made its data, and writes them as the module that is in use."""

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from binpick.lab import fit
from binpick.stereo import trust, weights
from binpick.stereo.evidence import OF_CELLS, OF_PIXELS


def test_the_module_of_weights_is_what_the_generator_writes() -> None:
    source = Path(weights.__file__).read_text()
    assert fit.text(weights.FULL, weights.HALF) == source
    assert max(map(len, source.splitlines())) <= 128
    fresh: dict[str, object] = {"__name__": weights.__name__}
    exec(compile(fit.text(weights.HALF, weights.FULL), "swapped", "exec"), fresh)
    assert (repr(fresh["FULL"]), repr(fresh["HALF"])) == (repr(weights.HALF), repr(weights.FULL))


def planes(count: int = 30_000) -> np.ndarray:
    """Measures of which the last never changes."""
    drawn = np.random.default_rng(3).uniform(0, 2, (count, len(OF_PIXELS) + len(OF_CELLS))).astype(np.float32)
    drawn[:, -1] = 0.7
    return drawn


def test_planted_log_odds_are_recovered() -> None:
    x = planes(40_000)
    planted = -1 + 0.8 * x[:, 0] - 0.5 * x[:, 6]
    law, odds = fit._law(x, np.random.default_rng(1).uniform(size=len(x)) < 1 / (1 + np.exp(-planted)))
    assert (law.pixels[0], law.cells[1]) == (pytest.approx(0.8, abs=0.08), pytest.approx(-0.5, abs=0.08))
    assert law.cells[-1] == 0, "what never changes tells nothing"
    assert np.abs(odds - planted).max() < 0.3
    told = law.constant + x @ (*law.pixels, *law.cells)
    assert np.allclose(odds, told, atol=0.02)


def test_a_network_finds_a_bend_that_no_line_has() -> None:
    x = planes(60_000)
    planted = 2 * np.abs(x[:, 1] - 1) - 1
    wrong = np.random.default_rng(2).uniform(size=len(x)) < 1 / (1 + np.exp(-planted))
    told = trust.answer(fit.network(x, fit.likelihood(wrong)), x.T)
    assert np.abs(told - planted).mean() < 0.15, "a line is .5 off"
    assert np.corrcoef(x[:, 1], planted)[0, 1] ** 2 < 0.01


def test_a_fitted_sigma_holds_its_shares_wherever_errors_are_large() -> None:
    """Normal errors whose size grows with one measure: sigma lies between what either share alone would ask for."""
    x = planes()
    truth = np.exp(-2 + x[:, 1])
    error = np.abs(np.random.default_rng(4).normal(size=len(x))) * truth
    sigma = np.exp(trust.answer(fit.network(x, fit.shares(error.astype(np.float32))), x.T))
    least, most = sorted((norm.ppf((1 + fit.WITHIN) / 2), norm.ppf((1 + fit.WITHIN_TWICE) / 2) / 2))
    for part in (x[:, 1] < 0.5, x[:, 1] > 1.5):
        assert least - 0.03 < np.median(sigma[part] / truth[part]) < most + 0.03
        assert norm.cdf(least) * 2 - 1 - 0.02 < (error[part] < sigma[part]).mean() < norm.cdf(most) * 2 - 1 + 0.02


def test_a_model_is_fitted_from_what_each_place_teaches() -> None:
    x = planes(6000)
    error = np.abs(np.random.default_rng(5).normal(size=len(x))) * np.exp(-1 + x[:, 1])
    lesson = fit.Lesson(x, x, error.astype(np.float32))
    model = fit.fit([fit.Scene(lesson, lesson, 1.0)])
    assert model.wrong.pixels[1] > 1
    assert len(model.sigma.hidden) == len(model.wrong_between.hidden) == fit.HIDDEN
    odds = trust.answer(model.wrong_between, x.T)
    assert odds[error > 1].mean() > odds[error < 1].mean() + 1
