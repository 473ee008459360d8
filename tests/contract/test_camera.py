"""One suite over every camera backend; then what only real packets can show."""

import contextlib
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from binpick.camera import backends
from binpick.camera.base import Camera
from binpick.camera.group import CameraGroup
from binpick.data import Image, Light
from binpick.errors import CameraError, CameraHeld, CameraLost, CameraNotFound, ImageError, PairRefused, PortInUse
from binpick.settings.cell import AravisCameras, CameraAddress, FileCameras
from binpick.sim.camera import SimCamera
from binpick.sim.gige import GigePair

WIDTH, HEIGHT = 640, 400
FULL = (1936, 1216)
LIGHT = Light(exposure_us=3000.0, gain_db=1.5, projector=True)
NOBODY = "127.0.250.250"
SENDER = """
import sys, numpy as np
from binpick.sim.gige import GigePair
with GigePair(lambda _index, _light, shot: np.full((1216, 1936), shot, np.uint8), tuple(sys.argv[1:])):
    print("up", flush=True)
    sys.stdin.read()
"""


def within(seconds: float) -> int:
    return time.monotonic_ns() + int(seconds * 1e9)


def coded(index: int, shot: int, size: tuple[int, int] = (WIDTH, HEIGHT)) -> Image:
    """A picture that no other camera or shot has, without repetition from packet to packet."""
    width, height = size
    ramp = np.arange(width * height, dtype=np.uint32).reshape(height, width)
    return ((ramp * np.uint32(2654435761) >> np.uint32(24)) + np.uint32(shot * 37 + index * 101)).astype(np.uint8)


def pair_of(addresses: tuple[str, str], size: tuple[int, int] = (WIDTH, HEIGHT)) -> GigePair:
    serials = (f"L{os.getpid()}", f"R{os.getpid()}")
    return GigePair(lambda index, _light, shot: coded(index, shot, size), addresses, size, serials)


def aravis(addresses: tuple[str, str], **more: object) -> tuple[Camera, Camera]:
    left, right = (CameraAddress(address=address) for address in addresses)
    return backends.make(AravisCameras(left=left, right=right, **more))


@contextlib.contextmanager
def running(addresses: tuple[str, str], size: tuple[int, int] = (WIDTH, HEIGHT)) -> Iterator[GigePair]:
    """Cameras that keep power until every client has let go: on a dead one Aravis takes seconds for that."""
    with pair_of(addresses, size) as pair:
        yield pair
        until = time.monotonic() + 10
        while time.monotonic() < until and any(t.name.startswith("binpick-cam-") for t in threading.enumerate()):
            time.sleep(0.01)


@pytest.fixture
def gige(gige_addresses: tuple[str, str]) -> Iterator[GigePair]:
    with running(gige_addresses) as pair:
        yield pair


@pytest.fixture
def two(gige: GigePair, gige_addresses: tuple[str, str]) -> Iterator[tuple[Camera, Camera]]:
    """Two Aravis cameras, open."""
    cameras = aravis(gige_addresses)
    for camera in cameras:
        camera.open(within(5))
    yield cameras
    for camera in cameras:
        camera.close()


@pytest.fixture
def group(gige: GigePair, gige_addresses: tuple[str, str]) -> Iterator[CameraGroup]:
    group = CameraGroup(aravis(gige_addresses), max_skew_us=1_000_000.0)
    group.open(within(5))
    yield group
    group.close()


@pytest.fixture(params=["files", "in-process", pytest.param("aravis", marks=pytest.mark.gige)])
def cameras(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[Camera, Camera]]:
    """Both cameras of a backend, closed."""
    if request.param == "files":
        for index, name in enumerate(("left", "right")):
            cv2.imwrite(str(tmp_path / f"{name}.png"), coded(index, 1))
        yield backends.make(FileCameras(backend="files", left=tmp_path / "left.png", right=tmp_path / "right.png"))
        return
    if request.param == "in-process":
        yield SimCamera(0, lambda index, _light, shot: coded(index, shot)), SimCamera(
            1, lambda index, _light, shot: coded(index, shot))
        return
    addresses = request.getfixturevalue("gige_addresses")
    with running(addresses):
        both = aravis(addresses)
        yield both
        for camera in both:
            camera.close()


def test_frame_of_a_trigger(cameras: tuple[Camera, Camera]) -> None:
    for index, camera in enumerate(cameras):
        camera.open(within(5))
        camera.configure(LIGHT, within(2))
        before = time.monotonic_ns()
        camera.trigger(1, within(2))
        frame = camera.grab(1, within(3))
        assert frame.camera == camera.name == ("left", "right")[index]
        assert frame.sequence == 1
        assert np.array_equal(frame.image, coded(index, 1))
        assert before <= frame.triggered_ns <= frame.received_ns <= time.monotonic_ns()
        assert frame.exposure_us == pytest.approx(LIGHT.exposure_us, rel=0.01)
        assert frame.gain_db == pytest.approx(LIGHT.gain_db, abs=0.1)
        assert frame.missing == 0


def test_status_tells_what_it_is(cameras: tuple[Camera, Camera]) -> None:
    camera = cameras[0]
    assert not camera.status().connected
    camera.open(within(5))
    camera.configure(LIGHT, within(2))
    camera.trigger(1, within(2))
    camera.grab(1, within(3))
    status = camera.status()
    assert status.connected
    assert status.name == "left"
    assert status.simulated
    assert status.model
    assert (status.frames, status.failures, status.error) == (1, 0, "")
    camera.close()
    assert not camera.status().connected


def test_frames_are_counted_in_order(cameras: tuple[Camera, Camera]) -> None:
    camera = cameras[1]
    camera.open(within(5))
    camera.configure(LIGHT, within(2))
    ids = []
    for sequence in (3, 4, 9):
        camera.trigger(sequence, within(2))
        frame = camera.grab(sequence, within(3))
        assert frame.sequence == sequence
        ids.append(frame.frame_id)
    assert ids == list(range(ids[0], ids[0] + 3))


def test_a_closed_camera_refuses(cameras: tuple[Camera, Camera]) -> None:
    camera = cameras[0]
    verbs: list[Callable[[], object]] = [
        lambda: camera.configure(LIGHT, within(1)), lambda: camera.trigger(1, within(1)), lambda: camera.grab(1, within(1))]
    for verb in verbs:
        with pytest.raises(CameraLost, match="left"):
            verb()
    camera.close()


def test_without_a_trigger_there_is_no_frame(cameras: tuple[Camera, Camera], clock: Callable[[], float]) -> None:
    camera = cameras[0]
    camera.open(within(5))
    camera.configure(LIGHT, within(2))
    start = clock()
    with pytest.raises(CameraLost, match="left") as caught:
        camera.grab(1, within(0.3))
    assert clock() - start < 0.5
    assert caught.value.camera == "left"


def test_closing_twice_and_opening_again(cameras: tuple[Camera, Camera], clock: Callable[[], float]) -> None:
    camera = cameras[0]
    for sequence in (1, 2):
        camera.open(within(5))
        camera.configure(LIGHT, within(2))
        camera.trigger(sequence, within(2))
        assert camera.grab(sequence, within(3)).sequence == sequence
        start = clock()
        camera.close()
        camera.close()
        assert clock() - start < 1


def test_group_makes_pairs(cameras: tuple[Camera, Camera]) -> None:
    group = CameraGroup(cameras, max_skew_us=math.inf)       # nothing is proved of images from disk
    group.open(within(5))
    first, second = group.capture(LIGHT, within(3)), group.capture(LIGHT, within(3))
    assert (first.left.camera, first.right.camera) == ("left", "right")
    assert first.left.sequence == first.right.sequence == second.left.sequence - 1
    assert abs(first.skew_us) < 1_000_000
    assert not first.left.image.flags.writeable
    assert first.proof in ("none", "interval", "latch", "ptp")
    group.close()
    assert [status.connected for status in group.statuses()] == [False, False]


def test_unreadable_files_are_named(tmp_path: Path) -> None:
    text = tmp_path / "left.png"
    text.write_text("no image")
    left, right = backends.make(FileCameras(backend="files", left=text, right=tmp_path / "gone.png"))
    with pytest.raises(ImageError, match=r"left\.png: not an image"):
        left.open(within(1))
    with pytest.raises(ImageError, match=r"gone\.png.*No such file"):
        right.open(within(1))


@pytest.mark.gige
def test_fifty_full_size_pairs_arrive_bit_exact(gige_addresses: tuple[str, str], clock: Callable[[], float]) -> None:
    images = [coded(index, 0, FULL) for index in (0, 1)]
    shoot = GigePair(lambda index, _light, shot: images[index] + np.uint8(shot), gige_addresses, FULL)
    with shoot, contextlib.closing(CameraGroup(aravis(gige_addresses), max_skew_us=1_000_000.0)) as group:
        group.open(within(5))
        failures = [0, 0]
        for shot in range(1, 51):
            held_s = time.monotonic() - clock()
            pair = group.capture(LIGHT, within(3))
            for index, frame in enumerate((pair.left, pair.right)):
                assert frame.frame_id >= shot
                assert np.array_equal(frame.image, images[index] + np.uint8(frame.frame_id)), (index, shot)
            known, failures = failures, [status.failures for status in group.statuses()]
            assert failures == known or time.monotonic() - clock() - held_s > 0.1       # by the machine


@pytest.mark.gige
def test_lost_packets_are_sent_again(gige_addresses: tuple[str, str]) -> None:
    with running(gige_addresses, FULL) as gige, contextlib.closing(
            CameraGroup(aravis(gige_addresses, packet_size=1500), max_skew_us=1_000_000.0)) as group:
        group.open(within(5))
        gige.drop_packets(0.02, seed=5)
        for _ in range(5):
            pair = group.capture(LIGHT, within(3))
            for index, frame in enumerate((pair.left, pair.right)):
                assert np.array_equal(frame.image, coded(index, frame.frame_id, FULL))
                assert frame.resends > 0
        assert min(gige.resent(0), gige.resent(1)) > 5 * 20      # of 1609 packets a frame, 32 on average are lost


@contextlib.contextmanager
def tearing(addresses: tuple[str, str], images: int) -> Iterator[CameraGroup]:
    """A group whose first images lose some of their packets for good."""
    def image(index: int, _light: Light, shot: int) -> Image:
        pair.drop_packets(0.05 if shot <= images else 0.0, seed=shot, resends=shot > images)
        return coded(index, shot)

    pair = GigePair(image, addresses, (WIDTH, HEIGHT))
    with pair, contextlib.closing(CameraGroup(aravis(addresses, packet_size=1500), max_skew_us=1_000_000.0)) as group:
        group.open(within(5))
        yield group


@pytest.mark.gige
def test_an_incomplete_image_is_shot_again(gige_addresses: tuple[str, str]) -> None:
    with tearing(gige_addresses, 1) as group:
        pair = group.capture(LIGHT, within(3))
        assert [frame.frame_id for frame in (pair.left, pair.right)] == [2, 2]
        assert np.array_equal(pair.right.image, coded(1, 2))
        assert [(s.connected, s.error, s.frames, s.failures) for s in group.statuses()] == [(True, "", 1, 1)] * 2


@pytest.mark.gige
def test_an_image_that_stays_incomplete_is_refused(gige_addresses: tuple[str, str]) -> None:
    with tearing(gige_addresses, 3) as group:
        with pytest.raises(PairRefused, match=r"left: the image came incomplete .*right: the image came incomplete"):
            group.capture(LIGHT, within(5))
        assert [(status.connected, status.failures) for status in group.statuses()] == [(True, 3), (True, 3)]
        assert group.capture(LIGHT, within(3)).left.frame_id == 4


def stall(process: subprocess.Popen[bytes], seconds: float) -> None:
    process.send_signal(signal.SIGSTOP)
    time.sleep(seconds)
    process.send_signal(signal.SIGCONT)


@pytest.mark.gige
def test_cameras_that_stand_still_for_half_a_second_are_waited_for(gige_addresses: tuple[str, str]) -> None:
    with (subprocess.Popen([sys.executable, "-c", SENDER, *gige_addresses], stdin=subprocess.PIPE,
                           stdout=subprocess.PIPE) as sender,
          contextlib.closing(CameraGroup(aravis(gige_addresses), max_skew_us=1_000_000.0)) as group):
        assert sender.stdout is not None
        assert sender.stdout.readline() == b"up\n"
        group.open(within(5))
        for shot, delay_s in enumerate((0.0, 0.005, 0.01, 0.015, 0.02, 0.025)):      # an image takes 3 ms and then 13 ms
            stalling = threading.Timer(delay_s, stall, (sender, 0.5))
            stalling.start()
            pair = group.capture(LIGHT, within(5))
            stalling.join()
            assert [frame.image.min() for frame in (pair.left, pair.right)] == [pair.left.frame_id, pair.right.frame_id]
            assert pair.left.frame_id > shot
        assert [(status.connected, status.error) for status in group.statuses()] == [(True, "")] * 2


@pytest.mark.gige
def test_a_link_that_loses_nearly_everything_gives_no_image(gige: GigePair, group: CameraGroup) -> None:
    gige.drop_packets(0.97, seed=1)
    with pytest.raises(CameraError, match=r"left( took the trigger but sent no image|: the image came incomplete)"):
        group.capture(LIGHT, within(5))
    gige.drop_packets(0.0, seed=1)
    group.open(within(5))
    assert group.capture(LIGHT, within(3)).left.missing == 0


@pytest.mark.gige
def test_an_image_that_nobody_asked_for_is_never_taken_for_the_next(gige: GigePair, group: CameraGroup) -> None:
    for _ in range(2):
        group.capture(LIGHT, within(3))
    gige.misfire(0)
    time.sleep(0.1)
    with pytest.raises(CameraLost, match="left sent an image that it was not triggered for"):
        group.capture(LIGHT, within(3))
    group.open(within(5))
    assert group.capture(LIGHT, within(3)).left.frame_id == 1


@pytest.mark.gige
def test_cameras_killed_in_mid_exposure(gige: GigePair, group: CameraGroup, clock: Callable[[], float]) -> None:
    group.capture(LIGHT, within(3))
    killers = [threading.Timer(0.1, gige.kill, (index,)) for index in (0, 1)]
    for killer in killers:
        killer.start()
    start = clock()
    with pytest.raises(CameraLost, match=r"left.*right"):
        group.capture(Light(exposure_us=300_000.0, gain_db=0.0, projector=False), within(10))
    assert clock() - start < 2
    assert all(status.error and not status.connected for status in group.statuses())
    start = clock()
    group.close()
    assert clock() - start < 1
    for index in (0, 1):
        gige.restart(index)
    group.open(within(5))
    assert [status.error for status in group.statuses()] == ["", ""]
    assert np.array_equal(group.capture(LIGHT, within(3)).right.image, coded(1, 1))


@pytest.mark.gige
def test_a_dead_camera_delays_no_verb(gige: GigePair, group: CameraGroup, clock: Callable[[], float]) -> None:
    gige.kill(1)
    start = clock()
    with pytest.raises(CameraLost, match="right stopped answering while setting") as caught:
        group.capture(LIGHT, within(10))
    assert clock() - start < 1.5
    assert caught.value.camera == "right"
    left, right = group.statuses()
    assert (left.connected, left.error) == (True, "")
    assert not right.connected
    with pytest.raises(CameraNotFound, match="right"):
        group.open(within(5))
    gige.restart(1)
    group.open(within(5))
    assert group.capture(LIGHT, within(3)).right.frame_id == 1


@pytest.mark.gige
def test_a_frozen_camera_is_named_and_the_other_stays_open(gige: GigePair, group: CameraGroup) -> None:
    group.capture(LIGHT, within(3))
    gige.change(0, sends=False)
    with pytest.raises(CameraLost, match="left took the trigger but sent no image"):
        group.capture(LIGHT, within(10))
    assert [status.connected for status in group.statuses()] == [False, True]
    gige.restart(0)
    group.open(within(5))
    pair = group.capture(LIGHT, within(3))
    assert pair.right.frame_id >= 3           # the frame that nobody fetched is not taken for this one's
    assert np.array_equal(pair.right.image, coded(1, pair.right.frame_id))


@pytest.mark.gige
def test_a_held_camera_is_refused_and_not_disturbed(two: tuple[Camera, Camera], gige_addresses: tuple[str, str]) -> None:
    intruder, _ = aravis(gige_addresses)
    with pytest.raises(CameraHeld, match=r"left .*another program"):
        intruder.open(within(5))
    two[0].configure(LIGHT, within(2))
    two[0].trigger(1, within(2))
    assert two[0].grab(1, within(3)).frame_id == 1


@pytest.mark.gige
def test_nobody_there(clock: Callable[[], float]) -> None:
    camera, _ = aravis((NOBODY, NOBODY))
    start = clock()
    with pytest.raises(CameraNotFound, match=f"no camera answers at {NOBODY}: check power, cable and the address"):
        camera.open(within(5))
    assert clock() - start < 2
    assert "no camera answers" in camera.status().error


@pytest.mark.gige
def test_found_by_serial_number(gige: GigePair) -> None:
    _, right = backends.make(AravisCameras(left=CameraAddress(serial="?"),
                                           right=CameraAddress(serial=gige.identities[1].serial)))
    right.open(within(5))
    assert right.status().address == gige.identities[1].address
    right.close()
    left, _ = backends.make(AravisCameras(left=CameraAddress(serial="NOSUCH"), right=CameraAddress(serial="NOSUCH")))
    with pytest.raises(CameraNotFound, match="no camera with serial number 'NOSUCH'"):
        left.open(within(5))


@pytest.mark.gige
def test_exchanged_cameras_are_noticed(gige: GigePair) -> None:
    left, right = gige.identities
    camera, _ = backends.make(AravisCameras(left=CameraAddress(address=left.address, serial=right.serial)))
    with pytest.raises(CameraNotFound, match="exchanged"):
        camera.open(within(5))


@pytest.mark.gige
def test_the_exposure_elapses_and_a_trigger_meanwhile_is_missed(gige: GigePair, two: tuple[Camera, Camera]) -> None:
    camera = two[0]
    camera.configure(Light(exposure_us=200_000.0, gain_db=0.0, projector=True), within(2))
    camera.trigger(1, within(2))
    frame = camera.grab(1, within(3))
    assert frame.received_ns - frame.triggered_ns >= 200_000_000
    camera.trigger(2, within(2))
    camera.trigger(3, within(2))
    assert gige.missed_triggers(0) == 1
    with pytest.raises(CameraLost):           # the frame of trigger 2 is never taken for that of 3
        camera.grab(3, within(1))


@pytest.mark.gige
def test_the_left_line_fires_the_projector_for_both(gige_addresses: tuple[str, str]) -> None:
    seen: list[tuple[int, float, float, bool]] = []

    def image(index: int, light: Light, _shot: int) -> Image:
        seen.append((index, light.exposure_us, light.gain_db, light.projector))
        return coded(0, 0)

    with GigePair(image, gige_addresses, (WIDTH, HEIGHT)):
        group = CameraGroup(aravis(gige_addresses), max_skew_us=1_000_000.0)
        group.open(within(5))
        group.capture(Light(2500.0, 3.0, projector=True), within(3))
        group.capture(Light(2500.0, 3.0, projector=False), within(3))
        group.close()
    assert sorted(seen[:2]) == [(0, 2500.0, 3.0, True), (1, 2500.0, 3.0, True)]
    assert sorted(seen[2:]) == [(0, 2500.0, 3.0, False), (1, 2500.0, 3.0, False)]


@pytest.mark.gige
def test_the_simulator_stops_within_a_second_and_names_a_port_in_use(gige: GigePair, gige_addresses: tuple[str, str],
                                                                     clock: Callable[[], float]) -> None:
    with pytest.raises(PortInUse, match="3956"):
        pair_of(gige_addresses).start()
    start = clock()
    gige.stop()
    assert clock() - start < 1
