"""Action commands: one datagram that starts all cameras, now or at a time of their common clock; Aravis has none.

GigE Vision 2.0, ACTION_CMD. A datagram that was lost is sent again under its number: who has carried it out only
acknowledges it.
"""

import socket
import struct
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass

from binpick.camera import gvcp
from binpick.camera.network import port_of

GROUP = 1
"""Group key and mask: the device key alone tells our cameras from others."""
SCHEDULED = 0x80
"""The flag that announces a time behind the keys."""
EVERYBODY = "255.255.255.255"
STATUSES = {0x8013: "it has no PTP time", 0x8014: "it has too many actions waiting", 0x8016: "it came late"}
TRIES = 3
TRY_S = 0.05


@dataclass(frozen=True, slots=True)
class Action:
    """What cameras listen for; `at_ns` is a time of their common clock, 0: at once."""

    device_key: int
    group_key: int = GROUP
    group_mask: int = GROUP
    at_ns: int = 0


def datagram(action: Action, number: int) -> bytes:
    """The command, to be acknowledged."""
    keys = struct.pack(">III", action.device_key, action.group_key, action.group_mask)
    if not action.at_ns:
        return gvcp.command(gvcp.ACTION, number, keys)
    return gvcp.command(gvcp.ACTION, number, keys + struct.pack(">Q", action.at_ns), SCHEDULED)


def answer(reply: bytes, number: int) -> int | None:
    """The status in an acknowledge of that command, 0 when it was accepted; None for any other datagram."""
    said = gvcp.reply(reply, gvcp.ACTION)
    return said.status if said is not None and said.number == number else None


def broadcast(action: Action, addresses: tuple[str, ...], target: str = EVERYBODY) -> dict[str, str]:
    """Sends it out of every port that cameras hang on; why each camera did not accept it, "" when it did.

    Waits until all have answered, at most 3 times 0.05 s.
    """
    number = gvcp.number()
    command, said = datagram(action, number), dict.fromkeys(addresses, "it did not acknowledge")
    with ExitStack() as stack:
        sockets = [stack.enter_context(_socket(port)) for port in dict.fromkeys(map(port_of, addresses))]
        open_ = set(addresses)
        for _ in range(TRIES):
            for out in sockets:
                out.sendto(command, (target, gvcp.PORT))
            for address, status in _replies(sockets, number, open_):
                said[address] = STATUSES.get(status, f"status 0x{status:04x}") if status else ""
                open_.discard(address)
            if not open_:
                break
    return said


def _socket(port: str) -> socket.socket:
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    out.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
    out.bind((port, 0))
    return out


def _replies(sockets: list[socket.socket], number: int, open_: set[str]) -> Iterator[tuple[str, int]]:
    """(address, status) of cameras that had not answered yet, until all have or the time is over."""
    until = time.monotonic() + TRY_S
    for out in sockets:
        while open_ and (left := until - time.monotonic()) > 0:
            out.settimeout(left / len(sockets))
            try:
                reply, (address, _) = out.recvfrom(1024)
            except TimeoutError:
                break
            status = answer(reply, number)
            if status is not None and address in open_:
                yield address, status
