"""Images from disk as a camera: every trigger shows the same picture."""

import time
from pathlib import Path

import cv2
import numpy as np

from binpick.camera.base import Clock, MonotonicNs
from binpick.data import CameraStatus, Frame, Image, Light, frozen
from binpick.errors import CameraLost, ImageError


def read(path: Path) -> Image:
    """An image file in grey, 8 bit. Raises ImageError naming the file."""
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise ImageError(f"{path}: the image cannot be read: {error.strerror}") from None
    image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if data.size else None
    if image is None:
        raise ImageError(f"{path}: not an image that can be read (PNG, JPEG, TIFF and BMP can)")
    return frozen(np.asarray(image, np.uint8))


class FileCamera:
    """A camera that opens a file. Exposure and gain are taken as asked for; its clock is the file's: it stands still."""

    def __init__(self, name: str, path: Path, clock: Clock = time.monotonic_ns) -> None:
        self._path = path
        self._clock = clock
        self._image: Image | None = None
        self._light = Light(exposure_us=0.0, gain_db=0.0, projector=False)
        self._triggered = (0, 0)
        self._frames = 0
        self._name = name

    @property
    def name(self) -> str:
        """As in every error."""
        return self._name

    def open(self, deadline_ns: MonotonicNs) -> None:  # noqa: ARG002 - a file does not keep anybody waiting
        """Reads the file. Raises ImageError naming it."""
        self._image = read(self._path)

    def configure(self, light: Light, deadline_ns: MonotonicNs) -> None:  # noqa: ARG002
        """Takes note."""
        self._opened()
        self._light = light

    def trigger(self, sequence: int, deadline_ns: MonotonicNs) -> None:  # noqa: ARG002
        """Takes note of the time."""
        self._opened()
        self._triggered = (sequence, self._clock())

    def arm(self, sequence: int, deadline_ns: MonotonicNs) -> None:
        """As a trigger."""
        self.trigger(sequence, deadline_ns)

    def disarm(self, deadline_ns: MonotonicNs) -> None:
        """Nothing."""

    def device_ns(self, host_ns: MonotonicNs) -> int | None:  # noqa: ARG002
        """None: a file's clock stands still."""
        return None

    def grab(self, sequence: int, deadline_ns: MonotonicNs) -> Frame:  # noqa: ARG002
        """The file's image. Raises CameraLost when there was no such trigger."""
        image = self._opened()
        triggered, triggered_ns = self._triggered
        if triggered != sequence:
            raise CameraLost(f"camera {self._name} was not triggered", self._name)
        self._frames += 1
        return Frame(image=image, camera=self._name, sequence=sequence, frame_id=self._frames, timestamp_ns=0,
                     triggered_ns=triggered_ns, received_ns=self._clock(), exposure_us=self._light.exposure_us,
                     gain_db=self._light.gain_db)

    def watch(self) -> bool:
        """Nothing becomes of a file that was read."""
        return False

    def close(self) -> None:
        """Forgets the image; the file is read again at the next opening."""
        self._image = None

    def status(self) -> CameraStatus:
        """Always simulated: no camera looks into the bin."""
        return CameraStatus(self._name, connected=self._image is not None, model="file", address=str(self._path),
                            frames=self._frames, simulated=True)

    def _opened(self) -> Image:
        if self._image is None:
            raise CameraLost(f"camera {self._name} is not open", self._name)
        return self._image
