"""One camera's clock: latched against the host's, and what PTP says of it; on the camera's own thread, in its idle moments."""

import time
from typing import Any

from binpick.camera.aravis.features import Features
from binpick.camera.base import MonotonicNs
from binpick.camera.clock import DeviceClock, Latch
from binpick.camera.proof import SYNCHRONISED

LATCHES = (("TimestampLatch", "TimestampLatchValue"), ("GevTimestampControlLatch", "GevTimestampValue"))
"""Command and value, in ns and in ticks: SFNC's, and the bootstrap registers of GigE Vision 1."""
NS_PER_S = 1_000_000_000
FIRST_LATCHES = 8
"""At opening, so that the first pair can be proved."""
PERIOD_NS = 250_000_000
"""Between two latches of an idle camera: ten in it take the drift to 1 ppm."""
OFFSET_NS = 1_000_000_000
"""Between two looks at the offset from the master: every command may be lost, and costs half a second then."""
PATIENCE_NS = 10_000_000_000
"""So long PTP may take to find its place before it is switched off and on again; Alviums need some seconds."""


class Timekeeper:
    """`clock` is the device's clock as latched, `ptp` the camera's PtpStatus ("": it has none)."""

    def __init__(self, camera: Any, features: Features) -> None:
        self._camera = camera
        self._features = features
        self.clock = DeviceClock()
        self.ptp = ""
        self.ptp_offset_ns = 0.0
        self._lost_ns: MonotonicNs = time.monotonic_ns()
        self._offset_read_ns: MonotonicNs = 0
        self.due_ns: MonotonicNs = 0
        self._latch = next((names for names in LATCHES if all(map(features.has, names))), None)
        self._ticks_per_s = NS_PER_S
        if self._latch == LATCHES[1] and features.has("GevTimestampTickFrequency"):
            self._ticks_per_s = int(camera.get_integer("GevTimestampTickFrequency")) or NS_PER_S

    def begin(self) -> None:
        """The first comparisons. Raises GLib.Error, like all others."""
        for _ in range(FIRST_LATCHES):
            self.latch()
        self.observe()
        self.due_ns = time.monotonic_ns() + PERIOD_NS

    def latch(self) -> None:
        """One round trip, and one to read what was latched."""
        if self._latch is None:
            return
        command, value = self._latch
        sent_ns = time.monotonic_ns()
        self._camera.execute_command(command)
        acknowledged_ns = time.monotonic_ns()
        device_ns = int(self._camera.get_integer(value)) * NS_PER_S // self._ticks_per_s
        self.clock = self.clock.after(Latch(sent_ns, device_ns, acknowledged_ns))

    def observe(self) -> bool:
        """What PTP says, and whether that is new: it may have stepped the clock, so that old latches count no more."""
        if not self._features.has("PtpStatus"):
            return False
        was, self.ptp = self.ptp, str(self._camera.get_string("PtpStatus"))
        if self.ptp != was:
            self.clock = DeviceClock()
            self.latch()
        if self.ptp in SYNCHRONISED and (self.ptp != was or time.monotonic_ns() - self._offset_read_ns > OFFSET_NS):
            self._read_offset()
        return self.ptp != was

    def _read_offset(self) -> None:
        self._offset_read_ns = time.monotonic_ns()
        if self._features.has("PtpOffsetFromMaster"):
            if self._features.has("PtpDataSetLatch"):
                self._camera.execute_command("PtpDataSetLatch")
            self.ptp_offset_ns = float(self._camera.get_integer("PtpOffsetFromMaster"))

    def rest(self) -> None:
        """What an idle camera's thread does: a latch, a look at PTP, and a new start for a PTP that got stuck."""
        self.due_ns = time.monotonic_ns() + PERIOD_NS
        self.latch()
        self.observe()
        now_ns = time.monotonic_ns()
        if self.ptp in SYNCHRONISED:
            self._lost_ns = now_ns
        elif self.ptp and now_ns - self._lost_ns > PATIENCE_NS:
            self._lost_ns = now_ns
            for on in (False, True):
                self._camera.set_boolean("PtpEnable", on)
