"""The simulated world's cameras in this process: no network, real exposure times, faults on demand."""

import time
from collections.abc import Callable
from typing import Literal, TypeAlias

from binpick.camera.base import NAMES, Clock, MonotonicNs, remaining_s
from binpick.data import CameraStatus, Frame, Image, Light
from binpick.errors import CameraLost

Expose: TypeAlias = Callable[[int, Light, int], Image]
# how often a stuck or exposing camera looks at its fault
TICK_S = 0.02


class SimCamera:
    """Camera `index` of the rig; `expose(index, light, shot)` makes its pictures, the trigger's sequence is the shot.

    `fail` may be set at any time from any thread: "dead": every verb but close raises CameraLost at once; "stuck": it blocks
    until its deadline, then raises CameraLost; "": well again.
    """

    def __init__(self, index: int, expose: Expose, clock: Clock = time.monotonic_ns,
                 sleep: Callable[[float], None] = time.sleep) -> None:
        self._index, self._expose, self._clock, self._sleep = index, expose, clock, sleep
        self.fail: Literal["", "dead", "stuck"] = ""
        self._open = False
        self._light = Light(6000.0, 0.0, True)
        self._triggered: tuple[int, MonotonicNs] | None = None
        self._frames = self._failures = self._acknowledged_ns = 0
        self._error = ""

    @property
    def name(self) -> str:
        """One of NAMES."""
        return NAMES[self._index]

    def open(self, deadline_ns: MonotonicNs) -> None:
        """Raises CameraLost when it is to fail."""
        self._obey(deadline_ns)
        self._open, self._error = True, ""

    def configure(self, light: Light, deadline_ns: MonotonicNs) -> None:
        """Takes effect with the next trigger. Raises CameraLost."""
        self._require_open()
        self._obey(deadline_ns)
        self._light = light

    def trigger(self, sequence: int, deadline_ns: MonotonicNs) -> None:
        """Exposure starts now. Raises CameraLost."""
        self._require_open()
        self._obey(deadline_ns)
        self._triggered = (sequence, self._clock())
        self._acknowledged_ns = self._clock()

    def arm(self, sequence: int, deadline_ns: MonotonicNs) -> None:
        """In one process nothing lies between the cameras: exposure starts now. Raises CameraLost."""
        self.trigger(sequence, deadline_ns)

    def disarm(self, deadline_ns: MonotonicNs) -> None:  # noqa: ARG002
        """Forgets the trigger."""
        self._triggered = None

    def device_ns(self, host_ns: MonotonicNs) -> int | None:
        """Its clock is the host's."""
        return host_ns

    def grab(self, sequence: int, deadline_ns: MonotonicNs) -> Frame:
        """The frame of that trigger once its exposure has elapsed. Raises CameraLost."""
        self._require_open()
        if self._triggered is None or self._triggered[0] != sequence:
            self._obey(deadline_ns)
            raise self._lost(f"was not triggered with number {sequence}")
        started = self._triggered[1]
        self._wait(started + int(self._light.exposure_us * 1000), deadline_ns)
        image = self._expose(self._index, self._light, sequence)
        self._obey(deadline_ns)
        self._frames += 1
        return Frame(image=image, camera=self.name, sequence=sequence, frame_id=self._frames, timestamp_ns=started,
                     triggered_ns=started, received_ns=self._clock(), exposure_us=self._light.exposure_us,
                     gain_db=self._light.gain_db, acknowledged_ns=self._acknowledged_ns)

    def watch(self) -> bool:
        """Raises CameraLost when it is to fail, without being stuck; True: it failed, and is well again."""
        if self._open:
            self._obey(self._clock())
        return not self._open and bool(self._error) and not self.fail

    def close(self) -> None:
        """Forgets the trigger."""
        self._open, self._triggered = False, None

    def status(self) -> CameraStatus:
        """What it knows of itself."""
        return CameraStatus(name=self.name, connected=self._open and not self._error, model="Simulated camera",
                            serial=f"SIM-{self.name.upper()}", address="in process", frames=self._frames,
                            failures=self._failures, error=self._error, simulated=True)

    def _wait(self, until_ns: MonotonicNs, deadline_ns: MonotonicNs) -> None:
        while (left_s := remaining_s(until_ns, self._clock)) > 0:
            self._obey(deadline_ns)
            if not (allowed_s := remaining_s(deadline_ns, self._clock)):
                raise self._lost("did not deliver in time")
            self._sleep(min(left_s, allowed_s, TICK_S))

    def _obey(self, deadline_ns: MonotonicNs) -> None:
        """Fails as it was told to."""
        if self.fail == "dead":
            raise self._lost("does not answer")
        if self.fail == "stuck":
            while (left_s := remaining_s(deadline_ns, self._clock)) > 0:
                self._sleep(min(left_s, TICK_S))
            raise self._lost("did not answer in time")

    def _require_open(self) -> None:
        if not self._open:
            raise self._lost("is not open")

    def _lost(self, what: str) -> CameraLost:
        self._failures += 1
        self._error = f"the {self.name} camera {what}"
        return CameraLost(self._error, self.name)
