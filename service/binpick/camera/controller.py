"""Who controls the camera at an address? Two of its registers, each read by a datagram, without opening it."""

import socket
import struct
from ipaddress import IPv4Address

from binpick.camera.probe import PORT, TRIES, TRY_S

READREG = struct.Struct(">BBHHHI")
"""Key 0x42, acknowledge wanted, READREG_CMD 0x0080, 4 bytes, request number, register (GigE Vision 1.2)."""
READREG_ACK = struct.Struct(">HHHHI")
CONTROL_PRIVILEGE = 0xA00
CONTROLLED = 0b11
"""Exclusive access, and control access."""
CONTROLLER_ADDRESS = 0xA14
"""Optional: many cameras do not tell it."""


def of(address: str) -> str | None:
    """"" when it is free, the controller's IPv4 address or "another program" when it is not, None: it does not answer."""
    privilege = _register(address, CONTROL_PRIVILEGE, 1)
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
        asking.send(READREG.pack(0x42, 1, 0x80, 4, request, register))
        answer = asking.recv(64)
    except TimeoutError:
        return None
    if len(answer) != READREG_ACK.size:      # a refusal carries no value
        return None
    status, code, _length, of_request, value = READREG_ACK.unpack(answer)
    return value if (status, code, of_request) == (0, 0x81, request) else None
