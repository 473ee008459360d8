"""Cameras as one instrument: one light, one trigger, and a pair only when all images are proved to show one instant."""

import contextlib
import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import TypeVar

from binpick.camera import proof
from binpick.camera.base import Camera, Clock, MonotonicNs
from binpick.camera.proof import Skew
from binpick.camera.starter import Starter
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
SOFTWARE = Starter()
PTP_NS = 5_000_000_000
"""Longest wait for the cameras' PTP, in the one mode that needs it."""
SETTLE_S = 0.1
"""For images that may have been started by a command that not every camera took."""

log = logging.getLogger(__name__)


class CameraGroup:
    """The left, the right and perhaps more cameras, used by one thread. `statuses` may be read by any."""

    def __init__(self, cameras: tuple[Camera, ...], max_skew_us: float, clock: Clock = time.monotonic_ns,
                 wall_clock: Callable[[], datetime] = lambda: datetime.now(UTC), starter: Starter = SOFTWARE) -> None:
        self._cameras = cameras
        self._starter = starter
        self._refused = 0
        self._max_skew_us = max_skew_us
        self._clock = clock
        self._wall_clock = wall_clock
        self._open = [False] * len(cameras)
        self._errors = [""] * len(cameras)
        self._due: list[MonotonicNs | None] = [None] * len(cameras)
        self._light: tuple[float, float, bool, int] | None = None
        self._sequence = 0
        self._started_ns: MonotonicNs = 0

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
        self._await_clocks(deadline_ns)
        tries, patience_ns = 1 if light.pattern else TRIES, COMMAND_NS
        while True:
            if self._clock() >= deadline_ns:
                raise CycleTimeout(Code.TIMEOUT.message)
            try:
                return self._shoot(light, patience_ns)
            except PairRefused as refusal:
                self._refused += 1
                tries, patience_ns = tries - 1, AGAIN_NS
                if not tries:
                    raise
                log.info("shooting again: %s", refusal)

    def watch(self) -> bool:
        """Looks at idle cameras without waiting: one that is gone is closed, and named in a CameraError and in `statuses`.
        True: `open` is worth a try at once, since one that was away can be had again."""
        return any(self._each(lambda _, camera: camera.watch()))

    def _await_clocks(self, deadline_ns: MonotonicNs) -> None:
        until_ns = min(deadline_ns, self._clock() + PTP_NS)
        while why := self._starter.unready(self.statuses()):
            if self._clock() >= until_ns:
                self._refused += 1
                raise PairRefused(why)
            time.sleep(0.02)

    def _shoot(self, light: Light, patience_ns: int) -> StereoPair:
        captured_at = self._wall_clock().isoformat(timespec="milliseconds")
        self._start(light, patience_ns)
        frames = tuple(self._each(lambda i, camera: self._fetch(i, camera)))
        for frame in frames:
            self._check(frame)
            frozen(frame.image)
        left, right, *more = frames
        for other in (right, *more):
            if other.image.shape != left.image.shape:
                raise PairRefused(f"the images differ in size: left {_size(left)}, {other.camera} {_size(other)} pixels: "
                                  "set the cameras to the size that the rig was calibrated with")
        skew = self._judge(frames)
        return StereoPair(left=left, right=right, captured_at=captured_at, skew_us=skew.us,
                          sigma_us=skew.sigma_us if math.isfinite(skew.sigma_us) else 0.0, proof=skew.proof, more=tuple(more))

    def _start(self, light: Light, patience_ns: int) -> None:
        """One exposure of every camera."""
        self._sequence += 1
        self._started_ns = self._clock()

        def begin(index: int, camera: Camera) -> None:
            verb = camera.arm if self._starter.follows(index) else camera.trigger
            verb(self._sequence, self._answer_by(patience_ns))
            self._due[index] = self._clock() + int(light.exposure_us * 1000) + IMAGE_NS

        try:
            self._each(begin, self._starter.order(len(self._cameras)))
        except CameraError:
            with contextlib.suppress(CameraError):       # named by its own next verb
                self._call_off(patience_ns)
            raise
        if why := self._starter.fire(self._cameras, self._clock):
            self._call_off(patience_ns)
            time.sleep(light.exposure_us / 1e6 + SETTLE_S)
            raise PairRefused(why)

    def _call_off(self, patience_ns: int) -> None:
        """What should have started the other cameras failed: they are not waited for."""
        def spare(index: int, camera: Camera) -> None:
            if self._open[index] and self._starter.follows(index):
                self._due[index] = None
                camera.disarm(self._answer_by(patience_ns))

        self._each(spare)

    def _judge(self, frames: tuple[Frame, ...]) -> Skew:
        """The worst skew among them. Raises PairRefused when it may be beyond the limit."""
        skew = proof.worst(frames)
        if skew.worst_us > self._max_skew_us:
            raise PairRefused(f"the images may have been exposed {skew.worst_us:.0f} µs apart ({skew.us:.0f} µs, 1-sigma "
                              f"{skew.sigma_us:.0f} µs by {skew.proof}), more than the {self._max_skew_us:.0f} µs allowed "
                              "(max_skew_us)")
        return skew

    def _fetch(self, index: int, camera: Camera) -> Frame:
        """The image of its last trigger."""
        limit, self._due[index] = max(self._due[index] or 0, self._clock() + SECOND_NS), None
        return camera.grab(self._sequence, limit)

    def _answer_by(self, patience_ns: int) -> MonotonicNs:
        """Once one camera has failed, the other is only asked whether it lives: it is to be named as well if it does not."""
        return self._clock() + (patience_ns if all(self._open) else SECOND_NS)

    def close(self) -> None:
        """Closes all, at most 1 s each; never raises."""
        for index, camera in enumerate(self._cameras):
            camera.close()
            self._open[index] = False

    def statuses(self) -> tuple[CameraStatus, ...]:
        """In the rig's order; `error` tells why a camera is closed."""
        found = (camera.status() for camera in self._cameras)
        return tuple(replace(status, error=status.error or error, refused=self._refused)
                     for status, error in zip(found, self._errors, strict=True))

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

    def _each(self, verb: Callable[[int, Camera], T], order: Sequence[int] = ()) -> list[T]:
        """The verb's answers of all; cameras that fail are named in one error and closed: not for an incomplete image."""
        answers, broken = [], []
        for index in order or range(len(self._cameras)):
            camera = self._cameras[index]
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

    def _check(self, frame: Frame) -> None:
        if frame.missing:
            raise PairRefused(f"camera {frame.camera}: {frame.missing} packets of the image are missing: check cable, network "
                              "card and socket buffer", frame.camera)
        if frame.sequence != self._sequence or frame.triggered_ns < self._started_ns:
            raise PairRefused(f"camera {frame.camera}: the image is older than its trigger", frame.camera)
        if wrong := proof.misdated(frame):
            raise PairRefused(f"camera {frame.camera}: {wrong}", frame.camera)


def _size(frame: Frame) -> str:
    height, width = frame.image.shape
    return f"{width}x{height}"
