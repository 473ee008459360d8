"""Whether an idle camera is still there, and whose it is: datagrams of our own, asked now and then, never waited for."""

import contextlib
import socket
import struct
import time
from typing import Literal

from binpick.camera.base import Clock, MonotonicNs
from binpick.camera.probe import PORT

READ = struct.Struct(">BBHHHI")
"""GVCP READREG_CMD of one register (GigE Vision 1.2): key, acknowledge wanted, command, length, request, address."""
REPLY = struct.Struct(">HHHH")
READREG, READREG_ACK = 0x0080, 0x0081
PRIVILEGE = 0x0A00
"""The control channel privilege: anybody may read it, 0 when nobody controls the camera."""
ACCESS_DENIED = 0x8006
"""Of a camera that another program keeps to itself: even reading is refused then."""
PERIOD_NS = 200_000_000
SILENCE_NS = 600_000_000
ASKED = 3
"""Silent is who has answered none of so many questions for so long: longer than a host that stands still for half a second."""

State = Literal["unknown", "silent", "free", "held"]


class Link:
    """To one camera, by a socket of its own, for one thread. What it says is as old as the time between two calls."""

    def __init__(self, address: str, clock: Clock = time.monotonic_ns) -> None:
        self._address, self._clock = address, clock
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._state: State = "unknown"
        self._request = self._first = 0
        self._asked_ns: MonotonicNs = 0
        self._unanswered: tuple[int, MonotonicNs] = (0, 0)

    def forget(self) -> None:
        """What was asked so far is about a camera that has been opened since."""
        self._state, self._first, self._unanswered = "unknown", self._request, (0, 0)

    def feel(self) -> State:
        """What it said last, after asking it again; does not wait."""
        self._listen()
        now_ns = self._clock()
        count, since_ns = self._unanswered
        if count >= ASKED and now_ns - since_ns >= SILENCE_NS:
            self._state = "silent"
        if now_ns - self._asked_ns >= PERIOD_NS:
            self._asked_ns, self._unanswered = now_ns, (count + 1, since_ns if count else now_ns)
            self._ask()
        return self._state

    def close(self) -> None:
        """Gives the socket back."""
        self._socket.close()

    def _ask(self) -> None:
        self._request = self._request % 0xFFFF + 1
        with contextlib.suppress(OSError):       # no way there: nobody will answer
            self._socket.sendto(READ.pack(0x42, 1, READREG, 4, self._request, PRIVILEGE), (self._address, PORT))

    def _listen(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                try:
                    reply, peer = self._socket.recvfrom(1024)
                except ConnectionError:
                    continue
                if peer == (self._address, PORT):
                    self._hear(reply)

    def _hear(self, reply: bytes) -> None:
        if len(reply) < REPLY.size:
            return
        status, command, _length, request = REPLY.unpack_from(reply)
        if command != READREG_ACK or (request - self._first - 1) % 0xFFFF >= (self._request - self._first) % 0xFFFF:
            return
        free = status == 0 and not any(reply[REPLY.size:REPLY.size + 4])
        self._state, self._unanswered = "free" if free else "held", (0, 0)
