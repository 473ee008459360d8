"""The wires between the cameras and this host: which port a camera hangs on, and how fast it may send there."""

import ipaddress
import socket
from collections.abc import Sequence

FRAME_OVERHEAD = 38
"""Bytes that Ethernet adds to a packet: preamble, header, check sum and the gap to the next one."""
GIGABIT = 125_000_000
"""Bytes a second of the wire when the camera does not say."""


def port_of(address: str) -> str:
    """This host's own address on the way to a camera's. Raises OSError when there is no way."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect((address, 9))           # sends nothing
        return str(probe.getsockname()[0])


def sharing(address: str, others: Sequence[str]) -> int:
    """How many cameras send through the port that this one hangs on, itself included; on the loopback there is no wire.

    An empty address is of a camera that is not found yet: it may hang there as well. Raises OSError.
    """
    port = port_of(address)
    if ipaddress.ip_address(port).is_loopback:
        return 1
    return 1 + sum(not other or _hangs_on(port, other) for other in others)


def _hangs_on(port: str, address: str) -> bool:
    try:
        return port_of(address) == port
    except OSError:           # it is nowhere
        return False


def packet_delay_ns(packet_size: int, cameras: int, link_bytes_per_s: int = GIGABIT) -> int:
    """The pause after each packet that leaves room for one packet of every other camera on the port.

    `packet_size` counts as GevSCPSPacketSize does: with IP, UDP and GVSP headers.
    """
    return round((cameras - 1) * (packet_size + FRAME_OVERHEAD) / link_bytes_per_s * 1e9)
