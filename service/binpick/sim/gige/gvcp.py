"""GVCP, the control protocol: what a client's datagram asks, and the acknowledge it gets (GigE Vision 1.2, UDP port 3956)."""

import struct
from dataclasses import dataclass
from enum import IntEnum

PORT = 3956
KEY = 0x42
ACKNOWLEDGE = 0x01
HEADER = struct.Struct(">BBHHH")


class Code(IntEnum):
    """Commands; an acknowledge has the next number."""

    DISCOVERY = 0x0002
    PACKETRESEND = 0x0040
    READREG = 0x0080
    WRITEREG = 0x0082
    READMEM = 0x0084
    WRITEMEM = 0x0086
    ACTION = 0x0100


class Status(IntEnum):
    """Why a command was refused."""

    NOT_IMPLEMENTED = 0x8001
    INVALID_PARAMETER = 0x8002
    INVALID_ADDRESS = 0x8003
    WRITE_PROTECT = 0x8004
    BAD_ALIGNMENT = 0x8005
    ACCESS_DENIED = 0x8006
    NO_REF_TIME = 0x8013
    ACTION_LATE = 0x8016


class Fault(Exception):
    """A command that is refused with a status."""

    def __init__(self, status: Status) -> None:
        super().__init__(status.name)
        self.status = status


@dataclass(frozen=True, slots=True)
class Command:
    """A datagram taken apart."""

    code: int
    flags: int
    number: int
    payload: bytes

    @property
    def wants_answer(self) -> bool:
        """Whether the client asked for an acknowledge."""
        return bool(self.flags & ACKNOWLEDGE)


def parse(datagram: bytes) -> Command | None:
    """The command, or None when the datagram is none."""
    if len(datagram) < HEADER.size:
        return None
    key, flags, code, length, number = HEADER.unpack_from(datagram)
    payload = datagram[HEADER.size:]
    if key != KEY or length != len(payload):
        return None
    return Command(code, flags, number, payload)


def is_resend(datagram: bytes) -> bool:
    """Whether it asks for packets to be sent again, without taking it apart."""
    return datagram[2:4] == Code.PACKETRESEND.to_bytes(2, "big")


def acknowledge(command: Command, payload: bytes) -> bytes:
    """The datagram of success."""
    return struct.pack(">HHHH", 0, command.code + 1, len(payload), command.number) + payload


def refuse(command: Command, status: Status) -> bytes:
    """The datagram of refusal."""
    return struct.pack(">HHHH", status, command.code + 1, 0, command.number)


def words(payload: bytes) -> tuple[int, ...]:
    """A payload as 32-bit numbers. Raises Fault when it is not made of them."""
    if not payload or len(payload) % 4:
        raise Fault(Status.INVALID_PARAMETER)
    return struct.unpack(f">{len(payload) // 4}I", payload)
