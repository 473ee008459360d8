"""Aravis' objects for one camera, and what is done to them in which order; lives on one thread.

Aravis' traps that shape this folder (0.8.26, measured): every call on a dead camera blocks 2.5 s; the socket's buffer is set
only after a frame's first packets; AcquisitionStop and Start on one stream lose frames silently; the packet socket that root
gets has another timing than production; a long exposure runs into the frame retention.
"""

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

from binpick.camera import network
from binpick.camera.aravis import library
from binpick.camera.aravis.features import Features
from binpick.camera.aravis.stream import Stream
from binpick.camera.aravis.timekeeper import Timekeeper
from binpick.camera.base import MonotonicNs
from binpick.camera.clock import DeviceClock
from binpick.camera.need import RANGES, Need
from binpick.camera.proof import SYNCHRONISED
from binpick.camera.sync import PROJECTOR_LINE, Step
from binpick.data import Frame, Light
from binpick.errors import CameraError, CameraHeld, CameraLost, CameraNotFound
from binpick.settings.cell import PixelFormat

IDLE_NS = 5_000_000
"""So long nothing is asked of it before its clock is looked at: between the shots of one cycle a trigger would have to wait."""
EXPOSURE_TOLERANCE = 0.01
"""Cameras round the exposure to their row's time."""
GAIN_TOLERANCE_DB = 0.1


@dataclass(frozen=True, slots=True)
class Setup:
    """What a camera is set to when it is opened. `neighbours` are the other cameras' addresses, as far as they are known.

    `needs` are what the recipes will set, of which nothing may lie outside of the camera's own ranges.
    """

    steps: tuple[Step, ...]
    pixel_format: PixelFormat = "Mono8"
    packet_size: int | Literal["auto"] = "auto"
    neighbours: tuple[str, ...] = ()
    needs: tuple[Need, ...] = ()


class Driver:
    """Aravis' objects and what is done to them; lives on the camera's thread.

    Other threads may read `clock`, the device's as latched, `ptp`, its state and its offset from the master in ns, and
    `trouble`, why it could not be talked to in an idle moment.
    """

    def __init__(self, name: str, setup: Setup) -> None:
        self._name = name
        self._setup = setup
        self._camera: Any = None
        self._features: Features | None = None
        self._stream: Stream | None = None
        self._time: Timekeeper | None = None
        self._exposure_us = self._gain_db = 0.0
        self._triggered_ns = self._acknowledged_ns = 0
        self._waiting, self._idle_ns = False, 0
        self.clock = DeviceClock()
        self.ptp = ("", 0.0)
        self.trouble: CameraError | None = None

    def find(self, serial: str) -> str:
        """The address of the camera with that serial number, by broadcast (1 s). Raises CameraNotFound."""
        aravis, _ = library.load()
        aravis.update_device_list()
        seen = {aravis.get_device_serial_nbr(i): str(aravis.get_device_address(i)) for i in range(aravis.get_n_devices())}
        if serial not in seen:
            raise CameraNotFound(f"camera {self._name}: no camera with serial number {serial!r} answers; there are "
                                 f"{', '.join(sorted(map(str, seen))) or 'none'}: check its power and cable, and the number in "
                                 "the cell file", self._name)
        return seen[serial]

    def open(self, address: str, serial: str) -> dict[str, Any]:
        """Control, settings, stream, acquisition, in the one order that works; what the status says of the camera."""
        aravis, _ = library.load()
        with self._translating("opening"):
            camera = self._camera = aravis.Camera.new(address)
            if not camera.get_device().is_controller():
                raise CameraHeld(f"camera {self._name} at {address} is controlled by another program: end that one (a program "
                                 f"that died gives it back after its heartbeat timeout)", self._name)
            found = str(camera.get_device_serial_number())
            if serial and found != serial:
                raise CameraNotFound(f"camera {self._name}: the camera at {address} has serial number {found}, not {serial}: "
                                     "are the cameras exchanged?", self._name)
            features = self._features = Features(camera, self._name)
            camera.stop_acquisition()                     # a controller that died may have left it running
            features.apply(self._setup.steps)
            packet_size = self._fit_packets(camera, features, address)
            camera.gv_set_stream_options(aravis.GvStreamOption.PACKET_SOCKET_DISABLED)
            self._stream = Stream(camera, self._name, self._setup.pixel_format)
            self._time = Timekeeper(camera, features)
            self._time.begin()
            self._note()
            ranges = {name: features.bounds(feature) for name, feature in RANGES.items()}
            self._meet(ranges)
            firmware = str(camera.get_string("DeviceFirmwareVersion")) if features.has("DeviceFirmwareVersion") else ""
            return {"model": str(camera.get_model_name()), "serial": found, "simulated": firmware.startswith("binpick-sim"),
                    "packet_size": packet_size, **ranges}

    def _meet(self, ranges: dict[str, tuple[float, float]]) -> None:
        """Raises CameraError for the first need that is out of range."""
        for need in self._setup.needs:
            low, high = ranges[need.range]
            if not low <= need.value <= high:
                raise CameraError(f"camera {self._name}: {need.setting} is {need.value:g}, but this camera's range is {low:g} "
                                  f"to {high:g}: change the cell file", self._name)

    def _fit_packets(self, camera: Any, features: Features, address: str) -> int:
        """Their size in bytes, and the pause between them when cameras share a port."""
        size = self._setup.packet_size
        if size == "auto":
            camera.gv_auto_packet_size()
        else:
            camera.gv_set_packet_size(size)
        size = int(camera.gv_get_packet_size())
        cameras = network.sharing(address, self._setup.neighbours)
        speed = int(camera.get_integer("DeviceLinkSpeed")) if features.has("DeviceLinkSpeed") else 0
        if features.has("GevSCPD"):
            camera.gv_set_packet_delay(network.packet_delay_ns(size, cameras, speed or network.GIGABIT))
        return size

    def _note(self) -> None:
        """What others may read of its clock, while only this thread has the camera's objects."""
        assert self._time is not None
        self.clock, self.ptp = self._time.clock, (self._time.ptp, self._time.ptp_offset_ns)

    @property
    def due_ns(self) -> MonotonicNs | None:
        """When its clock is to be looked at again; None while an image is waited for, or it is not open."""
        if self._time is None or self._waiting:
            return None
        return max(self._time.due_ns, self._idle_ns + IDLE_NS)

    def rest(self) -> None:
        """Looks at its clock."""
        if self._time is not None:
            try:
                with self._translating("reading its clock"):
                    self._time.rest()
            except (CameraLost, CameraHeld) as error:
                # the error itself has a traceback, whose frames would keep the camera's objects
                self.trouble = type(error)(str(error), error.camera)
                raise
            self._note()

    def configure(self, light: Light) -> None:
        """Writes what the light asks for. Raises CameraError when the camera makes something else of it."""
        assert self._stream is not None
        assert self._features is not None
        with self._translating("setting exposure and gain"):
            apart_us = light.exposure_us * EXPOSURE_TOLERANCE
            self._exposure_us = self._features.approach("ExposureTime", light.exposure_us, apart_us)
            self._gain_db = self._features.approach("Gain", light.gain_db, GAIN_TOLERANCE_DB)
            if self._features.has("LineSource"):
                self._features.apply((Step("LineSelector", PROJECTOR_LINE),
                                      Step("LineSource", "ExposureActive" if light.projector else "Off")))
        self._stream.expect(self._exposure_us)
        self._idle_ns = time.monotonic_ns()

    def arm(self) -> None:
        """Something else will start an exposure. Raises CameraLost."""
        assert self._stream is not None
        self._stream.arm()
        self._triggered_ns, self._acknowledged_ns, self._waiting = time.monotonic_ns(), 0, True

    def disarm(self) -> None:
        """Perhaps it did not."""
        assert self._stream is not None
        self._stream.disarm()
        self._waiting = False

    def trigger(self) -> None:
        """Sends it; the camera's acknowledge has come when this returns."""
        self.arm()
        with self._translating("triggering"):
            self._camera.execute_command("TriggerSoftware")
        self._acknowledged_ns = time.monotonic_ns()

    def grab(self, sequence: int, deadline_ns: MonotonicNs) -> Frame:
        """The frame of the last trigger; frames of older triggers are dropped. Raises CameraLost, PairRefused, CameraError.

        Its clock is latched while the image is still on its way.
        """
        assert self._stream is not None
        assert self._time is not None
        with self._translating("reading its clock"):
            self._time.latch()
            changed = self._time.observe()
        self._note()
        try:
            buffer = self._stream.pop(deadline_ns)
        finally:
            self._waiting, self._idle_ns = False, time.monotonic_ns()
        try:
            frame = self._frame(buffer, sequence)
        finally:
            self._stream.push(buffer)
        if changed:            # nobody knows in which time it was stamped
            return frame
        return replace(frame, latched_ns=self._time.clock.host_ns(frame.timestamp_ns), ptp_offset_ns=self._time.ptp_offset_ns,
                       ptp=self._time.ptp if self._time.ptp in SYNCHRONISED else "")

    def _frame(self, buffer: Any, sequence: int) -> Frame:
        assert self._stream is not None
        image, received_ns, timestamp_ns = self._stream.image(buffer), time.monotonic_ns(), int(buffer.get_timestamp())
        # the image left when its exposure was over
        latest_ns = received_ns - int(self._exposure_us * 1000)
        return Frame(image=image, camera=self._name, sequence=sequence, frame_id=int(buffer.get_frame_id()),
                     timestamp_ns=timestamp_ns, triggered_ns=self._triggered_ns, received_ns=received_ns,
                     exposure_us=self._exposure_us, gain_db=self._gain_db, resends=self._stream.resent,
                     missing=self._stream.missing, acknowledged_ns=self._acknowledged_ns or latest_ns)

    @contextlib.contextmanager
    def _translating(self, doing: str) -> Iterator[None]:
        _, glib = library.load()
        try:
            yield
        except glib.Error as error:
            raise library.translated(error, self._name, doing) from None

    def close(self) -> None:
        """Lets go of everything; on a dead camera that takes Aravis seconds."""
        if self._camera is not None:
            _, glib = library.load()
            with contextlib.suppress(glib.Error):     # a camera that is gone cannot be stopped
                self._camera.stop_acquisition()
        self._stream = self._time = self._features = None
        self._camera = None
