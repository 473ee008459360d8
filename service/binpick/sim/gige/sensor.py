"""The sensor: triggers become exposures, exposures become images; one that comes while it exposes is lost, and counted."""

import threading
from collections.abc import Callable
from dataclasses import dataclass

from binpick.data import Image, Light
from binpick.sim.gige import auto
from binpick.sim.gige.clock import host_ns
from binpick.sim.gige.features import AUTO, OFF_ON
from binpick.sim.gige.registers import Registers

MAX_BLOCK = 0xFFFF
MAX_RATE_HZ = 50.0


@dataclass(frozen=True, slots=True)
class Shot:
    """An accepted trigger: the exposure's number since power-up and its image's since acquisition began."""

    number: int
    block: int
    started_ns: int
    light: Light


class Sensor:
    """`run` is for a thread of its own. `expose(light, shot)` makes the image at the exposure's end, `began(shot)` is told when
    one begins, on the thread that triggered it; `deliver(shot, image)` gets it, on the sensor's own."""

    def __init__(self, registers: Registers, expose: Callable[[Light, int], Image], projector: Callable[[], bool],
                 began: Callable[[Shot], None], deliver: Callable[[Shot, Image], None]) -> None:
        self._registers = registers
        self._expose, self._projector, self._began, self._deliver = expose, projector, began, deliver
        self._state = threading.Condition()
        self._acquiring = False
        self._shots = self._blocks = 0
        self._left: int | None = None
        self._pending: Shot | None = None
        self._next_ns = 0
        self._off = False
        self.missed = 0

    @property
    def acquiring(self) -> bool:
        """Whether its images are wanted."""
        return self._acquiring

    def begin(self) -> None:
        """Acquisition starts, block numbers at 1."""
        mode = self._registers.name("AcquisitionMode")
        frames = {"SingleFrame": 1, "MultiFrame": self._registers.integer("AcquisitionFrameCount")}
        with self._state:
            self._acquiring, self._blocks, self._pending, self._left, self._next_ns = True, 0, None, frames.get(mode), 0
            self._state.notify_all()

    def end(self) -> None:
        """Acquisition stops; an exposure that has begun yields nothing."""
        with self._state:
            self._acquiring, self._pending = False, None

    def wake(self) -> None:
        """A register that it goes by has changed."""
        with self._state:
            self._state.notify_all()

    def power_off(self) -> None:
        """`run` returns."""
        with self._state:
            self._off = True
            self._state.notify_all()

    def trigger(self, at_ns: int) -> None:
        """Starts one exposure then, if it is ready for one; times are the host's."""
        with self._state:
            if self._pending is not None or not self._acquiring or self._left == 0 or not self._triggered():
                self.missed += 1
                return
            shot = self._accept(at_ns)
        self._began(shot)

    def _triggered(self) -> bool:
        return self._registers.integer("TriggerMode") == OFF_ON["On"]

    def _accept(self, at_ns: int) -> Shot:
        self._shots += 1
        self._blocks = self._blocks % MAX_BLOCK + 1
        if self._left is not None:
            self._left -= 1
        light = Light(exposure_us=float(self._registers.number("ExposureTime")), gain_db=float(self._registers.number("Gain")),
                      projector=self._projector())
        shot = self._pending = Shot(self._shots, self._blocks, at_ns, light)
        self._state.notify_all()
        return shot

    def run(self) -> None:
        """Until power is off."""
        while (shot := self._next()) is not None:
            ends_ns = shot.started_ns + int(shot.light.exposure_us * 1000)
            with self._state:
                while not self._off and (left_ns := ends_ns - host_ns()) > 0:
                    self._state.wait(left_ns / 1e9)
                if self._off or self._pending is not shot:      # acquisition ended meanwhile
                    continue
                self._pending = None
            image = self._expose(shot.light, shot.number)
            self._adapt(float(image.mean()) if self._adapts() else auto.TARGET_GREY)
            self._deliver(shot, image)

    def _next(self) -> Shot | None:
        """The shot that is to be read out next; without a trigger it takes one as often as its frame rate says."""
        while True:
            with self._state:
                if self._off:
                    return None
                if self._pending is not None:
                    return self._pending
                free = self._acquiring and self._left != 0 and not self._triggered()
                wait_ns = self._next_ns - host_ns()
                if not free or wait_ns > 0:
                    self._state.wait(wait_ns / 1e9 if free else None)
                    continue
                self._next_ns = host_ns() + int(1e9 / self._rate_hz())
                shot = self._accept(host_ns())
            self._began(shot)

    def _rate_hz(self) -> float:
        enabled = self._registers.integer("AcquisitionFrameRateEnable")
        return float(self._registers.number("AcquisitionFrameRate")) if enabled else MAX_RATE_HZ

    def _adapts(self) -> bool:
        return any(self._registers.integer(name) != AUTO["Off"] for name in ("ExposureAuto", "GainAuto"))

    def _adapt(self, mean: float) -> None:
        """Exposure first; gain takes what is left when that is at its limit, or off."""
        read = self._registers.number
        if self._registers.integer("ExposureAuto") != AUTO["Off"]:
            before = read("ExposureTime")
            after = auto.exposure_us(before, mean, read("ExposureAutoMin"), read("ExposureAutoMax"))
            self._registers.set("ExposureTime", after)
            if after != before:
                return
        if self._registers.integer("GainAuto") != AUTO["Off"]:
            self._registers.set("Gain", auto.gain_db(read("Gain"), mean, read("GainAutoMin"), read("GainAutoMax")))
        for name in ("ExposureAuto", "GainAuto"):
            if self._registers.integer(name) == AUTO["Once"] and auto.settled(mean):
                self._registers.set(name, AUTO["Off"])
