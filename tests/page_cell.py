"""The daemon over the simulated world in process, controlled over REST: `page_cell.py REST_PORT PARTS`."""

import sys

from binpick import app
from binpick.camera.group import CameraGroup
from binpick.data import Image, Light
from binpick.sim import exam
from binpick.sim.camera import SimCamera
from binpick.sim.render import Renderer
from binpick.sim.world import World


def main(port: int, parts: int) -> int:
    """Runs until a signal; the parts never move."""
    rig, scene = exam.rig("A"), World("A", "mixed", parts, 3).scene()
    renderer = Renderer(rig, "A")

    def expose(index: int, light: Light, shot: int) -> Image:
        return renderer.expose(scene, index, light, shot)

    cell = exam.cell("A", control="rest", timeout_ms=30000, publish={"rest": {"port": port}, "modbus": None})
    return app.run(cell, rig, CameraGroup((SimCamera(0, expose), SimCamera(1, expose)), 5000.0))


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2])))
