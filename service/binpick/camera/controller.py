"""Who controls the camera at an address? Two of its registers, each read by a datagram, without opening it."""

import socket
import struct
from ipaddress import IPv4Address

from binpick.camera.link import PRIVILEGE, READ, READREG, READREG_ACK
from binpick.camera.probe import PORT, TRIES, TRY_S

VALUE = struct.Struct(">HHHHI")
"""A reply with its one register."""
CONTROLLED = 0b11
"""Exclusive access, and control access."""
CONTROLLER_ADDRESS = 0xA14
"""Optional: many cameras do not tell it."""


def of(address: str) -> str | None:
    """"" when it is free, the controller's IPv4 address or "another program" when it is not, None: it does not answer."""
    privilege = _register(address, PRIVILEGE, 1)
    if privilege is None:
        return None
    if not privilege & CONTROLLED:
        return ""
    controller = _register(address, CONTROLLER_ADDRESS, 2)
    return str(IPv4Address(controller)) if controller else "another program"


def _register(address: str, register: int, request: int) -> int | None:
    """None: no answer, or the camera has no such register."""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
            asking.settimeout(TRY_S)
            asking.connect((address, PORT))
            return next((value for _ in range(TRIES) if (value := _asked(asking, register, request)) is not None), None)
    except OSError:          # nobody listens, or no route to it
        return None


def _asked(asking: socket.socket, register: int, request: int) -> int | None:
    try:
        asking.send(READ.pack(0x42, 1, READREG, 4, request, register))
        answer = asking.recv(64)
    except TimeoutError:
        return None
    if len(answer) != VALUE.size:      # a refusal carries no value
        return None
    status, code, _length, of_request, value = VALUE.unpack(answer)
    return value if (status, code, of_request) == (0, READREG_ACK, request) else None
