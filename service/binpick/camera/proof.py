"""What proves that images show one instant: PTP, else clocks compared by latches, else the host's own times, else nothing."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

from binpick.data import Frame

Proof = Literal["ptp", "latch", "interval", "none"]
CLOCK_SIGMA_US = 1.0
"""Of time stamps on clocks that PTP keeps together on one switch, beside the offset that the cameras report."""
SYNCHRONISED = ("Master", "Slave")


@dataclass(frozen=True, slots=True)
class Skew:
    """Second minus first start of exposure, its 1-sigma, both µs, and what that rests on. Without a proof sigma is infinite."""

    us: float
    sigma_us: float
    proof: Proof

    @property
    def worst_us(self) -> float:
        """What it may be at 3 sigma."""
        return abs(self.us) + 3 * self.sigma_us


def together(states: Sequence[str]) -> bool:
    """Whether cameras in these PTP states follow one clock: two that do not hear each other both call themselves master."""
    return "Slave" in states and set(states) <= set(SYNCHRONISED) and states.count("Master") <= 1


def skew(first: Frame, second: Frame) -> Skew:
    """By the best proof there is. PTP is believed as long as the latches do not contradict it."""
    bounds, common = _latched(first, second), _ptp(first, second)
    if common is not None and (bounds is None or _agree(common, bounds)):
        return common
    return bounds or _interval(first, second) or Skew(0.0, math.inf, "none")


def worst(frames: tuple[Frame, ...]) -> Skew:
    """Of two or more images, the two that may be furthest apart. With two masters among them there are two times."""
    if sum(frame.ptp == "Master" for frame in frames) > 1:
        frames = tuple(replace(frame, ptp="") for frame in frames)
    return max((skew(first, second) for first, second in combinations(frames, 2)), key=lambda found: found.worst_us)


def misdated(frame: Frame) -> str:
    """What is wrong with the image's own time stamp, "": nothing; it cannot precede its trigger, nor follow its arrival."""
    if frame.latched_ns is None:
        return ""
    early, late = frame.latched_ns
    if late < frame.triggered_ns:
        return "the image is older than its trigger"
    return "the image's time stamp lies after its arrival" if early > frame.received_ns else ""


def _ptp(first: Frame, second: Frame) -> Skew | None:
    if not together((first.ptp, second.ptp)):
        return None
    sigma_us = math.hypot(CLOCK_SIGMA_US, first.ptp_offset_ns / 1000, second.ptp_offset_ns / 1000)
    return Skew((second.timestamp_ns - first.timestamp_ns) / 1000, sigma_us, "ptp")


def _latched(first: Frame, second: Frame) -> Skew | None:
    return _between(first.latched_ns, second.latched_ns, "latch")


def _interval(first: Frame, second: Frame) -> Skew | None:
    """Each exposure began between its trigger and what proved that it had; one model has one delay."""
    return _between(_window(first), _window(second), "interval")


def _window(frame: Frame) -> tuple[int, int] | None:
    return (frame.triggered_ns, frame.acknowledged_ns) if frame.acknowledged_ns else None


def _between(first: tuple[int, int] | None, second: tuple[int, int] | None, proof: Proof) -> Skew | None:
    """Two instants, each anywhere in its interval: 3 sigma of the difference of two uniform ones hold all that is possible."""
    if first is None or second is None:
        return None
    widths_us = [(late - early) / 1000 for early, late in (first, second)]
    return Skew((sum(second) - sum(first)) / 2000, math.hypot(*widths_us) / math.sqrt(12), proof)


def _agree(common: Skew, bounds: Skew) -> bool:
    return abs(common.us - bounds.us) <= 3 * math.hypot(common.sigma_us, bounds.sigma_us)
