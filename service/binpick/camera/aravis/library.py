"""Aravis itself, through GObject introspection: the only importer of gi; and what its errors mean to a user."""

import functools
from typing import Any

from binpick.errors import CameraError, CameraHeld, CameraLost


@functools.cache
def load() -> tuple[Any, Any]:
    """Aravis and GLib, loaded at first use. Raises CameraError when the system packages are missing."""
    try:
        import gi

        gi.require_version("Aravis", "0.8")
        from gi.repository import Aravis, GLib
    except (ImportError, ValueError) as error:
        raise CameraError("Aravis is not installed: apt-get install python3-gi gir1.2-aravis-0.8") from error
    return Aravis, GLib


def translated(error: Any, name: str, doing: str) -> CameraError:
    """A GLib.Error as ours; `name` is the camera's."""
    aravis, _ = load()
    kind = aravis.DeviceError
    if "device" in error.domain and error.code in (kind.PROTOCOL_ERROR_ACCESS_DENIED, kind.NOT_CONTROLLER):
        return CameraHeld(f"camera {name} obeys this daemon no longer: it was without power for a moment, or another "
                          "program took control of it", name)
    if "device" not in error.domain or error.code in (
            kind.FEATURE_NOT_FOUND, kind.WRONG_FEATURE, kind.INVALID_PARAMETER, kind.PROTOCOL_ERROR_INVALID_PARAMETER,
            kind.PROTOCOL_ERROR_WRITE_PROTECT, kind.PROTOCOL_ERROR_INVALID_ADDRESS, kind.PROTOCOL_ERROR_NOT_IMPLEMENTED):
        return CameraError(f"camera {name} does not accept {doing} ({error.message}): check the cell file, and the camera's "
                           "model and firmware", name)
    return CameraLost(f"camera {name} failed while {doing} ({error.message}): check its power, cable and network", name)
