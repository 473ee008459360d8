"""The daemon over in-process cameras that are as slow as asked: `slow_cell.py REST_PORT MODBUS_PORT MODE`.

MODE: stuck-open and stuck-capture never come back, as a driver stuck in C does not; quick gives noise at once.
"""

import sys
import threading

import numpy as np

import staged
from binpick import app, settings
from binpick.data import Image, Light, frozen

SIZE_PX = (1936, 1216)


class SlowCameras(staged.Cameras):
    """Two cameras that see noise."""

    def __init__(self, mode: str) -> None:
        super().__init__()
        self._mode = mode
        if mode != "stuck-capture":
            self.gate.set()

    def open(self, deadline_ns: int) -> None:
        if self._mode == "stuck-open":
            threading.Event().wait()
        super().open(deadline_ns)

    def images(self, light: Light) -> tuple[Image, Image]:
        noise = frozen(np.random.default_rng(1).integers(0, 256, SIZE_PX[::-1], dtype=np.uint8))
        return noise, noise


def main(rest_port: int, modbus_port: int, mode: str) -> None:
    """Runs until a signal."""
    cell = settings.Cell.model_validate({
        "bin": {"inner_size_m": [0.6, 0.4, 0.18], "pose": {"position_m": [0, 0, 1], "rotvec_rad": [np.pi, 0, 0]}},
        "recipes": [{"frame": "camera"}], "control": "rest", "timeout_ms": 30000,
        "publish": {"rest": {"port": rest_port}, "modbus": {"host": "127.0.0.1", "port": modbus_port}}})
    app.run(cell, staged.rig(SIZE_PX, 1740.0), SlowCameras(mode))
    app.leave()


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3])
