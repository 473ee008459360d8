"""GigE Vision cameras driven by Aravis."""

from binpick.camera.aravis.camera import AravisCamera

__all__ = ["AravisCamera"]
