"""The map itself: addresses, no overlaps, and the file made from it."""

from pathlib import Path

from binpick.publish import registers
from binpick.publish.registers import (
    BLOCK,
    COMPACT,
    DIAGNOSTICS,
    HEADER,
    HOLDING,
    HOLDING_WORDS,
    IDENTITY,
    INPUT_TABLES,
    INPUT_WORDS,
    PAGE_SIZE,
    RECORDS,
    Ctrl,
    Register,
    Status,
)


def at(table: tuple[Register, ...]) -> dict[str, int]:
    return {register.name: register.address for register in table}


def test_addresses_are_those_of_the_contract() -> None:
    holding = at(HOLDING)
    assert [holding[n] for n in ("ctrl", "command", "cmd_seq", "recipe", "tool", "frame")] == [0, 1, 2, 3, 4, 5]
    assert [holding[n] for n in ("max_grasps", "pose_format")] == [6, 7]
    assert [holding[n] for n in ("timeout", "plc_heartbeat", "feedback_grasp_id", "feedback_code")] == [8, 9, 10, 11]
    assert [holding[n] for n in ("flange_x", "flange_r4", "feedback_seq", "bin")] == [12, 24, 26, 27]
    assert [holding[n] for n in ("flange_int_x", "flange_int_rz", "flange_flags")] == [28, 33, 34]
    identity = at(IDENTITY)
    assert [identity[n] for n in ("magic", "test_u32", "test_f32", "capabilities", "max_records")] == [0, 2, 4, 6, 7]
    assert [identity[n] for n in ("status", "heartbeat", "latched_error")] == [10, 11, 15]
    header = ("seq boot_id cmd_seq command status return_code detail recipe bin frame pose_format tool n_total n_in_page page "
              "remaining t_acq t_total fill check")
    assert list(at(HEADER).items()) == list(zip(header.split(), range(100, 120), strict=True))
    record = "flags tool label quality open close approach sigma_pos sigma_rot check"
    for first, table in zip((120, 146, 172, 198), RECORDS, strict=True):
        assert list(at(table))[:9] == ["seq", "grasp_id", *"xyz", "r1", "r2", "r3", "r4"]
        assert list(at(table).items())[9:] == list(zip(record.split(), range(first + 16, first + 26), strict=True))
    assert at(BLOCK) == {"check": 224}
    compact = ("seq cmd_seq return_code recipe bin frame remaining grasp_id x y z rx ry rz quality tool open close approach "
               "check")
    assert list(at(COMPACT).items()) == list(zip(compact.split(), range(300, 320), strict=True))
    assert (DIAGNOSTICS[0].address, at(DIAGNOSTICS)["check"]) == (320, 359)


def test_no_two_rows_share_a_word_and_floats_are_even() -> None:
    for tables, words in (((HOLDING,), HOLDING_WORDS), (INPUT_TABLES, INPUT_WORDS)):
        used = [a for table in tables for r in table for a in range(r.address, r.address + r.words)]
        assert len(used) == len(set(used))
        assert max(used) == words - 1
        assert all(r.address % 2 == 0 for table in tables for r in table if r.kind in ("f32", "u32"))


def test_one_read_of_the_protocols_maximum_covers_header_records_and_check() -> None:
    assert BLOCK[0].address - HEADER[0].address + 1 == 125
    assert len(RECORDS) == PAGE_SIZE


def test_compact_needs_no_word_pairs() -> None:
    assert {register.kind for register in COMPACT} <= {"u16", "i16"}


def test_bits_are_in_the_contracts_order() -> None:
    assert [bit.name for bit in Ctrl] == ["ENABLE", "TRIG", "RES_ACK", "NEXT_PAGE", "CLEAR_ERR", "ABORT", "ROBOT_CLEAR",
                                          "FEEDBACK_STROBE"]
    assert [bit.name for bit in Status] == ["READY", "ACK", "NACK", "BUSY", "ACQ_DONE", "VALID", "ERROR", "WARN", "LAST_PAGE",
                                            "CALIB_WARN", "DEGRADED", "SIM"]
    assert [bit.value for bit in Status] == [1 << i for i in range(12)]


def test_every_row_has_a_sentence() -> None:
    assert all(register.sentence for _, register in registers.rows())


def test_the_file_beside_the_product_is_current() -> None:
    path = Path(__file__).parents[2] / "deploy" / "register-map.csv"
    assert path.read_text(encoding="utf-8") == registers.csv(), "run `make schema`"
