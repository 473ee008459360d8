"""A pair is refused unless it is one: skew, missing packets, old frames, sizes; and failures name their camera, in time."""

import time
from dataclasses import replace
from datetime import UTC, datetime
from typing import Literal

import numpy as np
import pytest

from binpick.camera.base import Clock, MonotonicNs
from binpick.camera.group import CameraGroup
from binpick.camera.starter import Starter
from binpick.data import CameraStatus, Frame, Image, Light
from binpick.errors import CameraError, CameraLost, CycleTimeout, PairRefused
from binpick.sim.camera import SimCamera

LIGHT = Light(exposure_us=100.0, gain_db=0.0, projector=True)


def image_of(height: int = 8) -> Image:
    return np.zeros((height, 12), np.uint8)


def within(seconds: float) -> MonotonicNs:
    return time.monotonic_ns() + int(seconds * 1e9)


class Odd(SimCamera):
    """A camera whose frames differ from the ordinary by `changes`, in the PTP state `ptp`."""

    def __init__(self, index: int, ptp: str | None = None, height: int = 8, **changes: int) -> None:
        super().__init__(index, lambda _index, _light, _shot: image_of(height))
        self.changes = changes
        self.ptp = ("Slave" if index else "Master") if ptp is None else ptp
        self.lights: list[Light] = []
        self.opened = 0

    def open(self, deadline_ns: MonotonicNs) -> None:
        super().open(deadline_ns)
        self.opened += 1

    def configure(self, light: Light, deadline_ns: MonotonicNs) -> None:
        super().configure(light, deadline_ns)
        self.lights.append(light)

    def grab(self, sequence: int, deadline_ns: MonotonicNs) -> Frame:
        frame = super().grab(sequence, deadline_ns)
        shift = {name: getattr(frame, name) + value for name, value in self.changes.items()}
        return replace(frame, ptp=self.ptp, **({"timestamp_ns": 0} | shift))

    def status(self) -> CameraStatus:
        return replace(super().status(), ptp=self.ptp)


def grouped(left: SimCamera, right: SimCamera, max_skew_us: float = 500.0, clock: Clock = time.monotonic_ns) -> CameraGroup:
    group = CameraGroup((left, right), max_skew_us, clock, wall_clock=lambda: datetime(2026, 1, 2, tzinfo=UTC))
    group.open(clock() + 10**9)
    return group


class Late(Odd):
    """Stamps its first `late` frames 9 ms late."""

    late = 0

    def grab(self, sequence: int, deadline_ns: MonotonicNs) -> Frame:
        frame = super().grab(sequence, deadline_ns)
        self.late -= 1
        return replace(frame, timestamp_ns=9_000_000 if self.late >= 0 else 0)


class Time:
    """Passes while a camera waits."""

    now = 5 * 10**9

    def clock(self) -> MonotonicNs:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += int(seconds * 1e9)


class Torn(SimCamera):
    """Its first `torn` images lack packets, which shows 0.55 s after the trigger; `fate` is what becomes of it then."""

    def __init__(self, index: int, time: Time, torn: int = 0, fate: Literal["", "stuck"] = "") -> None:
        super().__init__(index, lambda *_: image_of(), time.clock, time.sleep)
        self.time, self.torn, self.fate = time, torn, fate
        self.shots = self.triggered_ns = 0

    def trigger(self, sequence: int, deadline_ns: MonotonicNs) -> None:
        super().trigger(sequence, deadline_ns)
        self.shots, self.triggered_ns = self.shots + 1, self.time.now

    def grab(self, sequence: int, deadline_ns: MonotonicNs) -> Frame:
        if self.shots > self.torn:
            return super().grab(sequence, deadline_ns)
        self.time.now = max(self.time.now, self.triggered_ns + 550_000_000)
        self.fail = self.fate
        raise PairRefused(f"{self.name}: incomplete", self.name)


def test_on_one_clock_the_time_stamps_tell_the_skew() -> None:
    pair = grouped(Odd(0), Odd(1)).capture(LIGHT, within(2))
    assert (pair.skew_us, pair.sigma_us, pair.proof) == (0.0, 1.0, "ptp")
    assert pair.captured_at == "2026-01-02T00:00:00.000+00:00"
    assert not pair.left.image.flags.writeable


@pytest.mark.parametrize("states", [("", ""), ("Master", ""), ("Master", "Master")])
def test_on_clocks_of_their_own_the_host_tells_it(states: tuple[str, str]) -> None:
    pair = grouped(Odd(0, states[0]), Odd(1, states[1]), 1e6).capture(LIGHT, within(2))
    assert pair.proof == "interval"
    assert pair.skew_us > 0
    assert 0 < pair.sigma_us < 1000


def test_a_skewed_pair_is_shot_again() -> None:
    left, right = Odd(0), Late(1)
    right.late = 2
    pair = grouped(left, right).capture(LIGHT, within(2))
    assert (pair.skew_us, pair.left.sequence, pair.right.sequence) == (0.0, 3, 3)


@pytest.mark.parametrize(("left", "right"), [(1, 0), (0, 2), (2, 1)])
def test_an_incomplete_image_is_shot_again_and_closes_nothing(left: int, right: int) -> None:
    time = Time()
    group = grouped(Torn(0, time, left), Torn(1, time, right), clock=time.clock)
    pair = group.capture(LIGHT, time.now + 10**10)
    assert pair.left.sequence == pair.right.sequence == 1 + max(left, right)
    assert [(status.connected, status.error) for status in group.statuses()] == [(True, "")] * 2


def test_images_that_stay_incomplete_are_refused_after_three_shots() -> None:
    time = Time()
    left, right = Torn(0, time, 3), Torn(1, time, 3)
    group = grouped(left, right, clock=time.clock)
    with pytest.raises(PairRefused, match="left: incomplete; right: incomplete"):
        group.capture(LIGHT, time.now + 10**10)
    assert (left.shots, right.shots) == (3, 3)
    assert group.capture(LIGHT, time.now + 10**10).left.sequence == 4


def test_nothing_is_shot_again_beyond_the_deadline() -> None:
    time = Time()
    left = Torn(0, time, 3)
    with pytest.raises(CycleTimeout):
        grouped(left, Torn(1, time), clock=time.clock).capture(LIGHT, time.now + 10**9)
    assert left.shots == 2


def test_a_numbered_pattern_is_not_shot_again() -> None:
    left, right = Odd(0), Late(1)
    right.late = 1
    group = grouped(left, right)
    with pytest.raises(PairRefused, match="9003 µs apart"):
        group.capture(replace(LIGHT, pattern=9), within(2))
    assert group.capture(replace(LIGHT, pattern=9), within(2)).left.sequence == 2
    time = Time()
    group = grouped(Torn(0, time, 1), Torn(1, time), clock=time.clock)
    with pytest.raises(PairRefused, match="left: incomplete"):
        group.capture(replace(LIGHT, pattern=9), time.now + 10**10)
    assert group.capture(replace(LIGHT, pattern=9), time.now + 10**10).right.sequence == 2


def test_a_skew_that_stays_is_refused() -> None:
    left, right = Odd(0), Late(1)
    right.late = 100
    group = grouped(left, right)
    with pytest.raises(PairRefused, match=r"9003 µs apart \(9000 µs, 1-sigma 1 µs by ptp\), more than the 500 µs allowed"):
        group.capture(LIGHT, within(2))
    assert [(status.connected, status.refused) for status in group.statuses()] == [(True, 3), (True, 3)]


@pytest.mark.parametrize(("right", "reason"), [
    (Odd(1, missing=3), "right: 3 packets"),
    (Odd(1, sequence=-1), "right: the image is older than its trigger"),
    (Odd(1, triggered_ns=-10**10), "right: the image is older than its trigger"),
    (Odd(1, height=9), "differ in size: left 12x8, right 12x9"),
])
def test_no_pair(right: Odd, reason: str) -> None:
    with pytest.raises(PairRefused, match=reason):
        grouped(Odd(0), right).capture(LIGHT, within(2))


def test_light_is_set_when_it_changes_and_after_opening() -> None:
    left, right = Odd(0), Odd(1)
    group = grouped(left, right)
    brighter = replace(LIGHT, exposure_us=200.0)
    for light in (LIGHT, replace(LIGHT), replace(LIGHT, pattern=2), brighter, brighter):
        group.capture(light, within(2))
    assert [(light.exposure_us, light.pattern) for light in left.lights] == [(100.0, 0), (100.0, 2), (200.0, 0)]
    right.fail = "dead"
    with pytest.raises(CameraLost):
        group.capture(brighter, within(2))
    right.fail = ""
    group.open(within(1))
    group.capture(brighter, within(2))
    assert [light.exposure_us for light in left.lights] == [100.0, 100.0, 200.0, 200.0]
    assert (left.opened, right.opened) == (1, 2)


@pytest.mark.parametrize("torn", [0, 1], ids=["at once", "in mid-image"])
def test_both_dead_cameras_stand_in_one_error_within_the_exposure_and_1_4_s(torn: int) -> None:
    time = Time()
    left, right = Torn(0, time, torn, "stuck"), Torn(1, time, torn, "stuck")
    group = grouped(left, right, clock=time.clock)
    if not torn:
        left.fail = right.fail = "stuck"
    start = time.now
    with pytest.raises(CameraLost, match="left camera did not answer in time; the right camera did not") as caught:
        group.capture(LIGHT, start + 30 * 10**9)
    assert time.now - start < 1_400_000_000
    assert caught.value.camera == ""
    assert all(status.error and not status.connected for status in group.statuses())
    with pytest.raises(CameraError, match=r"left.*right"):
        group.capture(LIGHT, start + 30 * 10**9)
    group.close()


def test_a_camera_that_still_exposes_for_a_broken_shot_is_waited_for() -> None:
    class Exposing(Odd):
        """Misses what real cameras miss: a trigger while it exposes."""

        def trigger(self, sequence: int, deadline_ns: MonotonicNs) -> None:
            assert not self.exposing
            super().trigger(sequence, deadline_ns)
            self.exposing = True

        def grab(self, sequence: int, deadline_ns: MonotonicNs) -> Frame:
            frame = super().grab(sequence, deadline_ns)
            self.exposing = False
            return frame

        exposing = False

    class Once(Odd):
        """Fails at its first trigger."""

        def trigger(self, sequence: int, deadline_ns: MonotonicNs) -> None:
            if self.opened == 1:
                raise CameraLost("left is gone", "left")
            super().trigger(sequence, deadline_ns)

    group = grouped(Once(0), Exposing(1))
    with pytest.raises(CameraLost, match="left"):
        group.capture(LIGHT, within(2))
    group.open(within(1))
    pair = group.capture(LIGHT, within(2))
    assert (pair.left.sequence, pair.right.sequence) == (2, 2)


def test_a_camera_that_the_dead_one_should_have_started_is_not_blamed() -> None:
    class Dying(Odd):
        """Takes no first trigger; the last one that it took is `shot`."""

        shot = 0

        def trigger(self, sequence: int, deadline_ns: MonotonicNs) -> None:
            if self.opened == 1:
                raise CameraLost("left is gone", "left")
            super().trigger(sequence, deadline_ns)
            self.shot = sequence

    class Wired(Odd):
        """Exposes when the left camera does."""

        armed = 0

        def arm(self, sequence: int, deadline_ns: MonotonicNs) -> None:
            assert not self.armed
            self.armed = sequence

        def disarm(self, deadline_ns: MonotonicNs) -> None:
            self.armed = 0

        def grab(self, sequence: int, deadline_ns: MonotonicNs) -> Frame:
            if left.shot != sequence:
                raise CameraLost("right sent no image", "right")
            self.trigger(self.armed, deadline_ns)
            self.armed = 0
            return super().grab(sequence, deadline_ns)

    left, right = Dying(0), Wired(1)
    group = CameraGroup((left, right), 1e6, starter=Starter("line"))
    group.open(within(1))
    with pytest.raises(CameraLost, match="left is gone"):
        group.capture(LIGHT, within(2))
    group.open(within(1))
    assert group.capture(LIGHT, within(2)).right.sequence == 2
    assert (left.opened, right.opened) == (2, 1)


def test_a_deadline_within_the_exposure_is_no_fault_of_the_cameras() -> None:
    time = Time()
    group = grouped(Torn(0, time), Torn(1, time), clock=time.clock)
    pair = group.capture(replace(LIGHT, exposure_us=50_000.0), time.now + 20_000_000)
    assert pair.left.sequence == 1
    with pytest.raises(CycleTimeout):
        group.capture(LIGHT, time.now)
    assert all(status.connected and not status.error for status in group.statuses())


def test_a_group_that_was_never_opened_says_so() -> None:
    group = CameraGroup((SimCamera(0, lambda *_: image_of()), SimCamera(1, lambda *_: image_of())), 500.0)
    with pytest.raises(CameraError, match="camera left is not open; camera right is not open"):
        group.capture(LIGHT, within(1))
