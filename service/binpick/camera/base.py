"""What a camera is to the rest: its verbs, each bounded by a deadline, and a status anybody may read at any time."""

import time
from collections.abc import Callable
from typing import Protocol, TypeAlias, runtime_checkable

from binpick.data import CameraStatus, Frame, Light

MonotonicNs: TypeAlias = int
Clock: TypeAlias = Callable[[], MonotonicNs]
NAMES = ("left", "right", "third", "fourth", "fifth")
"""Of a rig's cameras, in its order."""


@runtime_checkable
class Camera(Protocol):
    """One triggered camera, called by one thread at a time.

    No verb may block beyond `deadline_ns` (host monotonic clock), whatever the camera or its driver does; a verb that cannot
    end by then raises CameraLost. After an error the camera is closed and opened again by its caller, except after PairRefused:
    that is one image's affair.
    """

    @property
    def name(self) -> str:
        """One of NAMES; named in every error."""
        ...

    def open(self, deadline_ns: MonotonicNs) -> None:
        """Connect and prepare for triggers. Raises CameraNotFound, CameraHeld, CameraLost."""
        ...

    def configure(self, light: Light, deadline_ns: MonotonicNs) -> None:
        """Apply exposure and gain, read back. Raises CameraError."""
        ...

    def trigger(self, sequence: int, deadline_ns: MonotonicNs) -> None:
        """Start one exposure. Raises CameraLost."""
        ...

    def arm(self, sequence: int, deadline_ns: MonotonicNs) -> None:
        """Something else will start one exposure: a wire from another camera, or a datagram to all. Raises CameraLost."""
        ...

    def disarm(self, deadline_ns: MonotonicNs) -> None:
        """Perhaps no image will come of the last `arm`; one that comes nevertheless is dropped. Raises CameraLost."""
        ...

    def device_ns(self, host_ns: MonotonicNs) -> int | None:
        """Its clock's time at a host time; None while nobody knows."""
        ...

    def grab(self, sequence: int, deadline_ns: MonotonicNs) -> Frame:
        """The whole frame of that trigger; older ones are dropped. Raises CameraLost, PairRefused (incomplete)."""
        ...

    def watch(self) -> bool:
        """An idle camera's well-being, without waiting; to be called several times a second. Raises CameraLost or CameraHeld
        once an open one is known to be gone. True: a closed one that was away, or in other hands, can be had now."""
        ...

    def close(self) -> None:
        """Give the camera back within 1 s, or abandon it; never raises."""
        ...

    def status(self) -> CameraStatus:
        """What it knows of itself, without waiting."""
        ...


def remaining_s(deadline_ns: MonotonicNs, clock: Clock = time.monotonic_ns) -> float:
    """Seconds left before a deadline, at least 0."""
    return max(0.0, (deadline_ns - clock()) / 1e9)
