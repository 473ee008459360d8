"""The fit finds the laws that made its data, and writes them as the module that is in use."""

from pathlib import Path

import numpy as np
import pytest

from binpick.lab import fit
from binpick.stereo import weights
from binpick.stereo.evidence import OF_CELLS, OF_PIXELS


def test_the_module_of_weights_is_what_the_generator_writes() -> None:
    source = Path(weights.__file__).read_text()
    assert fit.text(weights.FULL, weights.HALF) == source
    assert max(map(len, source.splitlines())) <= 128
    fresh: dict[str, object] = {"__name__": weights.__name__}
    exec(compile(fit.text(weights.HALF, weights.FULL), "swapped", "exec"), fresh)
    assert (repr(fresh["FULL"]), repr(fresh["HALF"])) == (repr(weights.HALF), repr(weights.FULL))


def design(count: int, seed: int = 0) -> np.ndarray:
    return np.column_stack([np.ones(count), np.random.default_rng(seed).normal(size=(count, 3))])


@pytest.mark.parametrize("planted", [(-1.0, 0.8, 0.0, -0.5), (-3.0, 0.0, 1.2, 0.3), (0.5, -1.0, 0.2, 0.0)])
def test_planted_log_odds_are_recovered(planted: tuple[float, ...]) -> None:
    x = design(40_000)
    wrong = np.random.default_rng(1).uniform(size=len(x)) < 1 / (1 + np.exp(-x @ planted))
    assert np.abs(fit._logistic(x, wrong) - planted).max() < 0.08


@pytest.mark.parametrize("planted", [(-2.0, 0.4, 0.0, -0.3), (0.0, 0.0, 0.7, 0.1)])
def test_a_planted_quantile_is_recovered(planted: tuple[float, ...]) -> None:
    """Noise that lies below zero as often as the quantile says, skewed as the log of an error is."""
    x = design(40_000)
    noise = np.log(np.random.default_rng(2).exponential(size=len(x)))
    y = x @ planted + noise - np.log(-np.log(1 - fit.QUANTILE))
    found = fit._quantile(x, y)
    assert np.abs(found - planted).max() < 0.06
    assert (y < x @ found).mean() == pytest.approx(fit.QUANTILE, abs=0.01)


def lesson(count: int = 30_000) -> fit.Lesson:
    """Errors that grow with the second measure; the last never changes."""
    rng = np.random.default_rng(3)
    planes = rng.uniform(0, 2, (count, len(OF_PIXELS) + len(OF_CELLS))).astype(np.float32)
    planes[:, -1] = 0.7
    error = np.abs(rng.normal(size=count)) * np.exp(-2 + planes[:, 1])
    return fit.Lesson(planes, rng.uniform(size=count) < 0.4, error.astype(np.float32), 1.0)


def test_a_fitted_model_tells_what_makes_errors_and_how_large_they_are() -> None:
    taught = lesson()
    model = fit.fit([taught])
    wrong, sigma = model.alone.wrong, model.alone.sigma
    assert wrong.pixels[1] > 1
    assert sigma.pixels[1] == pytest.approx(1.0, abs=0.15)
    assert wrong.cells[-1] == sigma.cells[-1] == 0, "what never changes tells nothing"
    told = np.exp(sigma.constant + taught.planes[~taught.two].astype(float) @ (*sigma.pixels, *sigma.cells))
    assert (taught.error_px[~taught.two] < told).mean() == pytest.approx(fit.QUANTILE, abs=0.02)
