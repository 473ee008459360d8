"""The daemon over in-process cameras that are as slow as asked: `slow_cell.py REST_PORT MODBUS_PORT MODE`.

MODE: stuck-open and stuck-capture never come back, as a driver stuck in C does not; quick gives noise at once.
"""

import sys
import threading
import time

import numpy as np

from binpick import app, settings
from binpick.data import CameraStatus, Frame, Light, StereoPair, frozen
from binpick.rig import Rig

EYE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
K = ((1740.0, 0.0, 968.0), (0.0, 1740.0, 608.0), (0.0, 0.0, 1.0))
SIZE = (1936, 1216)


class SlowCameras:
    """Two cameras that see noise."""

    def __init__(self, mode: str) -> None:
        self._mode, self._open = mode, False

    def open(self, deadline_ns: int) -> None:
        """As the group's."""
        if self._mode == "stuck-open":
            threading.Event().wait()
        self._open = True

    def capture(self, light: Light, deadline_ns: int) -> StereoPair:
        """As the group's."""
        if self._mode == "stuck-capture":
            threading.Event().wait()
        now_ns = time.monotonic_ns()
        noise = np.random.default_rng(1).integers(0, 256, SIZE[::-1], dtype=np.uint8)
        left, right = (Frame(frozen(noise), name, 1, 1, now_ns, now_ns, now_ns, light.exposure_us, light.gain_db)
                       for name in ("left", "right"))
        return StereoPair(left, right, "2026-01-02T03:04:05Z", 0.0, 0.0, "noise")

    def close(self) -> None:
        """As the group's."""
        self._open = False

    def watch(self) -> bool:
        return False

    def statuses(self) -> tuple[CameraStatus, ...]:
        """As the group's."""
        return tuple(CameraStatus(name, self._open, simulated=True) for name in ("left", "right"))


def main(rest_port: int, modbus_port: int, mode: str) -> None:
    """Runs until a signal."""
    rig = Rig.model_validate({"image_size_px": SIZE, "cameras": [
        {"name": name, "K": K, "distortion": (0, 0, 0, 0), "T_cam_rig": T}
        for name, T in (("left", EYE), ("right", ((1.0, 0.0, 0.0, -0.15), *EYE[1:])))]})
    cell = settings.Cell.model_validate({
        "bin": {"inner_size_m": [0.6, 0.4, 0.18], "pose": {"position_m": [0, 0, 1], "rotvec_rad": [np.pi, 0, 0]}},
        "recipes": [{"frame": "camera"}], "control": "rest", "timeout_ms": 30000,
        "publish": {"rest": {"port": rest_port}, "modbus": {"host": "127.0.0.1", "port": modbus_port}}})
    app.run(cell, rig, SlowCameras(mode))
    app.leave()


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3])
