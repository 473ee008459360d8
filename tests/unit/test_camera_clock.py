"""Latches bound a camera's clock: never wrong, ever narrower, and over a step at once."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from binpick.camera.clock import DeviceClock, Latch

SECOND = 10**9


@dataclass(frozen=True)
class Truth:
    """A clock of known offset and drift."""

    offset_ns: int
    drift: float

    def device_ns(self, host_ns: int) -> int:
        return host_ns + self.offset_ns + round(self.drift * host_ns)

    def latch(self, at_ns: int, before_ns: int, after_ns: int) -> Latch:
        return Latch(at_ns - before_ns, self.device_ns(at_ns), at_ns + after_ns)


truths = st.builds(Truth, st.integers(-SECOND, SECOND), st.floats(-50e-6, 50e-6))
trips = st.lists(st.tuples(st.integers(10**6, SECOND), st.integers(1000, 3 * 10**6), st.integers(1000, 3 * 10**6)),
                 min_size=1, max_size=30)


def followed(truth: Truth, trips: list[tuple[int, int, int]]) -> tuple[DeviceClock, int]:
    clock, now = DeviceClock(), 100 * SECOND
    for pause, before, after in trips:
        now += pause + before + after
        clock = clock.after(truth.latch(now, before, after))
    return clock, now


@given(truths, trips, st.integers(-SECOND, SECOND))
@settings(max_examples=60, deadline=None)
def test_the_truth_lies_within_the_bounds(truth: Truth, trips: list[tuple[int, int, int]], ahead_ns: int) -> None:
    clock, now = followed(truth, trips)
    when = now + ahead_ns
    bounds = clock.host_ns(truth.device_ns(when))
    assert bounds is not None
    assert bounds[0] - 2 <= when <= bounds[1] + 2           # device times are whole nanoseconds
    device = clock.device_ns(when)
    assert device is not None
    assert abs(device - truth.device_ns(when)) <= bounds[1] - bounds[0] + 2


@given(truths, trips, st.integers(1000, 10**6))
@settings(max_examples=30, deadline=None)
def test_a_latch_is_believed_whatever_was_before(truth: Truth, trips: list[tuple[int, int, int]], width_ns: int) -> None:
    clock, now = followed(truth, trips)
    latch = truth.latch(now + SECOND, width_ns, width_ns)
    bounds = clock.after(latch).host_ns(latch.device_ns)
    assert bounds is not None
    assert latch.sent_ns - 2 <= bounds[0] <= bounds[1] <= latch.acknowledged_ns + 2


@given(truths, st.integers(-10**18, 10**18))
@settings(max_examples=30, deadline=None)
def test_only_the_difference_of_the_clocks_counts(truth: Truth, shift_ns: int) -> None:
    trips = [(SECOND // 4, 80_000, 120_000)] * 6
    clock, now = followed(truth, trips)
    moved, _ = followed(Truth(truth.offset_ns + shift_ns, truth.drift), trips)
    assert moved.host_ns(truth.device_ns(now) + shift_ns) == clock.host_ns(truth.device_ns(now))


def test_before_the_first_latch_nothing_is_known() -> None:
    assert DeviceClock().host_ns(5) is None
    assert DeviceClock().device_ns(5) is None


def test_one_latch_says_as_much_as_its_round_trip() -> None:
    assert DeviceClock().after(Latch(1000, 77, 1400)).host_ns(77) == pytest.approx((1000, 1400), abs=1)


def test_a_clock_that_was_stepped_is_found_anew() -> None:
    clock, now = followed(Truth(SECOND, 40e-6), [(SECOND // 2, 100_000, 200_000)] * 10)
    stepped = Truth(0, 10e-6)
    clock = clock.after(stepped.latch(now + SECOND, 100_000, 200_000))
    bounds = clock.host_ns(stepped.device_ns(now + SECOND))
    assert len(clock.latches) == 1
    assert bounds is not None
    assert bounds[0] <= now + SECOND <= bounds[1]


def test_many_latches_are_much_better_than_one() -> None:
    random = np.random.default_rng(1)
    truth = Truth(123_456_789, -35e-6)
    clock, now = followed(truth, [(SECOND // 4, int(a), int(b)) for a, b in random.exponential(150_000, (100, 2)) + 30_000])
    bounds = clock.host_ns(truth.device_ns(now))
    assert bounds is not None
    assert bounds[1] - bounds[0] < 130_000
