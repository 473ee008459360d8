"""The control channel's sockets: datagrams to one camera, or to all, each with the time at which the kernel got it."""

import socket
import struct

from binpick.sim.gige import gvcp
from binpick.sim.gige.clock import host_ns

BROADCASTS = ("255.255.255.255", "127.255.255.255")
SO_TIMESTAMPNS = 35
"""The socket option of asm-generic/socket.h, which Python does not name: when did the datagram arrive?"""
CONTROL_BYTES = 4 << 20
"""What may wait at the control socket; the kernel clips it to net.core.rmem_max."""


def control_socket(address: str) -> socket.socket:
    """Bound to a camera's address, or to a broadcast address, which others may share. Raises OSError when it is in use."""
    control = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    control.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    control.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, CONTROL_BYTES)
    if address in BROADCASTS:
        control.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        control.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
    try:
        control.bind((address, gvcp.PORT))
    except OSError:
        control.close()
        raise
    return control


def receive(control: socket.socket) -> tuple[bytes, tuple[str, int], int]:
    """The next datagram, its sender, and when it came by the host's clock: an exposure starts then, however late one looks."""
    datagram, ancillary, _flags, peer = control.recvmsg(2048, 64)
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == SO_TIMESTAMPNS:
            seconds, nanoseconds = struct.unpack("@qq", data)
            return datagram, peer, int(seconds * 1_000_000_000 + nanoseconds)
    return datagram, peer, host_ns()
