"""A camera's images through Aravis: buffers, resends, and frames counted against triggers; on the camera's own thread."""

import contextlib
import logging
import os
import socket
from pathlib import Path
from typing import Any

from binpick.camera import pixels
from binpick.camera.aravis import library
from binpick.camera.base import MonotonicNs, remaining_s
from binpick.data import Image
from binpick.errors import CameraError, CameraLost, PairRefused
from binpick.settings.cell import PixelFormat

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
BLOCK_IDS = 0xFFFF
"""GigE Vision 1 counts frames 1 to 65535 and again."""

log = logging.getLogger(__name__)


class Stream:
    """The stream of one open Aravis.Camera, acquisition running until its end: block ids would start again.

    `name` is the camera's, for errors. Raises GLib.Error when it cannot be made.
    """

    def __init__(self, camera: Any, name: str, pixel_format: PixelFormat) -> None:
        aravis, _ = library.load()
        self._name = name
        self._format = pixel_format
        self._size = int(camera.get_integer("Width")), int(camera.get_integer("Height"))
        self._triggers = 0
        self._first_id = 1
        self._counted = (0, 0)
        stream = self._stream = camera.create_stream(None, None)
        stream.set_property("socket-buffer", aravis.GvStreamSocketBuffer.FIXED)
        stream.set_property("socket-buffer-size", SOCKET_BUFFER_BYTES)
        stream.set_property("packet-timeout", PACKET_TIMEOUT_US)
        stream.set_property("packet-request-ratio", REQUEST_RATIO)
        self.expect(0.0)
        payload = camera.get_payload()
        granted = _enlarge_socket_buffer(stream.get_port())
        if granted < payload:
            log.warning("camera %s: the socket's buffer holds %d bytes, an image has %d: raise net.core.rmem_max", name,
                        granted, payload)
        for _ in range(BUFFERS):
            stream.push_buffer(aravis.Buffer.new_allocate(payload))
        camera.start_acquisition()

    def expect(self, exposure_us: float) -> None:
        """Images that take that long to begin."""
        self._stream.set_property("frame-retention", int(exposure_us) + RETENTION_US)

    def arm(self) -> None:
        """One more image is to come. Raises CameraLost when there is one without a trigger."""
        while (buffer := self._stream.try_pop_buffer()) is not None:      # images that nobody fetched
            whole, frame_id = self._whole(buffer), buffer.get_frame_id()
            self._stream.push_buffer(buffer)
            if whole and self._triggers:
                self._behind(frame_id)
        self._triggers += 1
        self._counted = self._count("n_resent_packets"), self._count("n_missing_packets")

    def disarm(self) -> None:
        """Nobody knows whether the last one comes: the next image says where counting starts again."""
        self._triggers = 0

    def pop(self, deadline_ns: MonotonicNs) -> Any:
        """The buffer of the last trigger's image, to be pushed again; those of older triggers are dropped.

        Raises PairRefused for an incomplete one: it may lack the packet with its number, but nobody waits for older ones.
        CameraLost when none comes.
        """
        while True:
            buffer = self._stream.timeout_pop_buffer(int(max(0.0, remaining_s(deadline_ns) - POP_MARGIN_S) * 1e6))
            if buffer is None:
                raise CameraLost(f"camera {self._name} took the trigger but sent no image: check its power, cable and network",
                                 self._name)
            wanted = False
            try:
                if not self._whole(buffer):
                    raise PairRefused(f"camera {self._name}: the image came incomplete ({buffer.get_status().value_nick}, "
                                      f"{self.missing} packets missing): check cable, network card and socket buffer",
                                      self._name)
                wanted = self._behind(buffer.get_frame_id()) == 0
                if wanted:
                    return buffer
            finally:
                if not wanted:
                    self._stream.push_buffer(buffer)

    def push(self, buffer: Any) -> None:
        """Gives a buffer back."""
        self._stream.push_buffer(buffer)

    def image(self, buffer: Any) -> Image:
        """Its pixels in 8-bit grey, copied once. Raises CameraError when it is not what the camera was told to send."""
        aravis, _ = library.load()
        if buffer.get_payload_type() != aravis.BufferPayloadType.IMAGE:
            raise CameraError(f"camera {self._name}: it sent {buffer.get_payload_type().value_nick}, not an image: check its "
                              "model and firmware", self._name)
        width, height = size = buffer.get_image_width(), buffer.get_image_height()
        if size != self._size:
            raise CameraError(f"camera {self._name}: the image has {width}x{height} pixels, not "
                              f"{self._size[0]}x{self._size[1]}: it is opened again", self._name)
        try:
            return pixels.grey(buffer.get_data(), buffer.get_image_pixel_format(), self._format, width, height)
        except PairRefused as refusal:
            raise CameraError(f"camera {self._name}: {refusal}: it is opened again", self._name) from None

    @property
    def resent(self) -> int:
        """Packets that came again since the last trigger."""
        return self._count("n_resent_packets") - self._counted[0]

    @property
    def missing(self) -> int:
        """Packets lost since the last trigger."""
        return self._count("n_missing_packets") - self._counted[1]

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
        aravis, _ = library.load()
        return bool(buffer.get_status() == aravis.BufferStatus.SUCCESS)

    def _count(self, name: str) -> int:
        return int(self._stream.get_info_uint64_by_name(name))


def _enlarge_socket_buffer(port: int) -> int:
    """Sets the stream socket's buffer now, and returns what the kernel grants; Aravis would only do so inside the first frame,
    and lose it."""
    granted = 0
    for entry in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):            # not a socket, or closed by another thread meanwhile
            if not str(entry.readlink()).startswith("socket:"):
                continue
            with socket.socket(fileno=os.dup(int(entry.name))) as twin:
                if twin.type == socket.SOCK_DGRAM and twin.family == socket.AF_INET and twin.getsockname()[1] == port:
                    twin.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SOCKET_BUFFER_BYTES)
                    granted = twin.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2       # the kernel counts double
    return granted
