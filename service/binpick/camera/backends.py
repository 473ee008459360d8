"""The one place that picks a camera backend."""

from binpick.camera import sync
from binpick.camera.aravis import AravisCamera, Setup
from binpick.camera.aravis.inventory import describe, discover, version
from binpick.camera.base import NAMES, Camera
from binpick.camera.files import FileCamera
from binpick.camera.group import CameraGroup
from binpick.camera.need import needs
from binpick.camera.starter import Starter
from binpick.settings.cell import AravisCameras, FileCameras
from binpick.settings.recipe import Recipe

__all__ = ["describe", "discover", "group", "make", "version"]


def make(settings: AravisCameras | FileCameras, recipes: tuple[Recipe, ...] = ()) -> tuple[Camera, ...]:
    """The cameras of a cell file in the rig's order, left and right first, not yet open; `recipes` are what they must do."""
    if isinstance(settings, FileCameras):
        return FileCamera("left", settings.left), FileCamera("right", settings.right)
    places = (settings.left, settings.right, *settings.more)
    return tuple(
        AravisCamera(NAMES[index], place.address, place.serial, Setup(
            sync.steps(settings, first=index == 0), settings.pixel_format, settings.packet_size,
            tuple(other.address for other in (*places[:index], *places[index + 1:])), needs(recipes)))
        for index, place in enumerate(places))


def group(settings: AravisCameras | FileCameras, recipes: tuple[Recipe, ...] = ()) -> CameraGroup:
    """The cameras of a cell file as one instrument, not yet open; `recipes` as for `make`."""
    if isinstance(settings, FileCameras):
        return CameraGroup(make(settings), settings.max_skew_us)
    return CameraGroup(make(settings, recipes), settings.max_skew_us, starter=Starter(settings.sync, sync.device_key(settings)))
