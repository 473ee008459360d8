"""Does a GigE Vision camera answer at this address? One discovery datagram, instead of a driver's seconds of retries."""

import socket
import time

PORT = 3956
DISCOVERY = bytes.fromhex("4201000200000001")
"""GVCP: key 0x42, acknowledge wanted, DISCOVERY_CMD, no payload, request 1 (GigE Vision 1.2)."""
DISCOVERY_ACK = bytes.fromhex("00000003")
TRIES = 3
TRY_S = 0.15


def answers(address: str) -> bool:
    """Asks `address` up to three times, 0.15 s each; False also when the address is none or cannot be reached."""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((address, PORT))
            return any(_asked(probe) for _ in range(TRIES))
    except OSError:          # not an address, or no route to it
        return False


def _asked(probe: socket.socket) -> bool:
    until = time.monotonic() + TRY_S
    try:
        probe.send(DISCOVERY)
        while (left := until - time.monotonic()) > 0:
            probe.settimeout(left)
            if probe.recv(1024)[:4] == DISCOVERY_ACK:
                return True
    except TimeoutError:
        return False
    except ConnectionRefusedError:
        time.sleep(max(0.0, until - time.monotonic()))     # nobody listens: it may be starting just now
    return False
