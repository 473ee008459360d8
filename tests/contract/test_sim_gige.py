"""The simulated group as libaravis sees it: clocks, wires, actions, pixel formats, faults, and the truth behind each image."""

import contextlib
import socket
import struct
import time
import zlib
from collections.abc import Callable, Iterator
from typing import Any

import gi
import numpy as np
import pytest

from binpick.data import Image, Light
from binpick.errors import InputError, PortInUse
from binpick.sim.gige import Door, GigeGroup, door, faults, numbered
from binpick.sim.gige.clock import host_ns
from binpick.sim.gige.numbered import Numbered
from binpick.sim.gige.ptp import OSCILLATORS

gi.require_version("Aravis", "0.8")
from gi.repository import Aravis, GLib  # noqa: E402

pytestmark = pytest.mark.gige

WIDTH, HEIGHT = 320, 200
KEY, GROUP, MASK = 0xB1D0, 5, 1
NO_REF_TIME, ACTION_LATE = 0x8013, 0x8016
SETTLE_S = 0.2
LIGHT = Light(2000.0, 0.0, False)


def picture(index: int, _light: Light, shot: int) -> Image:
    return np.random.default_rng(1000 * index + shot).integers(0, 256, (HEIGHT, WIDTH), np.uint8)


class Head:
    """A camera and its stream, armed; everything by SFNC names."""

    def __init__(self, address: str, source: str = "Software", pixel_format: str = "Mono8") -> None:
        self.camera = Aravis.Camera.new(address)
        for name, value in (("PixelFormat", pixel_format), ("TriggerMode", "On"), ("TriggerSource", source),
                            ("TriggerActivation", "RisingEdge")):
            self.camera.set_string(name, value)
        self.camera.set_float("ExposureTime", 2000.0)
        self.camera.gv_set_stream_options(Aravis.GvStreamOption.PACKET_SOCKET_DISABLED)
        self.camera.gv_set_packet_size(8000)
        self.stream = self.camera.create_stream(None, None)
        self.stream.set_property("frame-retention", 500_000)
        for _ in range(6):
            self.stream.push_buffer(Aravis.Buffer.new_allocate(self.camera.get_payload()))
        self.camera.start_acquisition()

    def set_line(self, line: str, **values: Any) -> None:
        self.camera.set_string("LineSelector", line)
        for name, value in values.items():
            self.camera.set_string(name, value)

    def action(self, number: int = 0) -> None:
        self.camera.set_integer("ActionDeviceKey", KEY)
        self.camera.set_integer("ActionSelector", number)
        self.camera.set_integer("ActionGroupKey", GROUP)
        self.camera.set_integer("ActionGroupMask", MASK)

    def now_ns(self) -> int:
        self.camera.execute_command("TimestampLatch")
        return int(self.camera.get_integer("TimestampLatchValue"))

    def grab(self, timeout_s: float = 5.0) -> Any:
        """The next whole image; None when none comes."""
        buffer = self.stream.timeout_pop_buffer(int(timeout_s * 1e6))
        if buffer is not None:
            assert buffer.get_status() == Aravis.BufferStatus.SUCCESS, buffer.get_status()
        return buffer


@pytest.fixture
def group(gige_addresses: tuple[str, str]) -> Iterator[GigeGroup]:
    with GigeGroup(picture, gige_addresses, (WIDTH, HEIGHT), settle_s=SETTLE_S) as group:
        yield group


@pytest.fixture
def heads(group: GigeGroup, gige_addresses: tuple[str, str]) -> Iterator[Callable[..., list[Head]]]:
    """Makes both, and lets go of them while they can still answer."""
    made: list[Head] = []

    def make(*sources: str, pixel_format: str = "Mono8") -> list[Head]:
        for address, source in zip(gige_addresses, sources or ("Software", "Software"), strict=True):
            made.append(Head(address, source, pixel_format))
        return made

    yield make
    made.clear()


def until(condition: Callable[[], bool], limit_s: float = 10.0) -> None:
    start = time.monotonic()
    while not condition():
        assert time.monotonic() - start < limit_s
        time.sleep(0.01)


def synchronise(heads: list[Head]) -> None:
    for head in heads:
        head.camera.set_boolean("PtpEnable", True)
    until(lambda: [head.camera.get_string("PtpStatus") for head in heads] == ["Master", "Slave"])


def command(target: str, answers: int, at_ns: int | None = None, key: int = KEY, mask: int = MASK) -> list[tuple[str, int]]:
    """Sends an action command and returns who acknowledged it with which status; `answers` is how many should."""
    number = time.monotonic_ns() % 65535 + 1
    keys = struct.pack(">III", key, GROUP, mask) + (b"" if at_ns is None else struct.pack(">Q", at_ns))
    flags = 0x01 if at_ns is None else 0x81
    came: list[tuple[str, int]] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender, contextlib.suppress(TimeoutError):
        sender.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        sender.bind(("127.0.0.1", 0))
        sender.settimeout(3.0 if answers else 0.2)
        sender.sendto(struct.pack(">BBHHH", 0x42, flags, 0x0100, len(keys), number) + keys, (target, 3956))
        while not answers or len(came) < answers:
            datagram, (address, _port) = sender.recvfrom(100)
            status, code, _length, answered = struct.unpack(">HHHH", datagram[:8])
            assert (code, answered) == (0x0101, number)
            came.append((address, status))
    return sorted(came)


def starts(group: GigeGroup) -> list[int]:
    return [group.truth(index)[-1].started_ns for index in (0, 1)]


def test_each_head_has_its_own_clock_until_ptp_joins_them(heads: Callable[..., list[Head]]) -> None:
    left, right = heads()
    before, other, after = left.now_ns(), right.now_ns(), left.now_ns()
    apart = OSCILLATORS[0].offset_ns - OSCILLATORS[1].offset_ns
    assert apart > 500e6
    assert before - other - 5e6 < apart < after - other + 5e6          # they drift, too
    assert [head.camera.get_string("PtpStatus") for head in (left, right)] == ["Disabled", "Disabled"]
    left.camera.set_boolean("PtpEnable", True)
    assert left.camera.get_string("PtpStatus") != "Disabled"
    synchronise([left, right])
    before = left.now_ns()
    assert before < right.now_ns() < left.now_ns()
    for head in (left, right):
        head.camera.execute_command("PtpDataSetLatch")
    assert abs(right.camera.get_integer("PtpOffsetFromMaster")) < 100
    assert right.camera.get_string("PtpServoStatus") == "Locked"
    assert right.camera.get_integer("PtpGrandmasterClockID") == left.camera.get_integer("PtpClockID") != 0


def test_time_stamps_are_the_heads_own_and_the_truth_is_the_hosts(group: GigeGroup,
                                                                  heads: Callable[..., list[Head]]) -> None:
    for index, head in enumerate(heads()):
        before = host_ns()
        head.camera.software_trigger()
        after = host_ns()
        image = head.grab()
        [entry] = group.truth(index)
        assert before <= entry.started_ns <= after
        assert (image.get_frame_id(), image.get_timestamp()) == (entry.block, entry.timestamp_ns)
        assert abs(entry.timestamp_ns - entry.started_ns) > 300e6
        assert image.get_data() == bytes(group.sent(index, entry.block)) == picture(index, entry.light, 1).tobytes()


def test_by_wire_the_second_head_exposes_with_the_first(group: GigeGroup, heads: Callable[..., list[Head]]) -> None:
    left, right = heads("Software", "Line0")
    left.set_line("Line1", LineMode="Output", LineSource="ExposureActive")
    left.camera.software_trigger()
    assert left.grab() is not None
    assert right.grab() is not None
    master, slave = starts(group)
    assert 19_000 < slave - master < 21_000
    group.change(1, wired=False)
    left.camera.software_trigger()
    assert left.grab() is not None
    assert right.grab(0.2) is None
    group.change(1, wired=True, skew_us=150.0)
    left.camera.software_trigger()
    assert right.grab() is not None
    assert left.grab() is not None
    master, slave = starts(group)
    assert 169_000 < slave - master < 171_000


def test_a_falling_edge_comes_at_the_exposures_end(group: GigeGroup, heads: Callable[..., list[Head]]) -> None:
    left, right = heads("Software", "Line0")
    left.set_line("Line1", LineMode="Output", LineSource="ExposureActive")
    right.camera.set_string("TriggerActivation", "FallingEdge")
    left.camera.software_trigger()
    assert left.grab() is not None
    assert right.grab() is not None
    master, slave = starts(group)
    assert 2_019_000 < slave - master < 2_021_000


def test_a_broadcast_action_triggers_both(group: GigeGroup, heads: Callable[..., list[Head]],
                                          gige_addresses: tuple[str, str]) -> None:
    both = heads("Action0", "Action1")
    for number, head in enumerate(both):
        head.action(number)
    for shots, target in enumerate(("255.255.255.255", "127.255.255.255"), 1):
        assert command(target, 2) == [(address, 0) for address in gige_addresses]
        assert [head.grab().get_frame_id() for head in both] == [shots, shots]
        left, right = starts(group)
        assert left == right
    assert command(gige_addresses[0], 1) == [(gige_addresses[0], 0)]
    assert both[0].grab() is not None
    assert command("127.255.255.255", 0, key=KEY + 1) == []
    assert command("127.255.255.255", 0, mask=MASK << 1) == []
    assert both[1].grab(0.1) is None


def test_a_scheduled_action_needs_a_common_time_and_hits_it(group: GigeGroup, heads: Callable[..., list[Head]],
                                                            gige_addresses: tuple[str, str]) -> None:
    both = heads("Action0", "Action0")
    for head in both:
        head.action()
    at_ns = both[0].now_ns() + 300_000_000
    assert command("127.255.255.255", 2, at_ns) == [(address, NO_REF_TIME) for address in gige_addresses]
    synchronise(both)
    at_ns = both[0].now_ns() + 300_000_000
    assert command("127.255.255.255", 2, at_ns) == [(address, 0) for address in gige_addresses]
    for index, head in enumerate(both):
        assert abs(head.grab().get_timestamp() - at_ns) <= 1
        assert group.truth(index)[-1].timestamp_ns == pytest.approx(at_ns, abs=1)
    left, right = starts(group)
    assert 0 < abs(left - right) < 1000                      # PTP's own residue
    assert command("127.255.255.255", 2, at_ns) == [(address, ACTION_LATE) for address in gige_addresses]
    assert [head.grab() is None for head in both] == [False, False]


def test_a_trigger_during_exposure_is_dropped_and_counted(group: GigeGroup, heads: Callable[..., list[Head]]) -> None:
    left, _right = heads()
    left.camera.set_float("ExposureTime", 500_000.0)
    for _ in range(3):
        left.camera.software_trigger()
    assert left.grab().get_frame_id() == 1
    assert left.grab(0.3) is None
    assert (group.missed_triggers(0), len(group.truth(0))) == (2, 1)


@pytest.mark.parametrize(("name", "size"), [("Mono10", 2.0), ("Mono10p", 1.25), ("Mono12", 2.0), ("Mono12p", 1.5),
                                            ("Mono12Packed", 1.5), ("BayerRG8", 1.0)])
def test_pixel_formats(group: GigeGroup, heads: Callable[..., list[Head]], name: str, size: float) -> None:
    left, _right = heads(pixel_format=name)
    left.camera.software_trigger()
    image = left.grab()
    assert left.camera.get_payload() == WIDTH * HEIGHT * size == len(image.get_data())
    assert image.get_image_pixel_format() == {
        "Mono10": Aravis.PIXEL_FORMAT_MONO_10, "Mono12": Aravis.PIXEL_FORMAT_MONO_12,
        "Mono12Packed": Aravis.PIXEL_FORMAT_MONO_12_PACKED, "BayerRG8": Aravis.PIXEL_FORMAT_BAYER_RG_8,
        "Mono10p": 0x010A0046, "Mono12p": 0x010C0047}[name]             # PFNC; Aravis knows neither
    assert image.get_data() == bytes(group.sent(0, 1))


def test_auto_exposure_finds_its_grey(gige_addresses: tuple[str, str]) -> None:
    def grey(_index: int, light: Light, _shot: int) -> Image:
        return np.full((HEIGHT, WIDTH), min(255, round(light.exposure_us / 80)), np.uint8)

    with GigeGroup(grey, gige_addresses, (WIDTH, HEIGHT)):
        head = Head(gige_addresses[0])
        head.camera.set_string("ExposureAuto", "Once")
        for _ in range(4):
            head.camera.software_trigger()
            head.grab()
        assert head.camera.get_string("ExposureAuto") == "Off"
        assert head.camera.get_float("ExposureTime") == pytest.approx(8000, rel=0.05)
        del head


def alive(address: str) -> bool:
    """Whether it answers a discovery."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(0.5)
        client.connect((address, 3956))
        try:
            client.send(bytes.fromhex("4201000200000001"))
            return len(client.recv(1000)) == 256
        except OSError:
            return False


def do(group: GigeGroup, *words: str) -> None:
    for text in words:
        faults.apply(group, faults.parse(text))


def shoot(head: Head) -> Any:
    head.camera.software_trigger()
    return head.grab()


@pytest.mark.parametrize("fault", ["loss=0.2", "duplicate=0.3", "reorder=0.5", "late=0.1", "early_leader"])
def test_a_bad_way_costs_no_pixel(group: GigeGroup, heads: Callable[..., list[Head]], fault: str) -> None:
    left, _right = heads()
    left.stream.set_property("packet-request-ratio", 1.0)
    left.camera.set_float("ExposureTime", 20_000.0)
    do(group, f"{fault}@left")
    for shot in range(1, 6):
        assert shoot(left).get_data() == picture(0, LIGHT, shot).tobytes()
    assert group.resent(0) > 0 or not fault.startswith("loss")


def test_without_resends_what_is_lost_stays_lost(group: GigeGroup, heads: Callable[..., list[Head]]) -> None:
    left, right = heads()
    do(group, "loss=0.3", "resends=off")
    left.camera.software_trigger()
    buffer = left.stream.timeout_pop_buffer(2_000_000)
    assert buffer is None or buffer.get_status() != Aravis.BufferStatus.SUCCESS
    do(group, "clear")
    assert shoot(right).get_data() == bytes(group.sent(1, 1))


def test_packets_beyond_the_mtu_do_not_get_through(group: GigeGroup, gige_addresses: tuple[str, str]) -> None:
    do(group, "mtu=1500@left")
    for address, limit in zip(gige_addresses, (1500, 16_000), strict=True):
        camera = Aravis.Camera.new(address)
        camera.gv_set_stream_options(Aravis.GvStreamOption.PACKET_SOCKET_DISABLED)
        assert limit - 8 <= camera.gv_auto_packet_size() <= limit
        del camera


def test_a_slow_link_and_a_gap_between_packets_take_their_time(group: GigeGroup, heads: Callable[..., list[Head]]) -> None:
    left, _right = heads()

    def took_s() -> float:
        start = time.monotonic()
        assert shoot(left) is not None
        return time.monotonic() - start

    bits, packets = 8 * WIDTH * HEIGHT, WIDTH * HEIGHT / 7964
    do(group, "link=4")
    assert took_s() > bits / 4e6 * 0.9
    do(group, "link=1000")
    left.camera.gv_set_packet_delay(10_000_000)
    assert took_s() > (packets - 1) * 0.01
    left.camera.gv_set_packet_delay(0)
    left.camera.set_integer("DeviceLinkThroughputLimit", 32_375_000)
    assert took_s() > bits / 8 / 32_375_000


def test_another_pixel_format_than_it_was_told(group: GigeGroup, heads: Callable[..., list[Head]]) -> None:
    left, _right = heads()
    do(group, "pixel_format=BayerRG8@left")
    assert shoot(left).get_image_pixel_format() == Aravis.PIXEL_FORMAT_BAYER_RG_8
    assert left.camera.get_string("PixelFormat") == "Mono8"
    do(group, "pixel_format=off@left")
    assert shoot(left).get_image_pixel_format() == Aravis.PIXEL_FORMAT_MONO_8


def test_a_head_that_hangs_is_silent_and_goes_on(group: GigeGroup, heads: Callable[..., list[Head]],
                                                 gige_addresses: tuple[str, str]) -> None:
    left, right = heads("Software", "Line0")
    left.set_line("Line1", LineMode="Output", LineSource="ExposureActive")
    do(group, "freeze@right")
    assert [alive(address) for address in gige_addresses] == [True, False]
    assert shoot(left) is not None
    assert right.grab(0.1) is None
    assert group.truth(1) == ()
    do(group, "freeze=off@right", "unplug@right")
    assert not alive(gige_addresses[1])
    assert shoot(left) is not None
    assert right.grab(0.1) is None
    assert [entry.sent for entry in group.truth(1)] == [False]         # exposed, by wire
    do(group, "unplug=off@right", "mute@right")
    assert alive(gige_addresses[1])
    assert shoot(left) is not None
    assert right.grab(0.1) is None
    do(group, "mute=off")
    assert shoot(left) is not None
    assert right.grab().get_frame_id() == 3


def test_device_reset_loses_what_was_set(group: GigeGroup, heads: Callable[..., list[Head]],
                                         gige_addresses: tuple[str, str]) -> None:
    left, _right = heads()
    left.camera.set_float("ExposureTime", 1234.0)
    left.camera.set_boolean("PtpEnable", True)
    left.camera.execute_command("DeviceReset")
    until(lambda: not alive(gige_addresses[0]))
    until(lambda: alive(gige_addresses[0]))
    assert left.camera.get_string("PtpStatus") == "Disabled"
    with pytest.raises(GLib.Error, match="access-denied"):
        left.camera.set_float("ExposureTime", 1234.0)
    do(group, "reboot=1@right", "power=off@left")
    until(lambda: not alive(gige_addresses[1]))
    until(lambda: alive(gige_addresses[1]))
    assert not alive(gige_addresses[0])
    with pytest.raises(InputError, match="left has no power"):
        do(group, "misfire@left")
    do(group, "power=on@left")
    assert alive(gige_addresses[0])


def test_a_stolen_head_refuses_its_former_controller(group: GigeGroup, heads: Callable[..., list[Head]]) -> None:
    left, right = heads()
    do(group, "stolen@left")
    with pytest.raises(GLib.Error, match="access-denied"):
        left.camera.software_trigger()
    assert left.camera.get_string("TriggerMode") == "On"                # who may not write may read
    assert shoot(right) is not None
    do(group, "stolen=off@left")


@pytest.mark.parametrize("state", ["Faulty", "Listening"])
def test_ptp_falls_back(group: GigeGroup, heads: Callable[..., list[Head]], state: str) -> None:
    both = heads()
    synchronise(both)
    do(group, f"ptp={state}@right")
    assert [head.camera.get_string("PtpStatus") for head in both] == ["Master", state]
    do(group, "ptp=off", "apart")
    until(lambda: [head.camera.get_string("PtpStatus") for head in both] == ["Master", "Master"])
    do(group, "apart=off")
    synchronise(both)


def test_five_heads_by_one_wire(gige_addresses: tuple[str, str]) -> None:
    net = gige_addresses[0].rsplit(".", 1)[0]
    addresses = [f"{net}.{number}" for number in range(2, 7)]
    with GigeGroup(Numbered(5, (WIDTH, HEIGHT)), addresses, (WIDTH, HEIGHT)) as group:
        made = [Head(address, "Line0" if index else "Software") for index, address in enumerate(addresses)]
        assert [identity.name for identity in group.identities] == ["left", "right", "third", "fourth", "fifth"]
        made[0].set_line("Line1", LineMode="Output", LineSource="ExposureActive")
        for shot in (1, 2, 3):
            made[0].camera.software_trigger()
            for index, head in enumerate(made):
                image = np.frombuffer(head.grab().get_data(), np.uint8).reshape(HEIGHT, WIDTH)
                assert numbered.read(image) == (index, shot)
        begun = [group.truth(index)[-1].started_ns for index in group.heads]
        assert max(begun[1:]) - min(begun[1:]) <= 1000
        del head, made


def test_the_door_breaks_and_tells(group: GigeGroup, heads: Callable[..., list[Head]],
                                   gige_addresses: tuple[str, str]) -> None:
    left, _right = heads()
    address = gige_addresses[0]
    with pytest.raises(InputError, match=f"no simulator answers at {address}:3957"):
        door.ask(address)
    with Door(group):
        assert shoot(left) is not None
        first, second = door.ask(address, "ptp=Faulty@right")
        assert (first["name"], first["images"], first["last"]["block"]) == ("left", 1, 1)
        assert first["last"]["crc32"] == zlib.crc32(picture(0, LIGHT, 1).tobytes())
        assert (second["images"], second["ptp"]) == (0, "Disabled")
        for wrong, says in (("rust", "no fault 'rust': there are loss, "), ("loss=2", "loss takes SHARE"),
                            ("loss=0.1@third", "no camera 'third': there are left, right"), ("ptp=Sleepy", "one of Init")):
            with pytest.raises(InputError, match=says):
                door.ask(address, wrong)
        with pytest.raises(PortInUse, match="3957"), Door(group):
            pass
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            client.settimeout(1)
            client.sendto(b"[not json", (address, door.PORT))
            assert b'"error"' in client.recv(1000)
        assert door.ask(address, "power=off@left")[0]["powered"] is False
        assert door.ask(address, "clear")[0]["powered"] is True
