"""The camera's register space: bootstrap registers, features and the GenICam file, as bytes with rules for writing.

Layout: GigE Vision 1.2, table of bootstrap registers.
"""

import ipaddress
import math
import struct

from binpick.sim.gige import description, features
from binpick.sim.gige.action import SIGNALS
from binpick.sim.gige.features import Feature
from binpick.sim.gige.gvcp import Fault, Status

DISCOVERY_LENGTH = 0xF8


class Registers:
    """Big-endian memory. Reading is free everywhere inside; a write must hit one writable register whole and in range."""

    def __init__(self, address: str, width: int, height: int, serial: str) -> None:
        rows = features.table(width, height, serial)
        xml = description.description(rows)
        self._features = {row.name: row for row in rows}
        self._memory = bytearray(features.XML_BASE + -(-len(xml) // 4) * 4)
        self._memory[features.XML_BASE:features.XML_BASE + len(xml)] = xml
        self._writable: dict[int, tuple[Feature, int]] = {}
        for row in rows:
            if row.access != "RO":
                for index in range(row.count):
                    # of registers with several fields the last row, the number, checks the range
                    self._writable[row.address + index * row.step] = row, index
            if row.kind != "command":
                for index in range(row.count):
                    self.set(row.name, row.pins.get(index, row.value), index)
        packed = ipaddress.IPv4Address(address).packed
        self._words(0x00, 0x00010002, 0x80000001)                      # version 1.2; big-endian, UTF-8
        self._memory[0x0A:0x10] = b"\x02\x42" + packed                 # a locally administered MAC
        self._words(0x10, 0x4, 0x4)                                    # IP configuration: link-local
        self._memory[0x24:0x28] = packed
        self._memory[0x34:0x38] = b"\xff\x00\x00\x00"
        url = f"Local:binpick-sim.xml;{features.XML_BASE:X};{len(xml):X}".encode()
        self._memory[0x200:0x200 + len(url)] = url
        self._words(0x600, 1)                                          # network interfaces
        self._words(0x900, 0, 1, SIGNALS)                              # message channels, stream channels, action signals
        self._words(0x934, 0xC04E0047)      # user id, serial, 2.0 status codes, PTP, scheduled actions; ACTION,
        #                                     PACKETRESEND, WRITEMEM, concatenation

    def _words(self, address: int, *words: int) -> None:
        struct.pack_into(f">{len(words)}I", self._memory, address, *words)

    @property
    def discovery(self) -> bytes:
        """The payload of a discovery acknowledge: the first bootstrap registers."""
        return bytes(self._memory[:DISCOVERY_LENGTH])

    def read(self, address: int, length: int) -> bytes:
        """Raises Fault when any of it is outside, or not aligned to 4 bytes."""
        if address % 4 or length % 4:
            raise Fault(Status.BAD_ALIGNMENT)
        if address + length > len(self._memory):
            raise Fault(Status.INVALID_ADDRESS)
        return bytes(self._memory[address:address + length])

    def write(self, address: int, data: bytes) -> str:
        """The written feature's name. Raises Fault when no register begins there, it is read-only, or out of range."""
        if address % 4:
            raise Fault(Status.BAD_ALIGNMENT)
        feature, index = self._writable.get(address, (None, 0))
        if feature is None:
            raise Fault(Status.WRITE_PROTECT if address + len(data) <= len(self._memory) else Status.INVALID_ADDRESS)
        if len(data) != feature.length or not _allowed(feature, data, index):
            raise Fault(Status.INVALID_PARAMETER)
        if feature.increment:
            steps = math.ceil(struct.unpack(">d", data)[0] / feature.increment - 1e-9)
            data = struct.pack(">d", steps * feature.increment)
        if feature.kind != "command":
            self._memory[address:address + len(data)] = data
        return feature.name

    def number(self, name: str, index: int = 0) -> int | float:
        """The value of an integer, enumeration, boolean or float feature; `index` is its selector's value."""
        row = self._features[name]
        address = row.address + index * row.step
        data = bytes(self._memory[address:address + row.length])
        if row.kind == "float":
            return float(struct.unpack(">d", data)[0])
        word = int.from_bytes(data, "big", signed=row.signed)
        if row.bits is None:
            return word
        high, low = row.bits
        return word >> (31 - low) & ((1 << (low - high + 1)) - 1)

    def integer(self, name: str, index: int = 0) -> int:
        """As `number`, for features that are whole numbers."""
        return int(self.number(name, index))

    def name(self, feature: str, index: int = 0) -> str:
        """The entry that an enumeration stands at."""
        value = self.integer(feature, index)
        return next(entry for entry, number in self._features[feature].entries.items() if number == value)

    def choose(self, feature: str, entry: str) -> None:
        """Sets an enumeration by its entry's name."""
        self.set(feature, self._features[feature].entries[entry])

    def set(self, name: str, value: int | float | str, index: int = 0) -> None:
        """The camera changes one of its own features, whatever a client may do."""
        row = self._features[name]
        address = row.address + index * row.step
        if isinstance(value, str):
            data = value.encode().ljust(row.length, b"\0")[:row.length]
        elif row.kind == "float":
            data = struct.pack(">d", value)
        elif row.bits is not None:
            high, low = row.bits
            mask = ((1 << (low - high + 1)) - 1) << (31 - low)
            word = int.from_bytes(self._memory[address:address + 4], "big")
            data = (word & ~mask | int(value) << (31 - low)).to_bytes(4, "big")
        else:
            data = int(value).to_bytes(row.length, "big", signed=row.signed)
        self._memory[address:address + row.length] = data


def _allowed(feature: Feature, data: bytes, index: int) -> bool:
    if feature.kind == "string":
        return True
    if feature.kind == "float":
        return bool(feature.minimum <= struct.unpack(">d", data)[0] <= feature.maximum)
    number = int.from_bytes(data, "big")
    if feature.kind == "command":
        return number == feature.value
    if feature.bits:
        number &= (1 << (feature.bits[1] - feature.bits[0] + 1)) - 1
    if index in feature.pins:
        return number == feature.pins[index]
    if feature.entries:
        return number in feature.entries.values()
    if feature.kind == "boolean":
        return number in (0, 1)
    return feature.minimum <= number <= feature.maximum
