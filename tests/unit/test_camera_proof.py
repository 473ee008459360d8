"""What a skew rests on: PTP when it can be believed, else the latches' bounds, else the host's times, else nothing."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from binpick.camera import proof
from binpick.camera.proof import Skew
from binpick.data import Frame

MS = 1_000_000


def frame(timestamp_ns: int = 0, latched_ns: tuple[int, int] | None = None, ptp: str = "", acknowledged_ns: int = 0,
          offset_ns: float = 0.0, triggered_ns: int = 0) -> Frame:
    return Frame(image=np.zeros((2, 2), np.uint8), camera="left", sequence=1, frame_id=1, timestamp_ns=timestamp_ns,
                 triggered_ns=triggered_ns, received_ns=20 * MS, exposure_us=1.0, gain_db=0.0, acknowledged_ns=acknowledged_ns,
                 latched_ns=latched_ns, ptp=ptp, ptp_offset_ns=offset_ns)


def test_ptp_tells_by_the_time_stamps_and_the_offsets() -> None:
    found = proof.skew(frame(5 * MS, ptp="Master"), frame(5 * MS + 7000, ptp="Slave", offset_ns=-1000.0))
    assert (found.us, found.proof) == (7.0, "ptp")
    assert found.sigma_us == pytest.approx(math.sqrt(2))


@pytest.mark.parametrize(("first", "second", "expected"), [
    ("Master", "Slave", "ptp"), ("Slave", "Slave", "ptp"), ("Master", "Master", "latch"), ("Master", "", "latch"),
    ("", "", "latch")])
def test_who_follows_nobody_has_no_common_clock(first: str, second: str, expected: str) -> None:
    left, right = frame(0, (0, MS), first, MS), frame(0, (0, MS), second, MS)
    assert proof.skew(left, right).proof == expected


def test_ptp_is_not_believed_against_the_latches() -> None:
    left, right = frame(0, (0, 1000), "Master"), frame(900_000, (0, 1000), "Slave")
    assert proof.skew(left, right) == Skew(0.0, math.hypot(1, 1) / math.sqrt(12), "latch")


def test_without_latches_the_host_tells_and_without_the_host_nobody() -> None:
    left, right = frame(acknowledged_ns=100_000), frame(acknowledged_ns=500_000, triggered_ns=200_000)
    assert proof.skew(left, right) == Skew(300.0, math.hypot(100, 300) / math.sqrt(12), "interval")
    assert proof.skew(left, frame()) == Skew(0.0, math.inf, "none")


@given(*[st.tuples(st.integers(0, 10**9), st.integers(0, 10**7), st.floats(0, 1)) for _ in range(2)])
def test_three_sigma_hold_every_pair_of_instants_in_their_intervals(
        first: tuple[int, int, float], second: tuple[int, int, float]) -> None:
    (early, width, share), (early_2, width_2, share_2) = first, second
    true_us = (early_2 + share_2 * width_2 - early - share * width) / 1000
    found = proof.skew(frame(latched_ns=(early, early + width)), frame(latched_ns=(early_2, early_2 + width_2)))
    assert abs(found.us - true_us) <= 3 * found.sigma_us + 1e-6
    assert abs(true_us) <= found.worst_us + 1e-6


def test_of_three_the_worst_two_count_and_two_masters_make_two_times() -> None:
    frames = (frame(0, ptp="Master"), frame(2000, ptp="Slave"), frame(-9000, ptp="Slave"))
    assert proof.worst(frames).us == -11.0
    apart = (frame(0, (0, 10), "Master"), frame(0, (0, 10), "Slave"), frame(0, (0, 10), "Master"))
    assert proof.worst(apart).proof == "latch"


@pytest.mark.parametrize(("latched_ns", "triggered_ns", "wrong"), [
    ((5 * MS, 6 * MS), 7 * MS, "older than its trigger"), ((5 * MS, 8 * MS), 7 * MS, ""),
    ((21 * MS, 22 * MS), 7 * MS, "after its arrival"), (None, 7 * MS, "")])
def test_a_time_stamp_must_lie_between_trigger_and_arrival(latched_ns: tuple[int, int] | None, triggered_ns: int,
                                                           wrong: str) -> None:
    said = proof.misdated(frame(latched_ns=latched_ns, triggered_ns=triggered_ns))
    assert wrong in said if wrong else said == ""
