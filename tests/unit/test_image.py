"""The register image word by word, and requests out of the words of a PLC."""

import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from binpick import poses
from binpick.data import CameraStatus
from binpick.errors import Code, InputError
from binpick.message import CalibrationMessage, CorrectionMessage, MarksMessage
from binpick.poses import PoseFormat
from binpick.publish import image
from binpick.publish.image import Echo, Signals
from binpick.publish.registers import Status, WordOrder
from binpick.result import (
    BinMessage,
    Drift,
    GraspMessage,
    PoseMessage,
    Published,
    Request,
    Result,
    ReturnCode,
    Sigma,
    Snapshot,
    SyncMessage,
    ToolMessage,
)
from binpick.settings import Bin, Job, Pose, Recipe, SuctionTool, TwoFingerTool

QUATERNION = (0.5, -0.5, 0.5, 0.5)
VALID = Status.VALID | Status.ACK | Status.ACQ_DONE


def grasp(number: int, x: float = 0.1234, **changes: object) -> GraspMessage:
    pose = PoseMessage(position_m=(x, -0.25, 0.98765 - 0.08), quaternion_xyzw=QUATERNION)
    fields: dict[str, object] = {
        "id": f"7-{number}", "rank": number, "tool": ToolMessage(number=3, name="s", kind="suction"), "frame": "base",
        "position_m": (x, -0.25, 0.98765), "quaternion_xyzw": QUATERNION, "T_frame_pregrasp": pose, "approach_m": 0.08,
        "lift_m": 0.15, "open_m": 0.0123, "close_m": 0.004, "quality": 0.875,
        "sigma": Sigma(xy_m=0.0003, z_m=0.0004, tilt_rad=0.0123), "clearance_m": 0.003, "part_id": 11}
    return GraspMessage.model_validate({**fields, **changes})


def snapshot(count: int = 2, *, code: Code = Code.OK, cycle_id: int = 7, **changes: object) -> Snapshot:
    fields: dict[str, object] = {
        "cycle_id": cycle_id, "request": Request(), "captured_at": "2026-01-02T03:04:05.678Z",
        "return_code": ReturnCode.of(code),
        "bin": BinMessage(found=True, number=1, T_camera_bin=None, fill_level=0.4321, coverage=1.0),
        "grasps": tuple(grasp(n + 1) for n in range(count)),
        "sync": SyncMessage(skew_us=-70000.4, sigma_us=3, proof="ptp", resends=2, missing=1),
        "timing_ms": {"acquire": 61.6, "total": 271.2}}
    result = Result.model_validate({**fields, **changes})
    published = Published(result, result.json_bytes(), 0)
    return Snapshot(boot_id=0x1F00F, phase="ready", published=published, valid=True, latest=published, owner="modbus",
                    cameras=(CameraStatus("left", True), CameraStatus("right", False, error="dead")),
                    counts=(("started", 70000), ("unheard_of", 3)))


def signals(**changes: object) -> Signals:
    fields: dict[str, object] = {
        "status": VALID, "cmd_seq": 4711, "command": 1, "cycle_id": 7, "code": 0,
        "echo": Echo(recipe=2, bin=1, frame=3, pose_format=1, tool=3)}
    return Signals(**{**fields, **changes})


def real(words: tuple[int, ...], address: int, word_order: WordOrder = "ABCD") -> float:
    pair = words[address:address + 2] if word_order == "ABCD" else words[address + 1:address - 1:-1]
    return float(struct.unpack(">f", struct.pack(">HH", *pair))[0])


def whole(words: tuple[int, ...], first: int, last: int) -> bool:
    return (0x5A5A + sum(words[first:last])) % 65536 == words[last]


UNITS = ((100, 119), (120, 145), (146, 171), (172, 197), (198, 223), (100, 224), (300, 319), (320, 359))


def test_identity_is_made_of_literal_words() -> None:
    words = image.encode(snapshot(), signals())
    assert len(words) == 360
    assert words[:8] == (0xB1D0, 1, 0x0102, 0x0304, 0x47F1, 0x2000, 1 << 1 | 1 << 5 | 1 << 7 | 1 << 8 | 1 << 9, 4)
    assert words[10] == VALID == 0b110010
    assert words[12:16] == (2, 1, 0b1001, 0)


def test_cdab_swaps_the_words_of_every_32_bit_value_and_nothing_else() -> None:
    abcd, cdab = image.encode(snapshot(), signals()), image.encode(snapshot(), signals(), "CDAB")
    assert cdab[2:6] == (0x0304, 0x0102, 0x2000, 0x47F1)
    assert (cdab[122], cdab[123]) == (abcd[123], abcd[122])
    assert real(cdab, 122, "CDAB") == real(abcd, 122)
    assert sorted(abcd) == sorted(cdab)
    assert abcd[100:122] == cdab[100:122]


def test_header_and_record_stand_in_millimetres_and_scales() -> None:
    words = image.encode(snapshot(), signals())
    assert words[100:119] == (7, 0xF010, 4711, 1, VALID, 0, 0, 2, 1, 3, 1, 3, 2, 2, 0, 0, 62, 271, 432)
    assert words[120:122] == (7, 1)
    assert [real(words, a) for a in range(122, 136, 2)] == pytest.approx([123.4, -250.0, 987.65, *QUATERNION])
    assert words[136:145] == (1, 3, 11, 875, 123, 40, 800, 50, 123)
    assert words[147] == 2


def test_compact_is_the_pages_first_grasp_in_int16() -> None:
    words = image.encode(snapshot(), signals())
    rotation = [round(1000 * r) & 0xFFFF for r in poses.encode(np.array(QUATERNION), PoseFormat.rotvec_rad)]
    assert words[300:319] == (7, 4711, 0, 2, 1, 3, 0, 1, 1234, -2500 & 0xFFFF, 9876, *rotation, 875, 3, 123, 40, 800)


@pytest.mark.parametrize("word_order", ["ABCD", "CDAB"])
@pytest.mark.parametrize("grasps", [0, 1, 4, 9])
def test_every_unit_proves_itself(grasps: int, word_order: WordOrder) -> None:
    for page in range(3):
        words = image.encode(snapshot(grasps), signals(page=page), word_order)
        assert all(whole(words, *unit) for unit in UNITS)


def test_unused_records_are_unreachable_never_zero() -> None:
    words = image.encode(snapshot(1), signals())
    for first in (146, 172, 198):
        assert words[first + 1] == words[first + 16] == 0
        assert [real(words, a) for a in range(first + 2, first + 16, 2)] == [1.0e6] * 7
    words = image.encode(snapshot(0, code=Code.BIN_EMPTY), signals(code=102))
    assert words[308:314] == (0x8000,) * 6
    assert words[307] == 0


def test_pages_of_four() -> None:
    kept = snapshot(9)
    found = []
    for page in range(3):
        words = image.encode(kept, signals(page=page))
        found += [words[121 + 26 * i] for i in range(4) if words[136 + 26 * i] & 1]
        assert (words[112], words[114]) == (9, page)
        assert words[115] == words[306] == (5, 1, 0)[page]
    assert found == [*range(1, 10)]


@pytest.mark.parametrize(("status", "code"), [
    (Status.BUSY, -12), (Status.ACK, 0), (Status.ERROR, -26), (VALID, 101), (VALID, -3)])
def test_without_valid_and_a_good_code_there_are_no_poses(status: Status, code: int) -> None:
    words = image.encode(snapshot(3), signals(status=status, code=code))
    assert words[105] == code & 0xFFFF
    assert words[112:114] == (0, 0)
    assert all(words[first + 16] == 0 and real(words, first + 2) == 1.0e6 for first in (120, 146, 172, 198))
    assert words[308] == 0x8000


def test_a_result_of_another_cycle_never_shows_its_poses() -> None:
    words = image.encode(snapshot(3, cycle_id=8), signals(cycle_id=7))
    assert words[112:114] == (0, 0)


@pytest.mark.parametrize(("pose_format", "numbers"), [
    (f.value, [*poses.encode(np.array(QUATERNION), f), 0.0][:4]) for f in PoseFormat])
def test_orientation_follows_the_pose_format(pose_format: int, numbers: list[float]) -> None:
    words = image.encode(snapshot(), signals(echo=Echo(pose_format=pose_format)))
    assert words[110] == pose_format
    assert [real(words, a) for a in range(128, 136, 2)] == pytest.approx(numbers, abs=1e-5)


@pytest.mark.parametrize("changes", [
    {"position_m": (3.27675, 0, 0)}, {"position_m": (-3.2768, 0, 0)}, {"position_m": (0, 1001.0, 0)}, {"open_m": 6.6},
    {"part_id": 65536}, {"part_id": -1}, {"sigma": Sigma(xy_m=0.7, z_m=0, tilt_rad=0)}])
def test_what_does_not_fit_raises_error_and_takes_valid_away(changes: dict[str, object]) -> None:
    words = image.encode(snapshot(0, grasps=(grasp(1, **changes),)), signals(status=VALID | Status.WARN, code=1))
    assert words[10] == words[104] == (VALID | Status.ERROR) & ~Status.VALID
    assert words[105] == words[15] == words[302] == -1 & 0xFFFF
    assert words[106] == 1
    assert words[113] == words[136] == 0
    assert all(whole(words, *unit) for unit in UNITS)


@settings(derandomize=True, deadline=None)
@given(st.floats(-3.2767, 3.2767), st.floats(0, 1))
def test_compact_is_within_half_a_count(x: float, quality: float) -> None:
    words = image.encode(snapshot(0, grasps=(grasp(1, x, quality=quality),)), signals())
    signed = words[308] - 0x10000 if words[308] & 0x8000 else words[308]
    assert signed / 10 == pytest.approx(1000 * x, abs=0.0501)
    assert real(words, 122) == pytest.approx(1000 * x, rel=1e-6)
    assert words[314] / 1000 == pytest.approx(quality, abs=0.000501)


def test_unknown_fill_and_diagnostics() -> None:
    words = image.encode(snapshot(bin=None), signals())
    assert words[118] == 0xFFFF
    assert words[320:328] == (70000 >> 16, 70000 & 0xFFFF, 0, 3, 0, 2, 0, 1)
    assert words[328:330] == (1, 70000 & 0xFFFF)


@settings(derandomize=True, deadline=None)
@given(st.integers(1, 3_000_000), st.integers(0, 20))
def test_seq_on_the_wire_names_the_recent_cycles(latest: int, back: int) -> None:
    cycle_id = max(1, latest - back)
    assert 1 <= image.seq(cycle_id) <= 65535
    assert image.cycle_of(image.seq(cycle_id), latest) == cycle_id
    assert image.seq(65535) == 65535
    assert image.seq(65536) == 1


def test_a_seq_that_was_never_sent_names_nothing() -> None:
    assert image.cycle_of(0, 5) == image.cycle_of(6, 5) == image.cycle_of(1, 0) == 0


def holding(**words: int) -> list[int]:
    addresses = {"recipe": 3, "tool": 4, "frame": 5, "max_grasps": 6, "pose_format": 7, "timeout": 8, "bin": 27, "flags": 34}
    memory = [0] * 35
    for name, word in words.items():
        memory[addresses[name]] = word
    return memory


def floats(address: int, *values: float) -> dict[int, int]:
    words = struct.unpack(f">{2 * len(values)}H", struct.pack(f">{len(values)}f", *values))
    return {address + i: word for i, word in enumerate(words)}


def test_zeros_ask_for_the_recipes_own() -> None:
    assert image.decode_request(holding(), Recipe()) == Request()


def test_a_request_by_numbers() -> None:
    words = holding(recipe=2, tool=3, frame=2, max_grasps=4, pose_format=5, timeout=900, bin=6)
    assert image.decode_request(words, Recipe()) == Request(recipe=2, tool=3, bin=6, frame="bin", max_grasps=4,
                                                            pose_format="ur_rxryrz_rad", timeout_ms=900)


@pytest.mark.parametrize("words", [{"frame": 4}, {"pose_format": 6}, {"max_grasps": 21}, {"timeout": 60001}])
def test_unknown_codes_are_named(words: dict[str, int]) -> None:
    with pytest.raises(InputError, match=str(next(iter(words.values())))) as caught:
        image.decode_request(holding(**words), Recipe())
    assert caught.value.code is Code.BAD_ARGUMENT


@pytest.mark.parametrize("word_order", ["ABCD", "CDAB"])
def test_a_flange_pose_in_floats_has_the_requests_format_or_the_recipes(word_order: WordOrder) -> None:
    numbers = poses.encode(np.array(QUATERNION), PoseFormat.kuka_abc_deg)
    for pose_format, recipe in ((3, Recipe()), (0, Recipe(pose_format="kuka_abc_deg"))):
        words = holding(flags=1, pose_format=pose_format)
        for address, word in floats(12, 100.0, -200.0, 1500.0, *numbers).items():
            words[address if word_order == "ABCD" else address ^ 1] = word
        flange = image.decode_request(words, recipe, word_order).T_base_flange
        assert flange is not None
        assert flange.position_m == pytest.approx((0.1, -0.2, 1.5))
        assert flange.quaternion_xyzw == pytest.approx(QUATERNION, abs=1e-6)


def test_a_flange_pose_in_int16() -> None:
    words = holding(flags=3)
    words[28:34] = [1000, -2000 & 0xFFFF, 15000, 0, 0, 1571]
    flange = image.decode_request(words, Recipe()).T_base_flange
    assert flange is not None
    assert flange.position_m == pytest.approx((0.1, -0.2, 1.5))
    assert flange.quaternion_xyzw == pytest.approx((0, 0, np.sin(1.571 / 2), np.cos(1.571 / 2)))


@pytest.mark.parametrize("numbers", ["0 0 0 0 0 0 1.1", "nan 0 0 0 0 0 1", "0 0 0 0 inf 0 1"])
def test_an_unsound_flange_pose_is_refused(numbers: str) -> None:
    words = holding(flags=1)
    for address, word in floats(12, *map(float, numbers.split())).items():
        words[address] = word
    with pytest.raises(InputError, match="flange"):
        image.decode_request(words, Recipe())


def test_the_echo_names_what_was_really_used() -> None:
    job = Job(recipe=Recipe(number=4, frame="camera", pose_format="fanuc_wpr_deg"), tools=(SuctionTool(number=9),),
              bin=Bin(number=5, inner_size_m=(0.6, 0.4, 0.2), pose=Pose()))
    assert Echo.of(Request(), job) == Echo(recipe=4, bin=5, frame=1, pose_format=4, tool=9)
    asked = Request(frame="base", pose_format="rotvec_rad")
    assert Echo.of(asked, job) == Echo(recipe=4, bin=5, frame=3, pose_format=2, tool=9)


def test_the_echo_leaves_the_tool_open_where_a_recipe_has_several() -> None:
    job = Job(recipe=Recipe(number=4), tools=(SuctionTool(number=9), TwoFingerTool(number=2, kind="two_finger")),
              bin=Bin(number=5, inner_size_m=(0.6, 0.4, 0.2), pose=Pose()))
    assert Echo.of(Request(), job).tool == 0


def test_the_watchdogs_figures_stand_in_the_diagnostics() -> None:
    marks = MarksMessage(seen=6, shift_m=0.00123, turn_rad=0.0004, pitch_rad=0.0, yaw_rad=0.0003, roll_rad=0.0, depth_m=-0.0021)
    seen = CalibrationMessage(level="warn", sentence="", row_px=-0.0125, row_sigma_px=0.01, points=90, off_px=0.42,
                              change_px=None, marks=marks,
                              correction=CorrectionMessage(rotation_rad=(0.0003, -0.0004, 0.0), rig_sha256="0"))
    words = image.encode(replace(snapshot(), drift=Drift(level="warn", latest=seen)), signals())
    # level, row error, what counts, its change (unknown), marks, shift, turn, depth, correction; then spare
    assert words[346:356] == (2, 0x10000 - 12, 420, 0x8000, 6, 123, 40, 0x10000 - 210, 500, 0)
    assert whole(words, 320, 359)
    nothing = image.encode(replace(snapshot(), drift=Drift()), signals())
    assert nothing[346:356] == (0, 0x8000, 0x8000, 0x8000, 0, 0, 0, 0x8000, 0, 0)
    far = seen.model_copy(update={"off_px": 400.0, "marks": marks.model_copy(update={"shift_m": 3.0})})
    beyond = image.encode(replace(snapshot(), drift=Drift(latest=far)), signals())
    assert (beyond[348], beyond[351], beyond[10] & Status.ERROR) == (32700, 3270, 0)      # never wraps, never stops a pick
