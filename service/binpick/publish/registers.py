"""The register map: every address, type, scale and sentence of Modbus stands here and nowhere else.

A unit of registers ends in `check` = (0x5A5A + the sum of its other words) mod 65536, which proves it whole in whatever order
its words were read. `image` fills and reads the registers, documents and PLC code are generated from the same rows.
"""

import csv as csv_format
import io
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Literal, TypeAlias

from binpick.poses import PoseFormat
from binpick.result import FrameName

WordOrder: TypeAlias = Literal["ABCD", "CDAB"]
Kind: TypeAlias = Literal["u16", "i16", "u32", "f32"]
Number: TypeAlias = int | float
Row: TypeAlias = tuple[str, Kind, Number, str, str]

LAYOUT_VERSION = 1
PAGE_SIZE = 4
HOLDING_WORDS = 35
INPUT_WORDS = 360
MIRROR = 1000
CAPABILITIES = 1 << 1 | 1 << 5 | 1 << 7 | 1 << 8 | 1 << 9
"""Bit n: command n; 1 pick, 5 verify calibration, 7 calibration sample, 8 bin exchanged, 9 clear."""
FRAMES: tuple[FrameName, ...] = ("camera", "bin", "base")
OWNERS = ("none", "modbus", "rest")


class Ctrl(IntFlag):
    """Bits of holding register 0."""

    ENABLE = 1 << 0
    TRIG = 1 << 1
    RES_ACK = 1 << 2
    NEXT_PAGE = 1 << 3
    CLEAR_ERR = 1 << 4
    ABORT = 1 << 5
    ROBOT_CLEAR = 1 << 6
    FEEDBACK_STROBE = 1 << 7


class Status(IntFlag):
    """Bits of input register 10 and of the header's copy."""

    READY = 1 << 0
    ACK = 1 << 1
    NACK = 1 << 2
    BUSY = 1 << 3
    ACQ_DONE = 1 << 4
    VALID = 1 << 5
    ERROR = 1 << 6
    WARN = 1 << 7
    LAST_PAGE = 1 << 8
    CALIB_WARN = 1 << 9
    DEGRADED = 1 << 10
    SIM = 1 << 11


class Detail(IntEnum):
    """Why a cycle ended as it did, beyond its return code.

    Of a calibration sample, what it is worth: with code 0 more are needed, they are enough, or it shows nothing that others do
    not; with code 110 how many cameras saw the board.
    """

    NONE = 0
    SCALE_OVERFLOW = 1
    TRIG_FELL = 2
    ABORTED = 3
    CONNECTION_LOST = 4
    HEARTBEAT_STOPPED = 5
    CLEARED = 6
    WITHDRAWN = 7
    SAMPLE_NEW = 8
    SAMPLE_ENOUGH = 9
    SAMPLE_NOT_NEW = 10
    BOARD_SEEN_BY_SOME = 11
    BOARD_SEEN_BY_NONE = 12


@dataclass(frozen=True, slots=True)
class Register:
    """One row of the map: physical value = raw × scale in `unit`; 32-bit kinds take two words."""

    address: int
    name: str
    kind: Kind
    scale: Number
    unit: str
    sentence: str

    @property
    def words(self) -> int:
        """How many registers it takes."""
        return 2 if self.kind in ("u32", "f32") else 1


def _table(base: int, *table: Row) -> tuple[Register, ...]:
    """Registers one behind the other from `base` on."""
    sizes = [2 if row[1] in ("u32", "f32") else 1 for row in table]
    addresses = itertools.accumulate(sizes[:-1], initial=base)
    return tuple(Register(address, *row) for address, row in zip(addresses, table, strict=True))


def _pose(sentence: str, kind: Kind, length: Number, prefix: str, letters: str, angle: Row) -> tuple[Row, ...]:
    """X, Y, Z in mm and the rows of an orientation."""
    xyz: list[Row] = [(prefix + a, kind, length, "mm", f"{sentence}: {a.upper()}") for a in "xyz"]
    return (*xyz, *((prefix + a, *angle[1:4], f"{sentence}: {angle[4]} {a}") for a in letters.split()))


_FLOAT_ANGLE: Row = ("", "f32", 1, "by pose format", "orientation, unused numbers 0,")
_INT_ANGLE: Row = ("", "i16", 1, "mrad", "rotation vector")
_CHECK: Row = ("check", "u16", 1, "", "(0x5A5A + the sum of this unit's other words) mod 65536")

HOLDING = _table(
    0,
    ("ctrl", "u16", 1, "bits", "; ".join(f"b{i} {bit.name}" for i, bit in enumerate(Ctrl))
     + ". A trigger needs ENABLE = 1 and RES_ACK = 0. ROBOT_CLEAR is not evaluated in this version"),
    ("command", "u16", 1, "", "1 pick, 5 verify calibration, 7 calibration sample, 8 bin exchanged, 9 clear; others answer -8"),
    ("cmd_seq", "u16", 1, "", "Your number of this command, 1 to 65535, another one each time; write it after the arguments"),
    ("recipe", "u16", 1, "", "Recipe number; 0 the first"),
    ("tool", "u16", 1, "", "Tool number; 0 the recipe's"),
    ("frame", "u16", 1, "", "1 camera, 2 bin, 3 base; 0 the recipe's"),
    ("max_grasps", "u16", 1, "", "Most grasps to return, up to 20; 0 the recipe's"),
    ("pose_format", "u16", 1, "", ", ".join(f"{f.value} {f.name}" for f in PoseFormat) + "; 0 the recipe's"),
    ("timeout", "u16", 1, "ms", "Time limit of the cycle, up to 60000; 0 the cell's"),
    ("plc_heartbeat", "u16", 1, "", "Change it at least every 2 s; 0 not monitored"),
    ("feedback_grasp_id", "u16", 1, "", "Grasp whose outcome is reported"),
    ("feedback_code", "u16", 1, "", "1 ok, 2 missed, 3 dropped, 4 collision, 5 skipped, 6 double, 7 unreachable"),
    *_pose("Flange pose in base", "f32", 1, "flange_", "r1 r2 r3 r4", _FLOAT_ANGLE),
    ("feedback_seq", "u16", 1, "", "seq of the result the grasp belongs to"),
    ("bin", "u16", 1, "", "Bin number; 0 the recipe's"),
    *_pose("Flange pose in base, int16 form", "i16", 0.1, "flange_int_", "rx ry rz", _INT_ANGLE),
    ("flange_flags", "u16", 1, "bits", "b0 the flange pose is valid; b1 it stands in the int16 form"),
)
IDENTITY = _table(
    0,
    ("magic", "u16", 1, "", "0xB1D0"),
    ("layout_version", "u16", 1, "", "Version of this map"),
    ("test_u32", "u32", 1, "", "0x01020304: proves the word order"),
    ("test_f32", "f32", 1, "", "123456.0: proves the word order"),
    ("capabilities", "u16", 1, "bits", "Bit n: command n is available"),
    ("max_records", "u16", 1, "", "Records in a page"),
    ("rig_version", "u16", 1, "", "Version of the rig in use"),
    ("spare_9", "u16", 1, "", "0"),
    ("status", "u16", 1, "bits", "; ".join(f"b{i} {bit.name}" for i, bit in enumerate(Status))),
    ("heartbeat", "u16", 1, "", "Counts up ten times a second"),
    ("active_recipe", "u16", 1, "", "Recipe of the last command"),
    ("mode", "u16", 1, "", "Who controls the cell: 0 nobody, 1 Modbus, 2 REST"),
    ("camera_states", "u16", 1, "bits", "Two bits a camera, left first: connected, in error"),
    ("latched_error", "i16", 1, "", "Last failure or refusal until CLEAR_ERR or the next accepted command, or why READY is 0"),
)
HEADER = _table(
    100,
    ("seq", "u16", 1, "", "Number of the result, 1 to 65535; 0 none"),
    ("boot_id", "u16", 1, "", "Changes when the service starts"),
    ("cmd_seq", "u16", 1, "", "Echo: move only if it is yours"),
    ("command", "u16", 1, "", "Echo"),
    ("status", "u16", 1, "bits", "As register 10"),
    ("return_code", "i16", 1, "", "0 to 3: grasps; 100 and up: the scene says no; below 0: failed"),
    ("detail", "u16", 1, "", ", ".join(f"{d.value} {d.name.lower().replace('_', ' ')}" for d in Detail)),
    ("recipe", "u16", 1, "", "Recipe that was used"),
    ("bin", "u16", 1, "", "Bin that was used"),
    ("frame", "u16", 1, "", "Frame of the poses: 1 camera, 2 bin, 3 base"),
    ("pose_format", "u16", 1, "", "Format of R1 to R4"),
    ("tool", "u16", 1, "", "Tool that was asked for"),
    ("n_total", "u16", 1, "", "Grasps in the result"),
    ("n_in_page", "u16", 1, "", "Records used in this page"),
    ("page", "u16", 1, "", "This page, from 0; NEXT_PAGE rising shows the next"),
    ("remaining", "u16", 1, "", "Grasps on later pages"),
    ("t_acq", "u16", 1, "ms", "Time until the images were there"),
    ("t_total", "u16", 1, "ms", "Time of the whole cycle"),
    ("fill", "u16", 0.001, "", "Fill level of the bin; 65535 unknown"),
    _CHECK,
)
_RECORD: tuple[Row, ...] = (
    ("seq", "u16", 1, "", "Result this record belongs to"),
    ("grasp_id", "u16", 1, "", "Number of the grasp in its result; 0 unused"),
    *_pose("TCP in the frame of the header; unused 1.0e6", "f32", 1, "", "r1 r2 r3 r4", _FLOAT_ANGLE),
    ("flags", "u16", 1, "bits", "b0 this record may be used"),
    ("tool", "u16", 1, "", "Tool number"),
    ("label", "u16", 1, "", "Number of the part in its scene"),
    ("quality", "u16", 0.001, "", "0 to 1, higher is better"),
    ("open", "u16", 0.1, "mm", "Opening between the fingers on the way in; 0 for suction"),
    ("close", "u16", 0.1, "mm", "Opening between the fingers when they hold; 0 for suction"),
    ("approach", "u16", 0.1, "mm", "Straight way from pre-grasp to grasp along z"),
    ("sigma_pos", "u16", 0.01, "mm", "1-sigma uncertainty of the position"),
    ("sigma_rot", "u16", 0.1, "mrad", "1-sigma uncertainty of the tilt"),
    _CHECK,
)
RECORDS = tuple(_table(base, *_RECORD) for base in (120, 146, 172, 198))
BLOCK = _table(224, ("check", "u16", 1, "", "(0x5A5A + the sum of words 100 to 223) mod 65536: one read of 125 words"))
COMPACT = _table(
    300,
    *((row.name, row.kind, row.scale, row.unit, row.sentence) for row in HEADER
      if row.name in ("seq", "cmd_seq", "return_code", "recipe", "bin", "frame", "remaining")),
    ("grasp_id", "u16", 1, "", "First grasp of this page; 0 none"),
    *_pose("TCP in the frame above; unused -32768", "i16", 0.1, "", "rx ry rz", _INT_ANGLE),
    *(row for name in ("quality", "tool", "open", "close", "approach") for row in _RECORD if row[0] == name),
    _CHECK,
)
COUNTS = {
    "started": "Cycles started",
    "finished": "Results published",
    "refused": "Triggers turned away",
    "aborted": "Cycles aborted",
    "timeouts": "Cycles past their time limit",
    "withdrawn": "Results taken back unread",
    "expired": "Results unread for too long",
    "late": "Results that came after their cycle was given up",
    "camera_failures": "Cycles without a usable pair",
}
DIAGNOSTICS = _table(
    320,
    ("skew", "u32", 1, "µs", "Time between the two exposures of the last pair"),
    ("skew_sigma", "u32", 1, "µs", "1-sigma uncertainty of the skew"),
    ("resends", "u32", 1, "", "Packets sent again for the last pair"),
    ("missing", "u32", 1, "", "Packets that never came for the last pair"),
    *((name, "u32", 1, "", f"{sentence}, since start") for name, sentence in COUNTS.items()),
    ("calibration", "u16", 1, "", "What the watchdog says: 0 nothing yet, 1 ok, 2 warning, 3 fault"),
    ("row_error", "i16", 0.001, "px", "Rows of the right image below the left's, last cycle; -32768 unknown"),
    ("row_off", "i16", 0.001, "px", "What counts for the watchdog's limits, over the last cycles; -32768 unknown"),
    ("row_change", "i16", 0.001, "px", "Change of the row error over 100 cycles; -32768 unknown"),
    ("marks_seen", "u16", 1, "", "Reference marks that both cameras saw"),
    ("marks_shift", "u16", 0.01, "mm", "Cameras against the cell since the marks were stored"),
    ("marks_turn", "u16", 0.01, "mrad", "Likewise"),
    ("depth_error", "i16", 0.01, "mm", "What the marks say depth is off; -32768 unknown"),
    ("correction", "u16", 0.001, "mrad", "Turn by which the second camera is corrected; 0 none"),
    *((f"spare_{n}", "u16", 1, "", "0") for n in range(355, 359)),
    _CHECK,
)
INPUT_TABLES = (IDENTITY, HEADER, *RECORDS, BLOCK, COMPACT, DIAGNOSTICS)


def rows() -> Iterator[tuple[str, Register]]:
    """Every row with the table it belongs to: holding, or input (also readable in holding at + 1000)."""
    yield from (("holding", register) for register in HOLDING)
    yield from (("input", register) for table in INPUT_TABLES for register in table)


def csv() -> str:
    """The map as a file: physical value = raw × scale."""
    text = io.StringIO()
    writer = csv_format.writer(text, lineterminator="\n")
    writer.writerow(("table", "address", "name", "type", "scale", "unit", "meaning"))
    writer.writerows((t, r.address, r.name, r.kind, r.scale, r.unit, r.sentence) for t, r in rows())
    return text.getvalue()
