"""Clocks that drift, PTP that joins them, and things that happen at a time: time as a number, where it can be."""

import threading
import time
from collections.abc import Iterator

import pytest

from binpick.sim.gige.clock import Clock, host_ns
from binpick.sim.gige.ptp import RESIDUAL_NS, Oscillator, Ptp
from binpick.sim.gige.timer import Timer

SECOND = 1_000_000_000
MS = 1_000_000
OSCILLATORS = (Oscillator(300 * MS, 20_000), Oscillator(-500 * MS, -15_000), Oscillator(10, 0))


def test_a_clock_drifts_and_tells_the_way_back() -> None:
    clock = Clock(5 * SECOND, 7 * SECOND, drift_ppb=25_000)
    assert clock.at(5 * SECOND) == 7 * SECOND
    assert clock.at(15 * SECOND) == 17 * SECOND + 250_000
    assert abs(clock.when(clock.at(123_456_789_012)) - 123_456_789_012) <= 1
    assert clock.shifted(-9).at(5 * SECOND) == 7 * SECOND - 9


class Network:
    """Three heads' PTP, which takes a second, and a time that begins when they get power."""

    def __init__(self, apart: bool = False) -> None:
        self.ptp = Ptp(OSCILLATORS, settle_s=1.0, apart=apart)
        self.zero = host_ns() + SECOND
        for head in range(3):
            self.ptp.power(head, self.zero)

    def states(self, at_ms: int) -> list[str]:
        return [self.ptp.state(head, self.zero + at_ms * MS) for head in range(3)]

    def offsets_ns(self, at_ms: int) -> list[int]:
        """Of each clock from the host's."""
        now = self.zero + at_ms * MS
        return [self.ptp.clock(head, now).at(now) - now for head in range(3)]

    def enable(self, at_ms: int, *heads: int, on: bool = True) -> None:
        for head in heads:
            self.ptp.enable(head, on, self.zero + at_ms * MS)


def test_states_on_the_way_to_a_common_time() -> None:
    network = Network()
    assert network.states(0) == ["Disabled"] * 3
    network.enable(0, 0, 1)
    assert [network.states(ms)[:2] for ms in (100, 300, 600, 1100)] == [
        ["Initializing"] * 2, ["Listening"] * 2, ["Master", "Uncalibrated"], ["Master", "Slave"]]
    left, right, third = network.offsets_ns(2000)
    assert (left, right) == (300 * MS + 40_000, 300 * MS + 40_000 + RESIDUAL_NS)
    assert (network.states(2000)[2], third) == ("Disabled", 10)
    assert [network.ptp.leader(head, network.zero + 2000 * MS) for head in range(3)] == [0, 0, None]


def test_a_clock_runs_on_from_where_it_is_when_its_leader_goes() -> None:
    network = Network()
    network.enable(0, 0, 1)
    assert network.states(2000)[1] == "Slave"
    network.enable(2000, 0, on=False)
    assert network.states(2001)[:2] == ["Disabled", "Master"]
    assert network.offsets_ns(3000)[1] == pytest.approx(300 * MS + 40_000 + RESIDUAL_NS - 15_000, abs=2)


def test_heads_that_do_not_hear_each_other_are_all_masters() -> None:
    network = Network(apart=True)
    network.enable(0, 0, 1, 2)
    assert network.states(2000) == ["Master"] * 3
    assert network.offsets_ns(2000) == [300 * MS + 40_000, -500 * MS - 30_000, 10]
    for head in range(3):
        network.ptp.move(head, 0, network.zero + 2000 * MS)
    assert network.states(2001) == ["Master", "Slave", "Slave"]


def test_a_head_that_nobody_hears_for_a_while() -> None:
    network = Network()
    network.enable(0, 0, 1, 2)
    assert network.states(2000) == ["Master", "Slave", "Slave"]
    network.ptp.cut(0, True, network.zero + 2000 * MS)
    assert network.states(2001) == ["Initializing", "Master", "Slave"]
    assert network.states(4000) == ["Master", "Master", "Slave"]
    assert network.offsets_ns(4000)[2] - network.offsets_ns(4000)[1] == 2 * RESIDUAL_NS
    network.ptp.cut(0, False, network.zero + 4000 * MS)
    assert network.states(4300) == ["Listening", "Master", "Slave"]
    assert network.states(4800) == ["Master", "Uncalibrated", "Uncalibrated"]
    assert network.states(6000) == ["Master", "Slave", "Slave"]


@pytest.mark.parametrize("state", ["Faulty", "Listening"])
def test_a_head_that_falls_back_and_comes_again(state: str) -> None:
    network = Network()
    network.enable(0, 0, 1)
    assert network.states(2000)[1] == "Slave"
    network.ptp.force(1, state, network.zero + 2000 * MS)
    assert network.states(9000)[:2] == ["Master", state]
    assert network.offsets_ns(9000)[1] != pytest.approx(network.offsets_ns(9000)[0], abs=10_000)
    network.ptp.force(1, "", network.zero + 9000 * MS)
    assert network.states(9100)[1] == "Initializing"
    assert network.states(10_100)[1] == "Slave"


def test_a_follower_may_be_off_without_knowing_and_resets_only_when_it_is_free() -> None:
    network = Network()
    network.enable(0, 0, 1)
    assert network.states(2000)[1] == "Slave"
    network.ptp.stray(1, 70_000, network.zero + 2000 * MS)
    left, right, _ = network.offsets_ns(2500)
    assert right - left == 70_000
    assert abs(network.ptp.offset_ns(1, network.zero + 2500 * MS)) <= 40
    for head in (1, 2):
        network.ptp.reset(head, network.zero + 2500 * MS)
    assert network.offsets_ns(2500)[1] == right
    assert network.ptp.clock(2, network.zero + 2500 * MS).at(network.zero + 3500 * MS) == SECOND


@pytest.mark.parametrize("apart", [False, True])
def test_what_was_done_to_a_head_can_be_ended(apart: bool) -> None:
    network, well = Network(apart), Network(apart)
    for one in (network, well):
        one.enable(0, 0, 1)
    network.ptp.force(1, "Faulty", network.zero + 100 * MS)
    network.ptp.move(1, 1 - apart, network.zero + 100 * MS)
    network.ptp.stray(1, 70_000, network.zero + 100 * MS)
    network.ptp.mend(1, network.zero + 200 * MS)
    assert network.states(2000) == well.states(2000)
    assert network.offsets_ns(2000) == well.offsets_ns(2000)


def test_power_ends_it_and_a_tuned_clock_stays_so() -> None:
    network = Network()
    network.enable(0, 0, 1)
    network.ptp.tune(2, Oscillator(5 * MS, 0), network.zero)
    for head in (1, 2):
        network.ptp.power(head, network.zero + 2000 * MS)
    assert network.states(2000) == ["Master", "Disabled", "Disabled"]
    assert network.offsets_ns(2000)[1:] == [-500 * MS, 5 * MS]


@pytest.fixture
def timer() -> Iterator[Timer]:
    timer = Timer()
    timer.start()
    yield timer
    timer.stop()


def test_what_is_due_happens_in_order_and_at_once_when_it_is_past(timer: Timer) -> None:
    happened: list[str] = []
    last = threading.Event()
    now = host_ns()
    timer.call(now + 40 * MS, last.set)
    timer.call(now + 20 * MS, lambda: happened.append("second"))
    timer.call(now - SECOND, lambda: happened.append("first"))
    assert last.wait(2)
    assert happened == ["first", "second"]
    assert host_ns() >= now + 40 * MS


def test_what_is_due_after_the_end_never_happens(timer: Timer) -> None:
    happened = threading.Event()
    timer.call(host_ns() + 30 * MS, happened.set)
    timer.stop()
    time.sleep(0.05)
    assert not happened.is_set()
