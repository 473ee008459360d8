"""The stream channel: an image gets its format, time stamp and block number, is entered in the ledger, and leaves."""

import socket
from collections.abc import Callable
from contextlib import suppress

from binpick.data import Image
from binpick.sim.gige import gvsp, pixels
from binpick.sim.gige.conditions import Conditions
from binpick.sim.gige.features import LINK_BYTES_PER_S
from binpick.sim.gige.gvsp import Block, Sender, Target
from binpick.sim.gige.ledger import Ledger
from binpick.sim.gige.registers import Registers
from binpick.sim.gige.sensor import Shot


class Stream:
    """From `head`, as its registers and the conditions of the moment say; `stamp(host_ns)` is the head's clock."""

    def __init__(self, head: int, address: str, registers: Registers, ledger: Ledger, stamp: Callable[[int], int]) -> None:
        self._head, self._registers, self._ledger, self._stamp = head, registers, ledger, stamp
        self._led = 0
        self.sender = Sender(address, 1e9)
        registers.set("GevSCSP", self.sender.port)

    def began(self, shot: Shot, conditions: Conditions) -> None:
        """Some cameras announce an image when its exposure begins."""
        if conditions.early_leader and conditions.plugged:
            width, height = self._registers.integer("Width"), self._registers.integer("Height")
            packet = gvsp.leader(shot.block, self._stamp(shot.started_ns), self._format(conditions), width, height)
            with suppress(OSError):
                self.sender.lead(packet, self._target())
                self._led = shot.number

    def deliver(self, shot: Shot, image: Image, conditions: Conditions, wanted: bool) -> None:
        """Sends it if anybody wants it and nothing is in the way. Raises OSError when power goes meanwhile."""
        payload, stamp = pixels.pack(image, self._format(conditions)), self._stamp(shot.started_ns)
        sends = wanted and conditions.streams
        self._ledger.enter(self._head, shot, stamp, payload, sends)
        if sends:
            self._pace(conditions)
            block = Block(shot.block, stamp, payload, self._registers.integer("GevSCPSPacketSize"))
            target = self._target()
            if target[1]:           # closed since a moment ago: nobody listens at port 0
                self.sender.send(block, target, led=self._led == shot.number)

    def _pace(self, conditions: Conditions) -> None:
        """A limit below the link's speed counts; the simulated wire is faster than a real one unless it is told not to be."""
        read = self._registers.integer
        limited = read("DeviceLinkThroughputLimitMode") and read("DeviceLinkThroughputLimit") < LINK_BYTES_PER_S
        wire = conditions.link_mbps * 1e6
        self.sender.bits_per_s = min(wire, read("DeviceLinkThroughputLimit") * 8.0) if limited else wire
        self.sender.gap_ns = read("GevSCPD")

    def resend(self, block: int, first: int, last: int) -> None:
        """Packets of an image that was sent a moment ago."""
        with suppress(OSError):
            self.sender.resend(self._target(), block, first, last)

    def test(self) -> None:
        """A packet of the size that is set."""
        with suppress(OSError):      # too large for the interface: exactly what the test is to find out
            self.sender.test(self._target(), self._registers.integer("GevSCPSPacketSize"))

    def _format(self, conditions: Conditions) -> int:
        return pixels.FORMATS.get(conditions.pixel_format, self._registers.integer("PixelFormat"))

    def _target(self) -> Target:
        return (socket.inet_ntoa(self._registers.integer("GevSCDA").to_bytes(4, "big")),
                self._registers.integer("GevSCPHostPort"))
