"""Aravis' objects for one camera, through GObject introspection: the only importer of gi; lives on one thread.

Aravis' traps that shape this module (0.8.26, measured): every call on a dead camera blocks 2.5 s; the socket's buffer is set
only after a frame's first packets; AcquisitionStop and Start on one stream lose frames silently; the packet socket that root
gets has another timing than production; a long exposure runs into the frame retention.
"""

import contextlib
import functools
import os
import socket
import time
from pathlib import Path
from typing import Any

import numpy as np

from binpick.camera.base import MonotonicNs, remaining_s
from binpick.data import Frame, Light
from binpick.errors import CameraError, CameraHeld, CameraLost, CameraNotFound, PairRefused

BUFFERS = 6
SOCKET_BUFFER_BYTES = 8 << 20
"""Three whole frames; the kernel clips it to net.core.rmem_max."""
PACKET_TIMEOUT_US = 10_000
"""When a missing packet is asked for again. Aravis' 20 ms dominates the latency of a lossy link; at 5 ms a sender that was
merely held up for a moment is asked for the rest of its frame."""
REQUEST_RATIO = 2.0
"""The largest request, as a multiple of a frame's packets: of any size. With Aravis' 0.25 a request for the rest of a frame, as
after such a moment, was its last: what was lost later stayed lost (measured: 3 of 60 pairs at 2 % loss)."""
RETENTION_US = 550_000
"""How long an incomplete frame may wait for its next packet, beyond the exposure: longer than a sender that stalls for half a
second, and short enough for the group to find out in time that the camera has died."""
POP_MARGIN_S = 0.05
"""The driver gives up this much before its caller does, so that the thread is free again."""
PROJECTOR_LINE = "Line2"
"""The Alvium's opto-isolated output."""
BLOCK_IDS = 0xFFFF
"""GigE Vision 1 counts frames 1 to 65535 and again."""


@functools.cache
def _library() -> tuple[Any, Any]:
    """Aravis and GLib, loaded at first use. Raises CameraError when the system packages are missing."""
    try:
        import gi

        gi.require_version("Aravis", "0.8")
        from gi.repository import Aravis, GLib
    except (ImportError, ValueError) as error:
        raise CameraError("Aravis is not installed: apt-get install python3-gi gir1.2-aravis-0.8") from error
    return Aravis, GLib


class Driver:
    """Aravis' objects and what is done to them; lives on the camera's thread."""

    def __init__(self, name: str, packet_size: int, heartbeat_ms: int) -> None:
        self._name = name
        self._packet_size = packet_size
        self._heartbeat_ms = heartbeat_ms
        self._camera: Any = None
        self._stream: Any = None
        self._exposure_us = self._gain_db = 0.0
        self._triggers = 0
        self._triggered_ns = 0
        self._counted = (0, 0)
        self._first_id = 1

    def find(self, serial: str) -> str:
        """The address of the camera with that serial number, by broadcast (1 s). Raises CameraNotFound."""
        aravis, _ = _library()
        aravis.update_device_list()
        seen = {aravis.get_device_serial_nbr(i): str(aravis.get_device_address(i)) for i in range(aravis.get_n_devices())}
        if serial not in seen:
            raise CameraNotFound(f"camera {self._name}: no camera with serial number {serial!r} answers; there are "
                                 f"{', '.join(sorted(map(str, seen))) or 'none'}", self._name)
        return seen[serial]

    def open(self, address: str, serial: str) -> dict[str, Any]:
        """Control, settings, stream, acquisition, in the one order that works; what the status says of the camera."""
        aravis, glib = _library()
        try:
            camera = self._camera = aravis.Camera.new(address)
            if not camera.get_device().is_controller():
                raise CameraHeld(f"camera {self._name} at {address} is controlled by another program: end that one (a program "
                                 f"that died gives it back after its heartbeat timeout)", self._name)
            found = str(camera.get_device_serial_number())
            if serial and found != serial:
                raise CameraNotFound(f"camera {self._name}: the camera at {address} has serial number {found}, not {serial}: "
                                     "are the cameras exchanged?", self._name)
            self._prepare(aravis, camera)
            self._start_stream(aravis, camera)
            firmware = str(camera.get_string("DeviceFirmwareVersion")) if self._has("DeviceFirmwareVersion") else ""
            return {"model": str(camera.get_model_name()), "serial": found, "simulated": firmware.startswith("binpick-sim")}
        except glib.Error as error:
            raise self._translated(error, "opening") from None

    def _has(self, feature: str) -> bool:
        return bool(self._camera.is_feature_available(feature))

    def _prepare(self, aravis: Any, camera: Any) -> None:
        camera.stop_acquisition()                     # a controller that died may have left it running
        camera.set_pixel_format(aravis.PIXEL_FORMAT_MONO_8)
        camera.set_acquisition_mode(aravis.AcquisitionMode.CONTINUOUS)
        if camera.is_exposure_auto_available():
            camera.set_exposure_time_auto(aravis.Auto.OFF)
        if camera.is_gain_auto_available():
            camera.set_gain_auto(aravis.Auto.OFF)
        # not set_trigger(): it also writes the frame rate, which some cameras lock once a trigger is on
        for feature, value in (("TriggerSelector", "FrameStart"), ("TriggerMode", "On"), ("TriggerSource", "Software")):
            camera.set_string(feature, value)
        camera.set_integer("GevHeartbeatTimeout", self._heartbeat_ms)
        if self._has("PtpEnable"):
            camera.set_boolean("PtpEnable", True)
        camera.gv_set_packet_size(self._packet_size)
        camera.gv_set_stream_options(aravis.GvStreamOption.PACKET_SOCKET_DISABLED)

    def _start_stream(self, aravis: Any, camera: Any) -> None:
        stream = self._stream = camera.create_stream(None, None)
        stream.set_property("socket-buffer", aravis.GvStreamSocketBuffer.FIXED)
        stream.set_property("socket-buffer-size", SOCKET_BUFFER_BYTES)
        stream.set_property("packet-timeout", PACKET_TIMEOUT_US)
        stream.set_property("packet-request-ratio", REQUEST_RATIO)
        stream.set_property("frame-retention", RETENTION_US)
        _enlarge_socket_buffer(stream.get_port())
        payload = camera.get_payload()
        for _ in range(BUFFERS):
            stream.push_buffer(aravis.Buffer.new_allocate(payload))
        camera.start_acquisition()                    # and never stopped: block ids would start again

    def configure(self, light: Light) -> None:
        """Writes what the light asks for, reads back what the camera made of it."""
        _, glib = _library()
        camera = self._camera
        try:
            camera.set_exposure_time(light.exposure_us)
            camera.set_gain(light.gain_db)
            self._exposure_us, self._gain_db = float(camera.get_exposure_time()), float(camera.get_gain())
            if self._has("LineSource"):
                camera.set_string("LineSelector", PROJECTOR_LINE)
                camera.set_string("LineSource", "ExposureActive" if light.projector else "Off")
        except glib.Error as error:
            raise self._translated(error, "setting exposure and gain") from None
        self._stream.set_property("frame-retention", int(self._exposure_us) + RETENTION_US)

    def trigger(self) -> None:
        """Sends it; the camera's acknowledge has come when this returns."""
        _, glib = _library()
        self._discard()
        self._triggers += 1
        self._counted = self._count("n_resent_packets"), self._count("n_missing_packets")
        self._triggered_ns = time.monotonic_ns()
        try:
            self._camera.execute_command("TriggerSoftware")
        except glib.Error as error:
            raise self._translated(error, "triggering") from None

    def _discard(self) -> None:
        """Images that nobody fetched. Raises CameraLost when there is one without a trigger."""
        while (buffer := self._stream.try_pop_buffer()) is not None:
            whole, frame_id = self._whole(buffer), buffer.get_frame_id()
            self._stream.push_buffer(buffer)
            if whole:
                self._behind(frame_id)

    def grab(self, sequence: int, deadline_ns: MonotonicNs) -> tuple[Frame, str]:
        """The frame of the last trigger and the name of the clock it is stamped by; frames of older triggers are dropped.

        Raises PairRefused for an incomplete one: it may lack the packet with its number, but nobody waits for older ones.
        """
        stream = self._stream
        while True:
            buffer = stream.timeout_pop_buffer(int(max(0.0, remaining_s(deadline_ns) - POP_MARGIN_S) * 1e6))
            if buffer is None:
                raise CameraLost(f"camera {self._name} took the trigger but sent no image: check its power, cable and network",
                                 self._name)
            try:
                if not self._whole(buffer):
                    raise PairRefused(f"camera {self._name}: the image came incomplete ({buffer.get_status().value_nick}, "
                                      f"{self._missing()} packets missing): check cable, network card and socket buffer",
                                      self._name)
                if self._behind(buffer.get_frame_id()) == 0:
                    return self._frame(buffer, sequence), self._clock()
            finally:
                stream.push_buffer(buffer)

    def _behind(self, frame_id: int) -> int:
        """How many triggers older than the last one a frame is; the first frame after opening says where counting starts.

        Raises CameraLost for one that no trigger asked for: counted on, every later image would be taken for a newer one.
        """
        if self._triggers == 1:
            self._first_id = frame_id
        behind = (self._first_id + self._triggers - 1 - frame_id) % BLOCK_IDS
        if behind > BLOCK_IDS // 2:
            raise CameraLost(f"camera {self._name} sent an image that it was not triggered for: it is opened again", self._name)
        return behind

    def _whole(self, buffer: Any) -> bool:
        aravis, _ = _library()
        return bool(buffer.get_status() == aravis.BufferStatus.SUCCESS)

    def _frame(self, buffer: Any, sequence: int) -> Frame:
        resends = self._count("n_resent_packets") - self._counted[0]
        height, width = buffer.get_image_height(), buffer.get_image_width()
        # get_data() copies once; the bytes are the frame's own
        image = np.frombuffer(buffer.get_data(), np.uint8, count=height * width).reshape(height, width)
        return Frame(image=image, camera=self._name, sequence=sequence, frame_id=int(buffer.get_frame_id()),
                     timestamp_ns=int(buffer.get_timestamp()), triggered_ns=self._triggered_ns,
                     received_ns=time.monotonic_ns(), exposure_us=self._exposure_us, gain_db=self._gain_db,
                     resends=resends, missing=self._missing())

    def _missing(self) -> int:
        """Packets lost since the last trigger."""
        return self._count("n_missing_packets") - self._counted[1]

    def _count(self, name: str) -> int:
        return int(self._stream.get_info_uint64_by_name(name))

    def _clock(self) -> str:
        """"ptp" while the camera is synchronised to other clocks; it may lose them at any time."""
        _, glib = _library()
        try:
            synchronised = self._has("PtpStatus") and self._camera.get_string("PtpStatus") in ("Master", "Slave")
        except glib.Error as error:
            raise self._translated(error, "reading its clock") from None
        return "ptp" if synchronised else ""

    def _translated(self, error: Any, doing: str) -> CameraError:
        aravis, _ = _library()
        kind = aravis.DeviceError
        if error.code in (kind.PROTOCOL_ERROR_ACCESS_DENIED, kind.NOT_CONTROLLER):
            return CameraHeld(f"camera {self._name} obeys this daemon no longer: it was without power for a moment, or another "
                              "program took control of it", self._name)
        if error.code in (kind.FEATURE_NOT_FOUND, kind.WRONG_FEATURE, kind.INVALID_PARAMETER,
                          kind.PROTOCOL_ERROR_INVALID_PARAMETER):
            return CameraError(f"camera {self._name} does not accept {doing}: {error.message}", self._name)
        return CameraLost(f"camera {self._name} failed while {doing} ({error.message}): check its power, cable and network",
                          self._name)

    def close(self) -> None:
        """Lets go of everything; on a dead camera that takes Aravis seconds."""
        if self._camera is not None:
            _, glib = _library()
            with contextlib.suppress(glib.Error):     # a camera that is gone cannot be stopped
                self._camera.stop_acquisition()
        self._stream = None
        self._camera = None


def _enlarge_socket_buffer(port: int) -> None:
    """Sets the stream socket's buffer now; Aravis would only do so inside the first frame, and lose it."""
    for entry in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):            # not a socket, or closed by another thread meanwhile
            if not str(entry.readlink()).startswith("socket:"):
                continue
            with socket.socket(fileno=os.dup(int(entry.name))) as twin:
                if twin.type == socket.SOCK_DGRAM and twin.family == socket.AF_INET and twin.getsockname()[1] == port:
                    twin.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SOCKET_BUFFER_BYTES)
