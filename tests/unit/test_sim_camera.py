"""The in-process camera keeps the contract of a camera, also when it is told to fail."""

import numpy as np
import pytest

from binpick.camera.base import Camera
from binpick.data import Light
from binpick.errors import CameraLost
from binpick.sim.camera import SimCamera

SECOND = 1_000_000_000
LIGHT = Light(20_000.0, 3.0, True)


class Time:
    def __init__(self):
        self.now = 5 * SECOND

    def clock(self):
        return self.now

    def sleep(self, seconds):
        self.now += int(seconds * 1e9)


@pytest.fixture
def time():
    return Time()


@pytest.fixture
def camera(time):
    def expose(index, light, shot):
        return np.full((4, 6), index * 100 + shot, np.uint8)

    camera: Camera = SimCamera(1, expose, time.clock, time.sleep)
    camera.open(time.now + SECOND)
    camera.configure(LIGHT, time.now + SECOND)
    return camera


def test_a_triggered_frame_comes_when_its_exposure_has_elapsed(camera, time):
    camera.trigger(7, time.now + SECOND)
    started = time.now
    frame = camera.grab(7, time.now + SECOND)
    assert time.now - started == 20_000_000
    assert frame.image[0, 0] == 107
    assert (frame.camera, frame.sequence, frame.frame_id) == ("right", 7, 1)
    assert (frame.timestamp_ns, frame.triggered_ns, frame.received_ns) == (started, started, time.now)
    assert (frame.exposure_us, frame.gain_db) == (20_000.0, 3.0)


def test_it_exposes_under_the_light_it_was_configured_with(time):
    lights = []
    camera = SimCamera(0, lambda index, light, shot: lights.append(light) or np.zeros((1, 1), np.uint8), time.clock, time.sleep)
    camera.open(time.now + SECOND)
    camera.configure(Light(100.0, 0.0, True, 12), time.now + SECOND)
    camera.trigger(1, time.now + SECOND)
    camera.grab(1, time.now + SECOND)
    assert [light.pattern for light in lights] == [12]


def test_its_status_says_that_it_is_simulated(camera, time):
    status = camera.status()
    assert status.simulated
    assert status.connected
    assert status.serial == "SIM-RIGHT"
    camera.close()
    assert not camera.status().connected


def test_a_frame_that_was_not_triggered_is_not_there(camera, time):
    with pytest.raises(CameraLost, match="not triggered"):
        camera.grab(1, time.now + SECOND)


def test_an_exposure_longer_than_the_deadline_ends_at_the_deadline(camera, time):
    deadline = time.now + 5_000_000
    camera.trigger(1, deadline)
    with pytest.raises(CameraLost, match="in time"):
        camera.grab(1, deadline)
    assert time.now == deadline


def test_a_dead_camera_fails_at_once_also_in_mid_cycle_and_comes_back(camera, time):
    camera.trigger(1, time.now + SECOND)
    camera.fail = "dead"
    before = time.now
    with pytest.raises(CameraLost, match="right") as lost:
        camera.grab(1, time.now + SECOND)
    assert lost.value.camera == "right"
    assert time.now == before
    assert not camera.status().connected
    assert "does not answer" in camera.status().error
    with pytest.raises(CameraLost):
        camera.open(time.now + SECOND)
    camera.fail = ""
    camera.close()
    camera.open(time.now + SECOND)
    assert camera.status().connected
    assert camera.status().error == ""


def test_a_stuck_camera_blocks_until_its_deadline_and_no_longer(camera, time):
    camera.fail = "stuck"
    deadline = time.now + SECOND
    with pytest.raises(CameraLost, match="in time"):
        camera.trigger(1, deadline)
    assert time.now == deadline


def test_a_camera_must_be_opened_first(time):
    camera = SimCamera(0, lambda *_: np.zeros((1, 1), np.uint8), time.clock, time.sleep)
    with pytest.raises(CameraLost, match="not open"):
        camera.trigger(1, time.now + SECOND)
