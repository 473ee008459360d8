"""A camera's clock seen from the host: every latch says when on the host a device time was; together they bound it.

A latch's device time was taken somewhere between sending the command and having its acknowledge, nobody knows where. Instead of
a guess in the middle, all straight lines (offset, drift) through all these intervals are kept: a polygon, whose extent at a
time is a bound that holds whatever the network did (Duda 1987; NTP intersects intervals as Marzullo did). A lost datagram or
a busy host makes an interval wide, never wrong. Where no line goes through all, the clock was stepped: the oldest go.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from binpick.camera.base import MonotonicNs

MAX_DRIFT = 200e-6
"""Of two quartz clocks against each other, at worst: 100 ppm each."""
WANDER = 1e-7
"""How far a drift may change within the time that latches are kept (a crystal near room temperature: below 0.1 ppm)."""
KEPT = 20
NEWEST = 4
"""So many are kept however wide they are, since the last ones bound what the drift did meanwhile."""
KEPT_NS = 30_000_000_000
SLACK = 1e-12
"""Seconds; of numbers in floating point."""


@dataclass(frozen=True, slots=True)
class Latch:
    """The device's clock stood at `device_ns` somewhere between the host's `sent_ns` and `acknowledged_ns` (monotonic)."""

    sent_ns: MonotonicNs
    device_ns: int
    acknowledged_ns: MonotonicNs

    @property
    def width_ns(self) -> int:
        """The round trip."""
        return self.acknowledged_ns - self.sent_ns


@dataclass(frozen=True, slots=True, eq=False)
class DeviceClock:
    """What the latches so far allow. `corners` span the polygon of (offset s, drift) about the newest latch."""

    latches: tuple[Latch, ...] = ()
    corners: Float64[np.ndarray, "n 2"] | None = None

    def host_ns(self, device_ns: int) -> tuple[MonotonicNs, MonotonicNs] | None:
        """Earliest and latest host time at which the device's clock stood there; None before the first latch."""
        if self.corners is None:
            return None
        newest = self.latches[-1]
        elapsed_s = (device_ns - newest.device_ns) * 1e-9
        errors = self.corners[:, 0] + self.corners[:, 1] * elapsed_s
        wander_s = WANDER * abs(elapsed_s)
        early, late = (errors.min() - wander_s) * 1e9, (errors.max() + wander_s) * 1e9
        base = newest.sent_ns + device_ns - newest.device_ns
        return base + math.floor(early), base + math.ceil(late)

    def device_ns(self, host_ns: MonotonicNs) -> int | None:
        """The device's time at a host time, the middle of what is possible; None before the first latch."""
        if self.corners is None:
            return None
        newest = self.latches[-1]
        offset, drift = self.corners.mean(axis=0)
        elapsed_ns = host_ns - newest.sent_ns - offset * 1e9
        return newest.device_ns + int(elapsed_ns / (1 + drift))

    def after(self, latch: Latch) -> "DeviceClock":
        """With one more latch, which must be newer than the others."""
        latches = [old for old in self.latches if latch.sent_ns - old.sent_ns <= KEPT_NS] + [latch]
        if len(latches) > KEPT:
            latches.remove(max(latches[:-NEWEST], key=lambda old: old.width_ns))
        while True:
            corners = _corners(latches)
            if len(corners):
                return DeviceClock(tuple(latches), corners)
            latches = latches[1:]


def _corners(latches: list[Latch]) -> Float64[np.ndarray, "n 2"]:
    """Corners of all (offset s, drift) with host − device − newest's sent = offset + drift · elapsed inside every interval."""
    newest = latches[-1]
    rows = []
    for latch in latches:
        elapsed_ns = latch.device_ns - newest.device_ns
        early = latch.sent_ns - newest.sent_ns - elapsed_ns
        wander_s = WANDER * abs(elapsed_ns) * 1e-9
        rows.append((1.0, elapsed_ns * 1e-9, (early + latch.width_ns) * 1e-9 + wander_s))
        rows.append((-1.0, -elapsed_ns * 1e-9, -early * 1e-9 + wander_s))
    rows += [(0.0, 1.0, MAX_DRIFT), (0.0, -1.0, MAX_DRIFT)]
    sides = np.array(rows)                                            # a·offset + b·drift <= c
    first, second = np.triu_indices(len(sides), 1)
    (a, b, c), (d, e, f) = sides[first].T, sides[second].T
    determinant = a * e - b * d
    crossing = np.abs(determinant) > 1e-15
    a, b, c, d, e, f, determinant = (x[crossing] for x in (a, b, c, d, e, f, determinant))
    points = np.stack(((c * e - b * f) / determinant, (a * f - c * d) / determinant), axis=1)
    inside = (points @ sides[:, :2].T <= sides[:, 2] + SLACK).all(axis=1)
    return np.asarray(points[inside])
