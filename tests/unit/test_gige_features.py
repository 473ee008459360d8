"""The feature table makes the registers and the description; both must say the same."""

import struct
import xml.etree.ElementTree as Xml

import pytest

from binpick.sim.gige import description, features
from binpick.sim.gige.gvcp import Fault
from binpick.sim.gige.registers import Registers

SPACE = "{http://www.genicam.org/GenApi/Version_1_1}"
ROWS = features.table(640, 400, "S1")


@pytest.fixture
def registers() -> Registers:
    return Registers("127.0.9.2", 640, 400, "S1")


def test_every_reference_of_the_description_exists() -> None:
    root = Xml.fromstring(description.description(ROWS))
    names = [node.get("Name") for node in root]
    assert len(names) == len(set(names))
    references = {leaf.text for node in root for leaf in node if leaf.tag.removeprefix(SPACE) in
                  ("pFeature", "pValue", "pPort", "pIndex", "pSelected")}
    assert references <= set(names)
    reachable = {leaf.text for node in root if node.tag == f"{SPACE}Category" for leaf in node}
    assert {row.name for row in ROWS} <= reachable


def test_registers_do_not_overlap() -> None:
    taken: dict[int, features.Feature] = {}
    for row in ROWS:
        starts = range(row.address, row.address + row.step * row.count, row.step)
        for address in (start + byte for start in starts for byte in range(row.length)):
            other = taken.setdefault(address, row)
            assert other is row or (other.bits and row.bits), (row.name, other.name)


def test_power_up_values(registers: Registers) -> None:
    for row in ROWS:
        if row.kind not in ("command", "string"):
            assert registers.number(row.name) == row.value, row.name
    assert registers.integer("PayloadSize") == 640 * 400


def test_a_selector_picks_one_of_several(registers: Registers) -> None:
    line = next(row for row in ROWS if row.name == "LineSource")
    registers.write(line.address + 2 * 4, struct.pack(">I", features.LINE_SOURCES["ExposureActive"]))
    assert [registers.integer("LineSource", index) for index in range(4)] == [0, 0, 4, 0]


def test_opto_isolated_lines_cannot_turn_round(registers: Registers) -> None:
    mode = next(row for row in ROWS if row.name == "LineMode")
    modes = features.LINE_MODES
    assert [registers.name("LineMode", index) for index in range(4)] == ["Input", "Input", "Output", "Input"]
    registers.write(mode.address + 4, struct.pack(">I", modes["Output"]))
    registers.write(mode.address + 8, struct.pack(">I", modes["Output"]))
    with pytest.raises(Fault, match="INVALID_PARAMETER"):
        registers.write(mode.address + 12, struct.pack(">I", modes["Output"]))
    assert [registers.name("LineMode", index) for index in range(4)] == ["Input", "Output", "Output", "Input"]


def test_a_negative_offset(registers: Registers) -> None:
    registers.set("PtpOffsetFromMaster", -37)
    assert registers.number("PtpOffsetFromMaster") == -37


def test_fields_of_one_register_keep_apart(registers: Registers) -> None:
    registers.write(0xD04, struct.pack(">I", 1 << 30 | 8000))
    assert (registers.integer("GevSCPSDoNotFragment"), registers.integer("GevSCPSPacketSize")) == (1, 8000)
    registers.set("GevSCPSFireTestPacket", 1)
    assert registers.read(0xD04, 4) == struct.pack(">I", 3 << 30 | 8000)


@pytest.mark.parametrize("value", [19.0, 2e7, float("nan")])
def test_exposure_out_of_range_is_refused(registers: Registers, value: float) -> None:
    exposure = next(row for row in ROWS if row.name == "ExposureTime")
    with pytest.raises(Fault, match="INVALID_PARAMETER"):
        registers.write(exposure.address, struct.pack(">d", value))
    registers.write(exposure.address, struct.pack(">d", 2500.5))
    assert registers.number("ExposureTime") == 2500.5
