"""GigE Vision cameras driven by Aravis."""

from binpick.camera.aravis.camera import AravisCamera
from binpick.camera.aravis.driver import Setup

__all__ = ["AravisCamera", "Setup"]
