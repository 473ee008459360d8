"""What goes over the wires: tables of features, action commands, the pace of packets, and pixels on their way to grey."""

import numpy as np
import pytest

from binpick.camera import action, network, pixels, sync
from binpick.camera.action import Action
from binpick.camera.starter import Starter
from binpick.data import CameraStatus
from binpick.errors import PairRefused
from binpick.settings.cell import AravisCameras, CameraAddress, PixelFormat, Sync, SyncLines


def table(mode: Sync, first: bool, **more: object) -> dict[str, object]:
    return {step.feature: step.value for step in sync.steps(AravisCameras(sync=mode, **more), first)}


def test_by_wire_the_first_camera_drives_a_line_that_triggers_the_others() -> None:
    lines = SyncLines(output="Line0", input="Line3")
    first, other = table("line", True, lines=lines), table("line", False, lines=lines)
    assert (first["TriggerSource"], first["LineSelector"], first["LineSource"]) == ("Software", "Line0", "ExposureActive")
    assert (other["TriggerSource"], other["LineSelector"], other["TriggerActivation"]) == ("Line3", "Line3", "RisingEdge")


@pytest.mark.parametrize("mode", ["action", "scheduled_action"])
def test_actions_reach_only_this_rig(mode: Sync) -> None:
    assert table(mode, True) == table(mode, False)
    here, there = AravisCameras(sync=mode), AravisCameras(sync=mode, right=CameraAddress(address="169.254.9.9"))
    assert table(mode, True)["ActionDeviceKey"] == sync.device_key(here) != sync.device_key(there)


@pytest.mark.parametrize("mode", ["line", "action", "scheduled_action", "software"])
@pytest.mark.parametrize("first", [True, False])
def test_every_table_ends_with_the_trigger_on_and_has_ptp(mode: Sync, first: bool) -> None:
    steps = sync.steps(AravisCameras(sync=mode, pixel_format="Mono12"), first)
    assert (steps[-1].feature, steps[-1].value) == ("TriggerMode", "On")
    values = {step.feature: step.value for step in steps}
    assert (values["PtpEnable"], values["PixelFormat"], values["ExposureAuto"]) == (True, "Mono12", "Off")


def test_an_action_command_is_what_the_standard_says() -> None:
    assert action.datagram(Action(0x01020304, 5, 6), 0x0708).hex() == "42010100000c0708" + "01020304" + "00000005" + "00000006"
    scheduled = action.datagram(Action(1, at_ns=0x1122334455667788), 9)
    assert scheduled[:8].hex() == "4281" + "0100" + "0014" + "0009"
    assert scheduled[-8:].hex() == "1122334455667788"


@pytest.mark.parametrize(("reply", "status"), [
    ("0000010100000007", 0), ("8016010100000007", 0x8016), ("0000010100000008", None), ("0000008100000007", None),
    ("00", None)])
def test_answers_to_an_action_command(reply: str, status: int | None) -> None:
    assert action.answer(bytes.fromhex(reply), 7) == status


def test_nobody_answers_an_action_command_here() -> None:
    said = action.broadcast(Action(1), ("127.0.251.2",), target="127.0.251.2")
    assert said == {"127.0.251.2": "it did not acknowledge"}


@pytest.mark.parametrize(("states", "ready"), [
    (("Master", "Slave"), True), (("Slave", "Slave"), True), (("Master", "Master"), False), (("Master", "Listening"), False),
    (("Master", "Slave", "Master"), False), (("", ""), False)])
def test_a_time_for_all_needs_one_clock_for_all(states: tuple[str, ...], ready: bool) -> None:
    statuses = [CameraStatus(f"camera {i}", connected=True, ptp=state) for i, state in enumerate(states)]
    assert (Starter("scheduled_action").unready(statuses) == "") is ready
    assert Starter("line").unready(statuses) == ""


def test_cameras_that_share_a_port_leave_room_for_each_other() -> None:
    assert network.packet_delay_ns(1500, 1) == 0
    both_bytes_per_s = 2 * 1538 / (1538 / 125e6 + network.packet_delay_ns(1500, 2) * 1e-9)
    assert both_bytes_per_s == pytest.approx(125e6, rel=1e-6)
    assert network.packet_delay_ns(9000, 3, 62_500_000) == 2 * 9038 * 16
    assert network.sharing("127.0.0.2", ["127.0.0.3"]) == 1
    assert network.port_of("127.0.0.2") == "127.0.0.1"


def packed(values: np.ndarray, bits: int) -> bytes:
    """Lowest bits first, as the p formats are."""
    spread = values[:, None] >> np.arange(bits) & 1
    return np.packbits(spread.reshape(-1).astype(np.uint8), bitorder="little").tobytes()


@pytest.mark.parametrize("pixel_format", ["Mono8", "Mono10", "Mono10p", "Mono12", "Mono12p", "Mono12Packed"])
@pytest.mark.parametrize(("width", "height"), [(8, 3), (7, 3)])
def test_grey_is_the_upper_eight_bits(pixel_format: PixelFormat, width: int, height: int) -> None:
    bits = {"Mono8": 8, "Mono10": 10, "Mono10p": 10}.get(pixel_format, 12)
    values = np.random.default_rng(3).integers(0, 1 << bits, width * height)
    match pixel_format:
        case "Mono8":
            data = values.astype(np.uint8).tobytes()
        case "Mono10" | "Mono12":
            data = values.astype("<u2").tobytes()
        case "Mono12Packed":
            pairs = np.append(values, 0)[:values.size + values.size % 2].reshape(-1, 2)
            data = np.stack((pairs[:, 0] >> 4, pairs[:, 0] & 15 | (pairs[:, 1] & 15) << 4, pairs[:, 1] >> 4), 1).astype(
                np.uint8).tobytes()
        case _:
            data = packed(values, bits)
    size = pixels.size_bytes(pixel_format, width, height)
    assert len(data) in (size, size + 1)
    image = pixels.grey(data, pixels.CODES[pixel_format], pixel_format, width, height)
    assert np.array_equal(image.reshape(-1), values >> (bits - 8))


def test_colour_becomes_grey_without_a_pattern() -> None:
    raw = np.zeros((8, 8), np.uint8)
    raw[0::2, 0::2], raw[0::2, 1::2], raw[1::2, 0::2], raw[1::2, 1::2] = 200, 100, 100, 50       # red, green, green, blue
    image = pixels.grey(raw.tobytes(), pixels.CODES["BayerRG8"], "BayerRG8", 8, 8)
    assert np.abs(image[2:-2, 2:-2].astype(int) - round(0.299 * 200 + 0.587 * 100 + 0.114 * 50)).max() <= 1


def test_another_payload_is_refused() -> None:
    with pytest.raises(PairRefused, match="came as Mono12p, not as Mono8"):
        pixels.grey(bytes(64), pixels.CODES["Mono12p"], "Mono8", 8, 8)
    with pytest.raises(PairRefused, match=r"came as 0x2180014, not as Mono8"):
        pixels.grey(bytes(64), 0x02180014, "Mono8", 8, 8)
    with pytest.raises(PairRefused, match=r"63 bytes, not 64 \(8x8 pixels of Mono8\)"):
        pixels.grey(bytes(63), pixels.CODES["Mono8"], "Mono8", 8, 8)
