"""The register image: a snapshot and the handshake's signals as 360 words, and a request out of the words a PLC wrote.

Wire units are converted here only: floats are millimetres, integers count in the scale of their row of the map.
"""

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from pydantic import ValidationError

from binpick import poses
from binpick.errors import Code, InputError
from binpick.message import PoseMessage
from binpick.poses import PoseFormat
from binpick.publish.registers import (
    BLOCK,
    CAPABILITIES,
    COMPACT,
    COUNTS,
    DIAGNOSTICS,
    FRAMES,
    HEADER,
    HOLDING,
    IDENTITY,
    INPUT_WORDS,
    LAYOUT_VERSION,
    OWNERS,
    PAGE_SIZE,
    RECORDS,
    Detail,
    Kind,
    Number,
    Register,
    Status,
    WordOrder,
)
from binpick.result import GraspMessage, Request, Result, Snapshot
from binpick.settings import Job, Recipe

Values: TypeAlias = Mapping[str, Number | None]

UNUSED_FLOAT = 1.0e6
UNUSED_INT = -0x8000
UNKNOWN_FILL = 65.535
INT_RANGE: dict[Kind, tuple[int, int]] = {"u16": (0, 0xFFFF), "i16": (-0x7FFF, 0x7FFF), "u32": (0, 0xFFFFFFFF)}
CHECK_SEED = 0x5A5A
NO_STATUS = Status(0)
LEVELS = ("ok", "warn", "fault")
LARGEST = 32.7
"""Of the watchdog's figures, px, mm and mrad: what is off by more than the registers hold is a fault in any case."""
HEARTBEAT = next(register.address for register in IDENTITY if register.name == "heartbeat")


@dataclass(frozen=True, slots=True)
class Echo:
    """What a request came down to, by number; frame 1 camera, 2 bin, 3 base."""

    recipe: int = 0
    bin: int = 0
    frame: int = 0
    pose_format: int = 0
    tool: int = 0

    @classmethod
    def of(cls, request: Request, job: Job) -> "Echo":
        """The request with the recipe's own in the place of every 0; the tool stays 0 where the recipe has several."""
        return cls(job.recipe.number, job.bin.number, FRAMES.index(request.frame or job.recipe.frame) + 1,
                   PoseFormat[request.pose_format or job.recipe.pose_format], job.tool.number if len(job.tools) == 1 else 0)


NO_ECHO = Echo()


@dataclass(frozen=True, slots=True)
class Signals:
    """What the handshake says beside a result: `cycle_id` is the cycle it speaks of, `latched` the code of register 15."""

    status: Status = NO_STATUS
    cmd_seq: int = 0
    command: int = 0
    cycle_id: int = 0
    code: int = Code.NOT_READY.value
    detail: int = 0
    page: int = 0
    latched: int = 0
    echo: Echo = NO_ECHO


def encode(snapshot: Snapshot, signals: Signals, word_order: WordOrder = "ABCD") -> tuple[int, ...]:
    """All input registers but the heartbeat, which is 0.

    Poses stand in them only while VALID and only with a code that carries poses. A value that does not fit its scale takes
    VALID away and raises ERROR with code −1: nothing ever wraps.
    """
    try:
        return _encode(snapshot, signals, _finished(snapshot, signals.cycle_id), word_order)
    except OverflowError:
        code = Code.BAD_ARGUMENT.value
        status = signals.status & ~(Status.VALID | Status.WARN | Status.CALIB_WARN) | Status.ERROR
        overflow = replace(signals, status=status, code=code, detail=Detail.SCALE_OVERFLOW.value, latched=code)
        return _encode(snapshot, overflow, None, word_order)


def seq(cycle_id: int) -> int:
    """A cycle's number on the wire, 1 to 65535; 0 for none."""
    return (cycle_id - 1) % 65535 + 1 if cycle_id > 0 else 0


def cycle_of(wire_seq: int, latest: int) -> int:
    """The newest cycle up to `latest` that has this number on the wire; 0 when there is none."""
    cycle = latest - (seq(latest) - wire_seq) % 65535
    return cycle if 1 <= wire_seq <= 65535 and cycle > 0 else 0


def decode_request(words: Sequence[int], recipe: Recipe, word_order: WordOrder = "ABCD") -> Request:
    """The request in the holding registers; the flange pose is read in its pose format, or else the recipe's.

    Raises InputError with a sentence for a code that does not exist, or a flange pose that is not finite and normalised.
    """
    given = {register.name: _unpack(register, words, word_order) for register in HOLDING}
    frame, pose_format = int(given["frame"]), int(given["pose_format"])
    if not 0 <= frame <= len(FRAMES):
        raise InputError(f"frame is {frame}; it must be 0 (the recipe's), 1 camera, 2 bin or 3 base")
    if pose_format and pose_format not in PoseFormat.__members__.values():
        raise InputError(f"pose format is {pose_format}; it must be 0 (the recipe's) or 1 to {len(PoseFormat)}")
    chosen = PoseFormat(pose_format) if pose_format else PoseFormat[recipe.pose_format]
    try:
        return Request.model_validate({
            "recipe": int(given["recipe"]), "bin": int(given["bin"]), "tool": int(given["tool"]),
            "frame": FRAMES[frame - 1] if frame else None, "max_grasps": int(given["max_grasps"]),
            "pose_format": chosen.name if pose_format else None, "timeout_ms": int(given["timeout"]),
            "T_base_flange": _flange(given, chosen)})
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"{first['loc'][0]} is {first['input']}: {first['msg']}") from error


def _flange(given: Mapping[str, Number], pose_format: PoseFormat) -> PoseMessage | None:
    flags = int(given["flange_flags"])
    if not flags & 1:
        return None
    if flags & 2:
        position, pose_format = [given[f"flange_int_{a}"] for a in "xyz"], PoseFormat.rotvec_rad
        numbers = np.array([given[f"flange_int_{a}"] for a in ("rx", "ry", "rz")]) / 1000
    else:
        position = [given[f"flange_{a}"] for a in "xyz"]
        count = 4 if pose_format is PoseFormat.quaternion_xyzw else 3
        numbers = np.array([given[f"flange_r{i + 1}"] for i in range(count)])
    if not (np.isfinite(position).all() and np.isfinite(numbers).all()):
        raise InputError("the flange pose is marked valid, but not all of its numbers are finite")
    if pose_format is PoseFormat.quaternion_xyzw and abs(np.linalg.norm(numbers) - 1) > 1e-3:
        raise InputError(f"the flange's quaternion has length {np.linalg.norm(numbers):.4f}; it must be 1")
    x, y, z, w = (float(q) for q in poses.decode(numbers, pose_format))
    return PoseMessage(position_m=(position[0] / 1000, position[1] / 1000, position[2] / 1000), quaternion_xyzw=(x, y, z, w))


def _encode(snapshot: Snapshot, signals: Signals, result: Result | None, word_order: WordOrder) -> tuple[int, ...]:
    grasps = result.grasps if result and Status.VALID in signals.status and Code(signals.code).carries_poses else ()
    page = grasps[signals.page * PAGE_SIZE:(signals.page + 1) * PAGE_SIZE]
    header = _header(signals, snapshot.boot_id, result, len(grasps), len(page))
    image = [0] * INPUT_WORDS
    _fill(image, IDENTITY, _identity(snapshot, signals), word_order)
    _fill(image, HEADER, header, word_order)
    for index, record in enumerate(RECORDS):
        used = index < len(page)
        _fill(image, record, _record(page[index], header["seq"], signals.echo.pose_format) if used else {}, word_order)
    block = BLOCK[0].address
    image[block] = (CHECK_SEED + sum(image[HEADER[0].address:block])) % 65536
    _fill(image, COMPACT, {**(_compact(page[0]) if page else {}), **{
        name: header[name] for name in ("seq", "cmd_seq", "return_code", "recipe", "bin", "frame", "remaining")}}, word_order)
    _fill(image, DIAGNOSTICS, _diagnostics(snapshot), word_order)
    return tuple(image)


def _finished(snapshot: Snapshot, cycle_id: int) -> Result | None:
    """The finished result of that cycle, or None."""
    kept = snapshot.latest
    return kept.result if cycle_id and kept is not None and kept.result.cycle_id == cycle_id else None


def _identity(snapshot: Snapshot, signals: Signals) -> Values:
    cameras = sum((camera.connected | bool(camera.error) << 1) << 2 * i for i, camera in enumerate(snapshot.cameras))
    return {"magic": 0xB1D0, "layout_version": LAYOUT_VERSION, "test_u32": 0x01020304, "test_f32": 123456.0,
            "rig_version": snapshot.rig_version,
            "capabilities": CAPABILITIES, "max_records": PAGE_SIZE, "status": signals.status,
            "active_recipe": signals.echo.recipe, "mode": OWNERS.index(snapshot.owner), "camera_states": cameras,
            "latched_error": signals.latched}


def _header(signals: Signals, boot_id: int, result: Result | None, total: int, in_page: int) -> dict[str, Number]:
    timing = result.timing_ms if result else {}
    fill = result.bin.fill_level if result and result.bin else None
    echo = signals.echo
    return {"seq": seq(signals.cycle_id), "boot_id": seq(boot_id), "cmd_seq": signals.cmd_seq, "command": signals.command,
            "status": signals.status, "return_code": signals.code, "detail": signals.detail, "recipe": echo.recipe,
            "bin": echo.bin, "frame": echo.frame, "pose_format": echo.pose_format, "tool": echo.tool, "n_total": total,
            "n_in_page": in_page, "page": signals.page, "remaining": max(0, total - (signals.page + 1) * PAGE_SIZE),
            "t_acq": timing.get("acquire", 0), "t_total": timing.get("total", 0),
            "fill": UNKNOWN_FILL if fill is None else max(0.0, fill)}


def _record(grasp: GraspMessage, wire_seq: Number, pose_format: int) -> Values:
    numbers = [*poses.encode(np.array(grasp.quaternion_xyzw), PoseFormat(pose_format)), 0.0][:4]
    return {"seq": wire_seq, "grasp_id": grasp.number, **_millimetres(grasp),
            **{f"r{i + 1}": float(number) for i, number in enumerate(numbers)}, "flags": 1, "label": grasp.part_id,
            **_strokes(grasp), "sigma_pos": 1000 * math.hypot(grasp.sigma.xy_m, grasp.sigma.z_m),
            "sigma_rot": 1000 * grasp.sigma.tilt_rad}


def _compact(grasp: GraspMessage) -> Values:
    rotation = 1000 * poses.encode(np.array(grasp.quaternion_xyzw), PoseFormat.rotvec_rad)
    return {"grasp_id": grasp.number, **_millimetres(grasp), **_strokes(grasp),
            **{f"r{a}": float(angle) for a, angle in zip("xyz", rotation, strict=True)}}


def _millimetres(grasp: GraspMessage) -> dict[str, Number]:
    return {a: 1000 * metres for a, metres in zip("xyz", grasp.position_m, strict=True)}


def _strokes(grasp: GraspMessage) -> dict[str, Number]:
    return {"quality": grasp.quality, "tool": grasp.tool.number, "open": 1000 * grasp.open_m, "close": 1000 * grasp.close_m,
            "approach": 1000 * math.dist(grasp.position_m, grasp.T_frame_pregrasp.position_m)}


def _diagnostics(snapshot: Snapshot) -> Values:
    sync = snapshot.latest.result.sync if snapshot.latest else None
    values: dict[str, Number] = {name: count for name, count in snapshot.counts if name in COUNTS}
    if sync:
        values |= {"skew": abs(sync.skew_us), "skew_sigma": sync.sigma_us, "resends": sync.resends, "missing": sync.missing}
    return {**values, **_calibration(snapshot)}


def _calibration(snapshot: Snapshot) -> dict[str, Number]:
    """The watchdog's last word."""
    seen = snapshot.drift.latest if snapshot.drift is not None else None
    if seen is None:
        return {}
    figures: dict[str, float | None] = {"row_error": seen.row_px, "row_off": seen.off_px, "row_change": seen.change_px}
    if seen.marks is not None:
        milli = {"marks_shift": seen.marks.shift_m, "marks_turn": seen.marks.turn_rad, "depth_error": seen.marks.depth_m}
        figures |= {name: 1000 * value for name, value in milli.items() if value is not None}
    if seen.correction is not None:
        figures["correction"] = 1000 * math.hypot(*seen.correction.rotation_rad)
    return {"calibration": 1 + LEVELS.index(seen.level), "marks_seen": seen.marks.seen if seen.marks is not None else 0,
            **{name: min(max(value, -LARGEST), LARGEST) for name, value in figures.items() if value is not None}}


def _fill(image: list[int], table: tuple[Register, ...], values: Values, word_order: WordOrder) -> None:
    """Writes a table's words; a value that is missing is unused, `check` is computed."""
    first = table[0].address
    for register in table:
        words = _pack(register, values.get(register.name), word_order)
        image[register.address:register.address + register.words] = words
    last = table[-1]
    if last.name == "check":
        image[last.address] = (CHECK_SEED + sum(image[first:last.address])) % 65536


def _pack(register: Register, value: Number | None, word_order: WordOrder) -> tuple[int, ...]:
    """One value as words; None is "unused": 1.0e6, −32768, or 0 where unsigned. Raises OverflowError when it does not fit."""
    if register.kind == "f32":
        if value is not None and not abs(value) < UNUSED_FLOAT:
            raise OverflowError(f"{register.name} is {value} {register.unit}")
        value = UNUSED_FLOAT if value is None else value
        high, low = struct.unpack(">HH", struct.pack(">f", value))
        return (high, low) if word_order == "ABCD" else (low, high)
    if value is None:
        return (UNUSED_INT & 0xFFFF,) if register.kind == "i16" else (0,) * register.words
    lowest, highest = INT_RANGE[register.kind]
    count = round(value / register.scale) if math.isfinite(value) else highest + 1
    if not lowest <= count <= highest:
        raise OverflowError(f"{register.name} is {value} {register.unit}")
    if register.kind == "u32":
        return (count >> 16, count & 0xFFFF) if word_order == "ABCD" else (count & 0xFFFF, count >> 16)
    return (count & 0xFFFF,)


def _unpack(register: Register, words: Sequence[int], word_order: WordOrder) -> Number:
    """The physical value of a holding register, in the unit of its row."""
    first = words[register.address]
    if register.kind == "f32":
        second = words[register.address + 1]
        pair = (first, second) if word_order == "ABCD" else (second, first)
        return float(struct.unpack(">f", struct.pack(">HH", *pair))[0])
    return (first - 0x10000 if register.kind == "i16" and first >= 0x8000 else first) * register.scale
