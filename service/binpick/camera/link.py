"""Whether an idle camera is still there, and whose it is: datagrams of our own, asked now and then, never waited for."""

import contextlib
import socket
import time
from typing import Literal

from binpick.camera import gvcp
from binpick.camera.base import Clock, MonotonicNs

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
        self._asked_ns: MonotonicNs = 0
        self._unanswered: tuple[int, MonotonicNs] = (0, 0)

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
        question = gvcp.command(gvcp.READREG, gvcp.number(), gvcp.PRIVILEGE)
        with contextlib.suppress(OSError):       # no way there: nobody will answer
            self._socket.sendto(question, (self._address, gvcp.PORT))

    def _listen(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                try:
                    datagram, peer = self._socket.recvfrom(1024)
                except ConnectionError:
                    continue
                said = gvcp.reply(datagram, gvcp.READREG)
                if said is not None and peer == (self._address, gvcp.PORT):
                    self._state, self._unanswered = "held" if said.held else "free", (0, 0)
