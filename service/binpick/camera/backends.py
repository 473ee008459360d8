"""The one place that picks a camera backend."""

from binpick.camera.aravis import AravisCamera
from binpick.camera.aravis.inventory import describe, discover, version
from binpick.camera.base import Camera
from binpick.camera.files import FileCamera
from binpick.settings.cell import AravisCameras, FileCameras

__all__ = ["describe", "discover", "make", "version"]


def make(settings: AravisCameras | FileCameras) -> tuple[Camera, Camera]:
    """The left and the right camera of a cell file, not yet open."""
    if isinstance(settings, FileCameras):
        return FileCamera("left", settings.left), FileCamera("right", settings.right)
    left, right = (AravisCamera(name, place.address, place.serial, settings.packet_size, settings.heartbeat_ms)
                   for name, place in (("left", settings.left), ("right", settings.right)))
    return left, right
