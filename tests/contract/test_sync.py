"""The sync modes over real packets: what a pair states of its skew, against what the simulated cameras really did."""

import contextlib
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from binpick.camera import backends, starter
from binpick.camera.aravis import AravisCamera, Setup, timekeeper
from binpick.camera.group import CameraGroup
from binpick.camera.sync import Step
from binpick.data import Image, Light, StereoPair
from binpick.errors import CameraError, PairRefused
from binpick.settings.cell import AravisCameras, CameraAddress, Sync
from binpick.sim.gige import GigeGroup
from binpick.sim.gige.ptp import Oscillator

WIDTH, HEIGHT = 320, 200
LIGHT = Light(exposure_us=2000.0, gain_db=0.0, projector=False)

pytestmark = pytest.mark.gige


def within(seconds: float) -> int:
    return time.monotonic_ns() + int(seconds * 1e9)


def image(index: int, _light: Light, shot: int) -> Image:
    return np.full((HEIGHT, WIDTH), (16 * shot + index) % 256, np.uint8)


def addresses_of(pair: tuple[str, str], cameras: int = 2) -> tuple[str, ...]:
    return tuple(f"{pair[0].rpartition('.')[0]}.{2 + index}" for index in range(cameras))


@contextlib.contextmanager
def cell(addresses: tuple[str, ...], *, apart: bool = False, settle_s: float = 0.1, skew_us: float = 0.0,
         max_skew_us: float = 1_000_000.0, **more: object) -> Iterator[tuple[GigeGroup, CameraGroup]]:
    """Simulated cameras, and the group that an integrator's cell file makes of them, open."""
    rig = GigeGroup(image, addresses, (WIDTH, HEIGHT), settle_s=settle_s, apart=apart)
    left, right, *others = (CameraAddress(address=address) for address in addresses)
    settings = AravisCameras(left=left, right=right, more=tuple(others), max_skew_us=max_skew_us, **more)
    with rig, contextlib.closing(backends.group(settings)) as group:
        rig.change(1, skew_us=skew_us)
        group.open(within(5))
        yield rig, group


def capture(group: CameraGroup) -> StereoPair:
    return group.capture(LIGHT, within(5))


def proved(group: CameraGroup, proof: str) -> None:
    """Waits until pairs are proved so; PTP and the first latches take a moment."""
    until = time.monotonic() + 10
    while capture(group).proof != proof:
        assert time.monotonic() < until, group.statuses()


def true_us(rig: GigeGroup, pair: StereoPair) -> float:
    left, right = ({entry.block: entry for entry in rig.truth(index)}[frame.frame_id]
                   for index, frame in enumerate((pair.left, pair.right)))
    return (right.started_ns - left.started_ns) / 1000


@pytest.mark.parametrize(("sync", "apart"), [
    ("line", False), ("scheduled_action", False), ("action", False), ("software", False), ("line", True), ("action", True),
    ("software", True)])
def test_the_reported_skew_is_the_true_one(gige_addresses: tuple[str, str], sync: Sync, apart: bool) -> None:
    with cell(gige_addresses, apart=apart, sync=sync, skew_us=300.0) as (rig, group):
        rig.ptp.tune(1, Oscillator(-1_000_000_000, 50_000), time.time_ns())
        proved(group, "latch" if apart else "ptp")
        for _ in range(10):
            pair = capture(group)
            true = true_us(rig, pair)
            assert abs(pair.skew_us - true) <= 3 * pair.sigma_us, (pair.skew_us, pair.sigma_us, true)
            assert pair.proof == ("latch" if apart else "ptp")
            assert apart or pair.sigma_us <= 2          # without a common clock it is as good as the machine is quiet
            assert true > 200


def test_a_pair_that_may_be_beyond_the_limit_is_refused_and_counted(gige_addresses: tuple[str, str]) -> None:
    with cell(gige_addresses, sync="line", max_skew_us=400.0) as (rig, group):
        proved(group, "ptp")
        rig.change(1, skew_us=500.0)
        before = group.statuses()[0].refused
        with pytest.raises(PairRefused, match=r"by ptp\), more than the 400 µs allowed"):
            capture(group)
        assert group.statuses()[0].refused == before + 3
        rig.change(1, skew_us=300.0)
        assert abs(capture(group).skew_us - 320) < 10


def test_cameras_that_cannot_hear_each_other_get_no_time_for_all(gige_addresses: tuple[str, str]) -> None:
    with cell(gige_addresses, apart=True, sync="scheduled_action") as (_, group):
        with pytest.raises(PairRefused, match=r"do not keep together by PTP \(left Master, right Master\)"):
            group.capture(LIGHT, within(1.5))
        assert all(status.connected for status in group.statuses())


def test_ptp_that_falls_back_costs_the_proof_and_no_pair(gige_addresses: tuple[str, str]) -> None:
    with cell(gige_addresses, sync="software") as (rig, group):
        proved(group, "ptp")
        rig.ptp.force(1, "Listening", time.time_ns())
        proved(group, "latch")
        assert [status.ptp for status in group.statuses()] == ["Master", "Listening"]
        for _ in range(3):
            pair = capture(group)
            assert abs(pair.skew_us - true_us(rig, pair)) <= 3 * pair.sigma_us
        rig.ptp.force(1, "", time.time_ns())
        proved(group, "ptp")


def test_a_ptp_that_got_stuck_is_started_anew(gige_addresses: tuple[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timekeeper, "PATIENCE_NS", 2_000_000_000)
    with cell(gige_addresses, settle_s=1.0) as (rig, group):         # so long at least there is a pair to be seen without it
        proved(group, "ptp")
        rig.ptp.enable(1, False, time.time_ns())          # though the camera's feature still says that it is on
        proved(group, "latch")
        until = time.monotonic() + 10
        while [status.ptp for status in group.statuses()] != ["Master", "Slave"]:
            assert time.monotonic() < until
            time.sleep(0.02)
        proved(group, "ptp")


def test_an_action_that_comes_late_is_refused_and_costs_no_camera(gige_addresses: tuple[str, str],
                                                                  monkeypatch: pytest.MonkeyPatch) -> None:
    with cell(gige_addresses, sync="scheduled_action") as (_, group):
        proved(group, "ptp")
        monkeypatch.setattr(starter, "LEAD_NS", -50_000_000)
        with pytest.raises(PairRefused, match="camera left did not take the action command: it came late"):
            capture(group)
        monkeypatch.undo()
        assert capture(group).proof == "ptp"
        assert [(status.connected, status.failures) for status in group.statuses()] == [(True, 0)] * 2


def test_a_missing_wire_is_named(gige_addresses: tuple[str, str]) -> None:
    with cell(gige_addresses, sync="line") as (rig, group):
        rig.change(1, wired=False)
        with pytest.raises(CameraError, match=r"camera right .* no image"):
            capture(group)
        rig.change(1, wired=True)
        group.open(within(5))
        proved(group, "ptp")


def test_what_the_camera_does_not_accept_is_named_before_the_first_image(gige_addresses: tuple[str, str]) -> None:
    wrong = [(Step("TriggerSource", "Line9"), r"TriggerSource should be Line9, but is Software \(.*Line9.*\)"),
             (Step("GevHeartbeatTimeout", 7), "GevHeartbeatTimeout should be 7, but is 3000"),
             (Step("NoSuchThing", "On"), "NoSuchThing should be On, but it is not there"),
             (Step("SensorWidth", 1), f"SensorWidth should be 1, but is {WIDTH}")]
    with GigeGroup(image, gige_addresses, (WIDTH, HEIGHT)):
        for step, said in wrong:
            camera = AravisCamera("left", gige_addresses[0], "", Setup((step,)))
            with pytest.raises(CameraError, match=f"camera left: {said}"):
                camera.open(within(5))
            camera.close()
        camera = AravisCamera("left", gige_addresses[0], "", Setup((Step("NoSuchThing", "On", optional=True),)))
        camera.open(within(5))
        camera.close()


def test_light_that_the_camera_cannot_give_is_named(gige_addresses: tuple[str, str]) -> None:
    wrong = "left: Gain should be 40, but this camera's range is 0 to 24"
    with cell(gige_addresses) as (_, group), pytest.raises(CameraError, match=wrong):
        group.capture(replace(LIGHT, gain_db=40.0), within(3))


@pytest.mark.parametrize("sync", ["line", "action", "software"])
def test_five_cameras_are_triggered_together(gige_addresses: tuple[str, str], sync: Sync) -> None:
    addresses = addresses_of(gige_addresses, 5)
    with cell(addresses, sync=sync) as (rig, group):
        rig.change(3, skew_us=9000.0)
        proved(group, "ptp")
        pair = capture(group)
        assert [frame.camera for frame in pair.frames] == ["left", "right", "third", "fourth", "fifth"]
        assert [int(frame.image[0, 0]) % 16 for frame in pair.frames] == [0, 1, 2, 3, 4]
        begun_ns = [{entry.block: entry.started_ns for entry in rig.truth(index)}[frame.frame_id]
                    for index, frame in enumerate(pair.frames)]
        assert abs(abs(pair.skew_us) - (max(begun_ns) - min(begun_ns)) / 1000) <= 3 * pair.sigma_us
        assert abs(pair.skew_us) > 8000
        assert len({frame.sequence for frame in pair.frames}) == 1


@pytest.mark.parametrize("pixel_format", ["Mono10", "Mono10p", "Mono12", "Mono12p", "Mono12Packed", "BayerRG8"])
def test_every_pixel_format_becomes_the_same_grey(gige_addresses: tuple[str, str], pixel_format: str) -> None:
    with cell(gige_addresses, pixel_format=pixel_format) as (_, group):
        pair = capture(group)
        for index, frame in enumerate(pair.frames):
            assert np.array_equal(frame.image, image(index, LIGHT, frame.frame_id))


def test_another_pixel_format_than_asked_for_is_never_an_image(gige_addresses: tuple[str, str]) -> None:
    with cell(gige_addresses) as (rig, group):
        capture(group)
        rig.change(1, pixel_format="Mono12p")
        with pytest.raises(CameraError, match="camera right: the image came as Mono12p, not as Mono8"):
            capture(group)
        rig.change(1, pixel_format="")
        group.open(within(5))
        capture(group)


@pytest.mark.parametrize(("mtu", "packet_size"), [(16_000, "auto"), (9000, "auto"), (1500, "auto"), (16_000, 4000)])
def test_packets_are_as_large_as_arrive(gige_addresses: tuple[str, str], mtu: int, packet_size: str | int) -> None:
    rig = GigeGroup(image, gige_addresses, (WIDTH, HEIGHT))
    left, right = (CameraAddress(address=address) for address in gige_addresses)
    group = backends.group(AravisCameras(left=left, right=right, packet_size=packet_size, max_skew_us=1_000_000.0))
    with rig, contextlib.closing(group):
        for index in rig.heads:
            rig.change(index, mtu=mtu)
        group.open(within(5))
        found = [status.packet_size for status in group.statuses()]
        assert found == [4000, 4000] if packet_size == 4000 else all(mtu - 8 <= size <= mtu for size in found)
        capture(group)


def test_an_image_is_always_newer_than_its_trigger(gige_addresses: tuple[str, str]) -> None:
    """Images that are held back by the network, or that nobody fetched, are never taken for those of the next trigger."""
    with cell(gige_addresses, sync="line") as (rig, group):
        proved(group, "ptp")
        for shot in range(12):
            if shot % 3 == 1:                    # one that nobody fetches
                for camera in group._cameras[::-1]:
                    (camera.arm if camera.name == "right" else camera.trigger)(1000 + shot, within(1))
                time.sleep(0.2)
            host_ns = time.time_ns()
            pair = capture(group)
            for index, frame in enumerate(pair.frames):
                entry = {entry.block: entry for entry in rig.truth(index)}[frame.frame_id]
                assert entry.started_ns >= host_ns
                assert int(frame.image[0, 0]) == (16 * entry.shot + index) % 256
                assert frame.latched_ns is not None
                assert frame.latched_ns[1] >= frame.triggered_ns
