"""A GigE Vision camera as the cell sees it: verbs that end in time, whatever the driver's thread is doing."""

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

from binpick.camera import probe
from binpick.camera.aravis.driver import Driver, Setup
from binpick.camera.base import MonotonicNs, remaining_s
from binpick.camera.link import Link
from binpick.camera.owner import Owner
from binpick.data import CameraStatus, Frame, Light
from binpick.errors import CameraError, CameraHeld, CameraLost, CameraNotFound, PairRefused

T = TypeVar("T")
HANDOVER_S = 1.5
"""Longest wait for a thread that was left behind to give the camera back."""


class AravisCamera:
    """One camera, by address (opened without discovery) or by serial number; with both, the serial is checked.

    Its thread `binpick-cam-<name>` alone touches Aravis' objects. A verb that cannot end by its deadline raises CameraLost and
    leaves that thread behind; the next `open` starts another. An incomplete image counts as a failure, but closes nothing.
    """

    def __init__(self, name: str, address: str, serial: str, setup: Setup) -> None:
        self._name = name
        self._address = address
        self._serial = serial
        self._setup = setup
        self._status = CameraStatus(name, connected=False, address=address, serial=serial)
        self._driver: Driver | None = None
        self._owner: Owner | None = None
        self._retired: Owner | None = None
        self._link: Link | None = None
        self._away = False

    @property
    def name(self) -> str:
        """As in every error."""
        return self._name

    def open(self, deadline_ns: MonotonicNs) -> None:
        """Connects and starts the stream. Raises CameraNotFound, CameraHeld, CameraLost, CameraError."""
        self.close()
        if self._address and not probe.answers(self._address):
            self._away = True
            raise self._fail(CameraNotFound(f"camera {self._name}: no camera answers at {self._address}: check power, cable "
                                            "and the address in the cell file", self._name))
        if self._retired is not None:      # may still hold the camera; when that lives, it lets go soon
            self._retired.join(min(HANDOVER_S, remaining_s(deadline_ns) / 2))
        driver = Driver(self._name, self._setup)
        self._driver = driver
        self._owner = Owner(f"binpick-cam-{self._name}", driver.close, driver.rest, lambda: driver.due_ns)
        address = self._address or self._do("searching it", lambda driver: driver.find(self._serial), deadline_ns)
        facts = self._do("opening", lambda driver: driver.open(address, self._serial), deadline_ns)
        self._status = replace(self._status, connected=True, error="", address=address, **facts)
        self._away = False
        self._link = Link(address)

    def configure(self, light: Light, deadline_ns: MonotonicNs) -> None:
        """Exposure, gain, and whether the line that strobes the projector does so."""
        self._do("setting exposure and gain", lambda driver: driver.configure(light), deadline_ns)

    def trigger(self, sequence: int, deadline_ns: MonotonicNs) -> None:  # noqa: ARG002 - the frame's own affair in grab
        """One software trigger."""
        self._do("triggering", Driver.trigger, deadline_ns)

    def arm(self, sequence: int, deadline_ns: MonotonicNs) -> None:  # noqa: ARG002
        """Makes room for an image that something else will start."""
        self._do("preparing", Driver.arm, deadline_ns)

    def disarm(self, deadline_ns: MonotonicNs) -> None:
        """The image may come, or not."""
        self._do("waiting", Driver.disarm, deadline_ns)

    def device_ns(self, host_ns: MonotonicNs) -> int | None:
        """By the latches so far."""
        return self._driver.clock.device_ns(host_ns) if self._driver is not None else None

    def grab(self, sequence: int, deadline_ns: MonotonicNs) -> Frame:
        """The frame of that trigger. Raises CameraLost when none comes, PairRefused when packets stayed away."""
        frame = self._do("waiting for its image", lambda driver: driver.grab(sequence, deadline_ns), deadline_ns)
        status = self._status
        self._status = replace(status, frames=status.frames + 1, resends=status.resends + frame.resends)
        return frame

    def watch(self) -> bool:
        """By what it says to a socket of our own, and to its own thread's looks at its clock."""
        if self._link is None:
            if not self._status.address:
                return False
            self._link = Link(self._status.address)
        state, driver = self._link.feel(), self._driver
        if driver is None:
            back = self._away and state == "free"
            self._away = self._away and not back
            return back
        if driver.trouble is not None:
            raise self._fail(driver.trouble)
        if state == "silent":
            raise self._fail(CameraLost(f"camera {self._name} does not answer any more: check its power, cable and network",
                                        self._name))
        if state == "free":
            raise self._fail(CameraLost(f"camera {self._name} obeys nobody any more: it was without power or network for a "
                                        "moment", self._name))
        return False

    def close(self) -> None:
        """Gives the camera back; at most 0.9 s, and 0.05 s for one that failed, since that may take its thread long."""
        if self._owner is not None:
            self._owner.retire()
            self._owner.join(0.9)
        elif self._retired is not None:
            self._retired.join(0.05)
        self._owner = self._driver = None
        if self._link is not None:
            self._link.close()
            self._link = None
        self._status = replace(self._status, connected=False)

    def status(self) -> CameraStatus:
        """What the last verb left behind, and what PTP said since."""
        driver = self._driver
        if driver is None:
            return self._status
        state, offset_ns = driver.ptp
        return replace(self._status, ptp=state, ptp_offset_us=round(offset_ns / 1000, 1))

    def _do(self, what: str, verb: Callable[[Driver], T], deadline_ns: MonotonicNs) -> T:
        driver = self._driver
        if self._owner is None or driver is None:
            raise CameraLost(f"camera {self._name} is not open", self._name)
        try:
            return self._owner.call(lambda: verb(driver), deadline_ns)
        except TimeoutError:
            raise self._fail(CameraLost(f"camera {self._name} stopped answering while {what}: check its power, cable and "
                                        "network", self._name)) from None
        except PairRefused:
            self._status = replace(self._status, failures=self._status.failures + 1)
            raise
        except CameraError as error:
            raise self._fail(error) from None

    def _fail(self, error: CameraError) -> CameraError:
        """After an error the camera is closed; its thread does that in its own time."""
        if self._owner is not None:
            self._owner.retire()
            self._retired, self._owner, self._driver = self._owner, None, None
        self._away = self._away or isinstance(error, CameraLost | CameraHeld)
        self._status = replace(self._status, connected=False, error=str(error), failures=self._status.failures + 1)
        return error
