"""What a cell of a test stands on: rigs of two cameras side by side, and cameras that show given images when a gate opens."""

import threading
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np

from binpick import geometry
from binpick.data import CameraStatus, Frame, Image, Light, StereoPair, frozen
from binpick.rig import Rig
from binpick.sim import exam

SIZE_PX = (32, 24)
BLANK = frozen(np.zeros(SIZE_PX[::-1], np.uint8))


def rig(size_px: tuple[int, int] = SIZE_PX, focal_px: float = 100.0, baseline_m: float = 0.15, **changes: object) -> Rig:
    """Two equal cameras without distortion that look the same way."""
    K = ((focal_px, 0.0, size_px[0] / 2), (0.0, focal_px, size_px[1] / 2), (0.0, 0.0, 1.0))
    return Rig.model_validate({"image_size_px": size_px, "cameras": [
        {"name": name, "K": K, "distortion": (0, 0, 0, 0), "T_cam_rig": geometry.translation(x, 0.0, 0.0).tolist()}
        for name, x in (("left", 0.0), ("right", -baseline_m))], **changes})


def small_exam_rig() -> Rig:
    """The exam's rig with 2 for 3 pixels: more per millimetre than over the large bin, and half the time."""
    document = exam.rig("B").model_dump(exclude={"sha256"})
    document["image_size_px"] = tuple(int(side / 1.5) for side in exam.IMAGE_SIZE_PX)
    for camera in document["cameras"]:
        K = np.array(camera["K"]) / [[1.5], [1.5], [1.0]]
        K[:2, 2] -= 1 / 6     # pixel centres are whole numbers
        camera["K"] = K.tolist()
    return Rig.model_validate(document)


@dataclass(kw_only=True)
class Cameras:
    """Two simulated cameras whose capture waits for `gate`; a test says in `images` what they see."""

    opened: bool = False
    shots: int = 0
    gate: threading.Event = field(default_factory=threading.Event)

    def images(self, light: Light) -> tuple[Image, Image]:
        """Left and right, of the shot that `shots` counts."""
        return BLANK, BLANK

    def open(self, deadline_ns: int) -> None:
        self.opened = True

    def capture(self, light: Light, deadline_ns: int) -> StereoPair:
        now_ns = time.monotonic_ns()
        self.gate.wait()
        self.shots += 1
        left, right = (Frame(image, name, self.shots, self.shots, now_ns, now_ns, now_ns + 1, light.exposure_us, light.gain_db)
                       for name, image in zip(("left", "right"), self.images(light), strict=True))
        return StereoPair(left, right, datetime.now(UTC).isoformat(), 0.0, 0.0, "simulated")

    def close(self) -> None:
        self.opened = False

    def watch(self) -> bool:
        return False

    def statuses(self) -> tuple[CameraStatus, ...]:
        return tuple(CameraStatus(name, self.opened, simulated=True) for name in ("left", "right"))
