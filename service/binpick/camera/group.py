"""Two cameras as one instrument: one light, one trigger, and a pair only when both images are proved to show one instant."""

import contextlib
import logging
import math
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from typing import TypeVar

from binpick.camera.base import Camera, Clock, MonotonicNs
from binpick.data import CameraStatus, Frame, Light, StereoPair, frozen
from binpick.errors import CameraError, Code, CycleTimeout, PairRefused

T = TypeVar("T")
COMMAND_NS = 1_000_000_000
"""Longest wait for a command's acknowledge: a lost datagram is repeated after 500 ms, and a host may stall as long."""
AGAIN_NS = 550_000_000
"""The same for a shot that is made again: a camera that died in mid-image is found out by it, after what the driver waited for
the rest of that image (RETENTION_US)."""
IMAGE_NS = 1_000_000_000
"""Longest wait for an image after its exposure."""
SECOND_NS = 150_000_000
"""What is left at least for the second camera, when waiting for the first has used up the time."""
TRIES = 3
"""Shots for one pair; one of a projector's numbered patterns has a single one, since its next strobe shows the next pattern."""
CLOCK_SIGMA_US = 1.0
"""Of time stamps on one clock: what PTP reaches on one switch."""

log = logging.getLogger(__name__)


class CameraGroup:
    """The left and the right camera, used by one thread. `statuses` may be read by any."""

    def __init__(self, cameras: tuple[Camera, Camera], max_skew_us: float, clock: Clock = time.monotonic_ns,
                 wall_clock: Callable[[], datetime] = lambda: datetime.now(UTC)) -> None:
        self._cameras = cameras
        self._max_skew_us = max_skew_us
        self._clock = clock
        self._wall_clock = wall_clock
        self._open = [False, False]
        self._errors = ["", ""]
        self._due: list[MonotonicNs | None] = [None, None]
        self._light: tuple[float, float, bool, int] | None = None
        self._sequence = 0

    def open(self, deadline_ns: MonotonicNs) -> None:
        """Opens those that are not open, one after the other. Raises one CameraError that names every broken camera."""
        self._each(lambda i, camera: None if self._open[i] else self._open_one(i, camera, deadline_ns))

    def capture(self, light: Light, deadline_ns: MonotonicNs) -> StereoPair:
        """One pair. Raises CameraError naming every camera that failed, PairRefused when two images are no pair.

        Two software triggers come too far apart, or an image incomplete, when the host was busy meanwhile: then it tries
        again, up to three times in all (a numbered pattern's shot has one try), and the cameras stay open. A dead camera is
        noticed within the exposure and 1.4 s, whatever the deadline is, and stays closed until `open`.
        The deadline ends no exposure that has begun, since a healthy camera is not to be blamed for a short one: it is looked
        at between the steps. Raises CycleTimeout then.
        """
        self._each(lambda i, camera: self._require_open(i, camera))
        # one whose shot the other's failure broke off may still expose, and would miss its next trigger
        with contextlib.suppress(PairRefused):       # nobody wants that image
            self._each(lambda i, camera: self._due[i] and self._fetch(i, camera))
        self._configure(light)
        tries, patience_ns = 1 if light.pattern else TRIES, COMMAND_NS
        while True:
            if self._clock() >= deadline_ns:
                raise CycleTimeout(Code.TIMEOUT.message)
            try:
                return self._shoot(light, patience_ns)
            except PairRefused as refusal:
                tries, patience_ns = tries - 1, AGAIN_NS
                if not tries:
                    raise
                log.info("shooting again: %s", refusal)

    def _shoot(self, light: Light, patience_ns: int) -> StereoPair:
        self._sequence += 1
        captured_at = self._wall_clock().isoformat(timespec="milliseconds")
        ticks = [self._clock()]

        def trigger(index: int, camera: Camera) -> None:
            camera.trigger(self._sequence, self._answer_by(patience_ns))
            ticks.append(self._clock())
            self._due[index] = ticks[-1] + int(light.exposure_us * 1000) + IMAGE_NS

        self._each(trigger)
        left, right = self._each(lambda i, camera: self._fetch(i, camera))
        for frame in (left, right):
            self._check(frame, ticks[0])
            frozen(frame.image)
        if left.image.shape != right.image.shape:
            raise PairRefused(f"the images differ in size: left {_size(left)}, right {_size(right)} pixels")
        skew_us, sigma_us, proof = self._skew(left, right, ticks)
        if abs(skew_us) > self._max_skew_us:
            raise PairRefused(f"the images were exposed {abs(skew_us):.0f} µs apart ({proof}), more than the "
                              f"{self._max_skew_us:.0f} µs allowed (max_skew_us)")
        return StereoPair(left=left, right=right, captured_at=captured_at, skew_us=skew_us, sigma_us=sigma_us, proof=proof)

    def _fetch(self, index: int, camera: Camera) -> Frame:
        """The image of its last trigger."""
        limit, self._due[index] = max(self._due[index] or 0, self._clock() + SECOND_NS), None
        return camera.grab(self._sequence, limit)

    def _answer_by(self, patience_ns: int) -> MonotonicNs:
        """Once one camera has failed, the other is only asked whether it lives: it is to be named as well if it does not."""
        return self._clock() + (patience_ns if all(self._open) else SECOND_NS)

    def close(self) -> None:
        """Closes both, at most 1 s each; never raises."""
        for index, camera in enumerate(self._cameras):
            camera.close()
            self._open[index] = False

    def statuses(self) -> tuple[CameraStatus, ...]:
        """Left and right; `error` tells why a camera is closed."""
        found = (camera.status() for camera in self._cameras)
        return tuple(replace(status, error=status.error or error) for status, error in zip(found, self._errors, strict=True))

    def _open_one(self, index: int, camera: Camera, deadline_ns: MonotonicNs) -> None:
        camera.open(deadline_ns)
        self._open[index], self._errors[index], self._light, self._due[index] = True, "", None, None

    def _require_open(self, index: int, camera: Camera) -> None:
        if not self._open[index]:
            raise CameraError(self._errors[index] or f"camera {camera.name} is not open", camera.name)

    def _configure(self, light: Light) -> None:
        wanted = (light.exposure_us, light.gain_db, light.projector, light.pattern)
        if wanted != self._light:
            self._each(lambda _, camera: camera.configure(light, self._answer_by(COMMAND_NS)))
            self._light = wanted

    def _each(self, verb: Callable[[int, Camera], T]) -> list[T]:
        """The verb's answers of both; cameras that fail are named in one error and closed: not for an incomplete image."""
        answers, broken = [], []
        for index, camera in enumerate(self._cameras):
            try:
                answers.append(verb(index, camera))
            except CameraError as error:
                broken.append(error)
                if not isinstance(error, PairRefused):
                    camera.close()
                    self._open[index], self._errors[index], self._light = False, str(error), None
        if len(broken) == 1:
            raise broken[0]
        if broken:
            kind = type(broken[0]) if len({type(error) for error in broken}) == 1 else CameraError
            raise kind("; ".join(map(str, broken)))
        return answers

    def _check(self, frame: Frame, started_ns: MonotonicNs) -> None:
        if frame.missing:
            raise PairRefused(f"camera {frame.camera}: {frame.missing} packets of the image are missing", frame.camera)
        if frame.sequence != self._sequence or frame.triggered_ns < started_ns:
            raise PairRefused(f"camera {frame.camera}: the image is older than its trigger", frame.camera)

    def _skew(self, left: Frame, right: Frame, ticks: list[MonotonicNs]) -> tuple[float, float, str]:
        """Right minus left start of exposure, its 1-sigma, both µs, and what that rests on.

        On a common clock the time stamps say it. Else the host does: each exposure began somewhere between sending its
        trigger and having its acknowledge, uniformly; two cameras of one model add the same delay.
        """
        clocks = {camera.status().clock for camera in self._cameras}
        if len(clocks) == 1 and (clock := clocks.pop()):
            return (right.timestamp_ns - left.timestamp_ns) / 1000, CLOCK_SIGMA_US, clock
        sent, between, acknowledged = ticks
        sigma_us = math.hypot(between - sent, acknowledged - between) / math.sqrt(12) / 1000
        return (acknowledged - sent) / 2 / 1000, sigma_us, "host"


def _size(frame: Frame) -> str:
    height, width = frame.image.shape
    return f"{width}x{height}"
