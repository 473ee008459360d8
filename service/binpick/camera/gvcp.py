"""GVCP, a camera's control protocol, beside the driver: a datagram of our own, and what acknowledges it (GigE Vision 2.0)."""

import itertools
import socket
import struct
import time
from typing import NamedTuple

PORT = 3956
DISCOVERY, READREG, ACTION = 0x0002, 0x0080, 0x0100
"""Commands; an acknowledge has the next number."""
KEY, ACKNOWLEDGE = 0x42, 0x01
"""What every command begins with, and the flag that asks for an acknowledge."""
COMMAND = struct.Struct(">BBHHH")
REPLY = struct.Struct(">HHHH")
PRIVILEGE = bytes.fromhex("00000a00")
"""READREG's payload for the control channel's privilege, which anybody may read."""
CONTROLLED = 0b11
"""Exclusive access, and control access."""
TRIES = 3
TRY_S = 0.15
_numbers = itertools.count()


class Reply(NamedTuple):
    """An acknowledge; `status` is 0 when the command was accepted, `number` that of the command."""

    status: int
    number: int
    payload: bytes

    @property
    def value(self) -> int:
        """Of the register that was asked for."""
        return int.from_bytes(self.payload[:4], "big")

    @property
    def held(self) -> bool:
        """Of the privilege: somebody controls the camera; one that is kept exclusively refuses even to tell."""
        return bool(self.status or self.value & CONTROLLED)


def number() -> int:
    """Of the next command, 1 to 65535: a camera takes two of one number for the same command, sent again."""
    return next(_numbers) % 0xFFFF + 1


def command(code: int, number: int, payload: bytes = b"", flags: int = 0) -> bytes:
    """The datagram, to be acknowledged."""
    return COMMAND.pack(KEY, ACKNOWLEDGE | flags, code, len(payload), number) + payload


def reply(datagram: bytes, code: int) -> Reply | None:
    """The acknowledge of such a command; None: it is something else."""
    if len(datagram) < REPLY.size:
        return None
    status, acknowledged, _length, number = REPLY.unpack_from(datagram)
    return Reply(status, number, datagram[REPLY.size:]) if acknowledged == code + 1 else None


def ask(address: str, code: int, payload: bytes = b"") -> Reply | None:
    """What it answers, asked up to three times, 0.15 s each; None also when the address is none or cannot be reached."""
    this = number()
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
            asking.connect((address, PORT))
            tries = (_asked(asking, command(code, this, payload), code, this) for _ in range(TRIES))
            return next((said for said in tries if said is not None), None)
    except OSError:          # not an address, or no route to it
        return None


def _asked(asking: socket.socket, question: bytes, code: int, number: int) -> Reply | None:
    until = time.monotonic() + TRY_S
    try:
        asking.send(question)
        while (left := until - time.monotonic()) > 0:
            asking.settimeout(left)
            said = reply(asking.recv(1024), code)
            if said is not None and said.number == number:
                return said
    except TimeoutError:
        return None
    except ConnectionRefusedError:
        time.sleep(max(0.0, until - time.monotonic()))     # nobody listens: it may be starting just now
    return None
