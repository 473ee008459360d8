"""Auto exposure ends with the right level, or says why it cannot; a lamp that flickers never lets it run on."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from binpick.camera import exposure
from binpick.camera.exposure import MOST_SHOTS, TOLERANCE, Limits, Search
from binpick.settings.recipe import AutoExposure

WANTED = AutoExposure()
LIMITS = Limits(20.0, WANTED.longest_us, 0.0, WANTED.highest_gain_db)


def sensor(steps_per_us: float, lamp: Callable[[int], float] = lambda _shot: 1.0) -> Callable[[Search, int], float]:
    """A linear 8-bit sensor's level after an exposure."""
    return lambda search, shot: float(np.clip(np.rint(search.light * steps_per_us * lamp(shot) + 2), 0, 255))


def metered(level: Callable[[Search, int], float], start: Search | None = None, wanted: AutoExposure = WANTED,
            limits: Limits = LIMITS) -> Search:
    search = start or limits.begin(6000.0)
    for shot in range(MOST_SHOTS):
        if search.outcome:
            break
        search = exposure.step(search, level(search, shot), wanted, limits)
    return search


@pytest.mark.parametrize("steps_per_us", [140 / 25_000, 140 / 6000, 140 / 900, 140 / 150, 1.5])
def test_dark_bright_and_clipped_scenes_settle_within_a_few_shots(steps_per_us: float) -> None:
    search = metered(sensor(steps_per_us))
    assert search.outcome == "settled"
    assert abs(search.level / WANTED.target_grey - 1) <= TOLERANCE
    assert len(search.wished) <= 7
    assert search.gain_db == 0


def test_gain_comes_only_beyond_the_longest_exposure() -> None:
    search = metered(sensor(140 / 45_000))
    assert (search.outcome, search.exposure_us) == ("settled", WANTED.longest_us)
    assert 2 < search.gain_db < 5


@pytest.mark.parametrize(("steps_per_us", "outcome", "exposure_us", "gain_db"), [
    (0.0, "too_dark", 30_000.0, 6.0), (140 / 200_000, "too_dark", 30_000.0, 6.0), (100.0, "too_bright", 20.0, 0.0)])
def test_limits_are_kept_and_named(steps_per_us: float, outcome: str, exposure_us: float, gain_db: float) -> None:
    search = metered(sensor(steps_per_us))
    assert (search.outcome, search.exposure_us, search.gain_db) == (outcome, exposure_us, gain_db)
    assert len(search.wished) < MOST_SHOTS
    assert not exposure.drifted(search, search.level, WANTED)       # nothing has changed: not again at every cycle


@pytest.mark.parametrize("swing", [1.6, 3.0, 20.0])
def test_a_lamp_that_oscillates_ends_in_the_middle_and_is_called_unsteady(swing: float) -> None:
    search = metered(sensor(140 / 6000, lambda shot: swing if shot % 2 else 1 / swing))
    assert search.outcome == "unsteady"
    assert len(search.wished) == MOST_SHOTS
    assert 1 / 3 <= search.exposure_us / 6000 <= 3


def test_a_lamp_that_is_right_by_chance_once_has_not_settled() -> None:
    levels = iter([140.0, 60.0, 140.0, 230.0, 135.0, 142.0])
    search = metered(lambda _search, _shot: next(levels))
    assert (search.outcome, len(search.wished)) == ("settled", 6)


def test_a_lamp_that_goes_on_after_a_moment_is_followed() -> None:
    assert metered(sensor(140 / 6000, lambda shot: 0.0 if shot < 2 else 1.0)).outcome == "settled"


@given(levels=st.lists(st.floats(0, 255), min_size=MOST_SHOTS, max_size=MOST_SHOTS), low_db=st.floats(0, 6))
def test_whatever_comes_it_ends_in_time_and_within_the_limits(levels: list[float], low_db: float) -> None:
    limits = replace(LIMITS, lowest_db=low_db)
    search = metered(lambda _search, shot: levels[shot], limits=limits)
    assert search.outcome
    assert limits.shortest_us <= search.exposure_us <= limits.longest_us
    assert limits.lowest_db - 0.01 <= search.gain_db <= limits.highest_db


def test_only_a_change_beyond_the_band_is_drift() -> None:
    search = metered(sensor(140 / 3000))
    assert [exposure.drifted(search, search.level * factor, WANTED) for factor in (0.5, 0.8, 1.0, 1.25, 1.5)] == [
        True, False, False, False, True]
    assert exposure.drifted(search, 0.0, WANTED)


def test_the_level_is_the_brighter_cameras_percentile() -> None:
    dark, bright = np.full((10, 10), 40, np.uint8), np.full((10, 10), 60, np.uint8)
    bright[0, :3] = 255
    assert exposure.level((dark, bright), 95.0) == 60
    assert exposure.level((bright, dark), 99.0) == 255
