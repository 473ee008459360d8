"""Finds cameras and reads all that they say, without keeping hold of one: a daemon may take it the next moment."""

import ctypes
from collections.abc import Callable, Iterator
from ipaddress import IPv4Address
from typing import Any

from binpick.camera import probe
from binpick.camera.aravis.library import load
from binpick.camera.description import Description, Feature, Found
from binpick.errors import CameraLost, CameraNotFound

SHARED_LIBRARY = "libaravis-0.8.so.0"
NO_LIMIT = 1e300
"""Aravis' word for a limit that the description leaves out is the largest float, for a step the smallest."""
BOOTSTRAP = (0x0000, 0x0004, 0x0010, 0x0014, 0x0904, 0x0934, 0x0938, 0x093C, 0x0940, 0x0950, 0x0954, 0x0958, 0x0A00, 0x0A14,
             0x0D00, 0x0D04, 0x0D08, 0x0D20)
"""Registers that every GigE Vision camera has or may have, and no GenICam feature need show: 0x0934 tells its capabilities."""


def version() -> str:
    """Aravis' own; introspection does not tell it. Raises CameraError when it is not installed."""
    load()
    shared = ctypes.CDLL(SHARED_LIBRARY)
    return ".".join(str(getattr(shared, f"arv_get_{part}_version")()) for part in ("major", "minor", "micro"))


def _genicam_xml(device: Any) -> bytes:
    """As the camera has it. Introspection reads on behind its end, where no zero need stand (Aravis 0.8.26)."""
    function = ctypes.CDLL(SHARED_LIBRARY).arv_device_get_genicam_xml
    function.restype, function.argtypes = ctypes.c_void_p, (ctypes.c_void_p, ctypes.POINTER(ctypes.c_size_t))
    size = ctypes.c_size_t()
    start = function(hash(device), ctypes.byref(size))       # the hash of a GObject's wrapper is its address
    return ctypes.string_at(start, size.value) if start else b""


def discover() -> tuple[Found, ...]:
    """Every GigE Vision camera that answers a broadcast on any port of this host (1 s), by address. Raises CameraError."""
    aravis, _ = load()
    # one whose address fits no port here can only answer by broadcast, and is just the one that is looked for
    aravis.set_interface_flags("GigEVision", int(aravis.GvInterfaceFlags.ACK))
    aravis.update_device_list()
    found = (Found(*(str(read(index) or "") for read in (aravis.get_device_address, aravis.get_device_serial_nbr,
                                                         aravis.get_device_model, aravis.get_device_vendor,
                                                         aravis.get_device_physical_id)))
             for index in range(aravis.get_n_devices()) if aravis.get_device_protocol(index) == "GigEVision")
    return tuple(sorted(found, key=lambda camera: IPv4Address(camera.address)))


def describe(address: str) -> Description:
    """Opens, reads everything, lets go; changes nothing, and also reads a camera that another program controls.

    Raises CameraNotFound when none answers there, CameraLost when it stops doing so.
    """
    aravis, glib = load()
    if not probe.answers(address):
        raise CameraNotFound(f"no camera answers at {address}: `binpick cameras list` shows those that do; check power and "
                             "cable, and `binpick check --host` for the way to it")
    try:
        device = aravis.open_device(address)
        mine = bool(device.is_controller())      # Aravis takes control of a camera that is free
        if mine:
            device.leave_control()
        features = tuple(_features(aravis, glib, device.get_genicam()))
        return Description(address, _genicam_xml(device), features, dict(_registers(aravis, glib, device)), controlled=not mine)
    except glib.Error as error:
        raise CameraLost(f"the camera at {address} stopped answering ({error.message}): check its power, cable and "
                         "network") from None


def _registers(aravis: Any, glib: Any, device: Any) -> Iterator[tuple[str, str]]:
    for address in BOOTSTRAP:
        try:
            yield f"{address:#06x}", f"{device.read_register(address):#010x}"
        except glib.Error as error:                  # an optional one
            _require_alive(aravis, error)


def _require_alive(aravis: Any, error: Any) -> None:
    """Raises the error of a camera that is gone: each further try would take Aravis seconds."""
    if error.matches(aravis.device_error_quark(), aravis.DeviceError.TIMEOUT):
        raise error


def _features(aravis: Any, glib: Any, genicam: Any) -> Iterator[Feature]:
    """In the order of the description's categories, each once. Raises glib.Error when the camera is gone."""
    seen: set[str] = set()

    def walk(category: str) -> Iterator[Feature]:
        node = genicam.get_node(category)
        for name in node.get_features() if node is not None else ():
            if name in seen:
                continue
            seen.add(name)
            feature = genicam.get_node(name)
            if isinstance(feature, aravis.GcCategory):
                yield from walk(name)
            elif feature is not None:
                yield _feature(aravis, glib, feature, category)

    yield from walk("Root")


def _feature(aravis: Any, glib: Any, node: Any, category: str) -> Feature:
    def read(function: Callable[[], Any], default: Any = None) -> Any:
        """What many descriptions leave out is no fault."""
        try:
            return function()
        except glib.Error as error:
            _require_alive(aravis, error)
            return default

    facts: dict[str, Any] = {"name": str(node.get_name()), "category": category, "kind": str(node.get_node_name())}
    if not read(node.is_available, default=False):
        return Feature(**facts, access="-")
    access = aravis.gc_access_mode_to_string(node.get_actual_access_mode()) + \
        (" locked" if read(node.is_locked, default=False) else "")
    facts["access"] = access
    if isinstance(node, aravis.GcCommand) or access.startswith("WO"):
        return Feature(**facts)
    if isinstance(node, aravis.GcEnumeration):
        facts["entries"] = tuple(map(str, read(node.dup_available_string_values, default=())))
    elif isinstance(node, aravis.GcInteger | aravis.GcFloat):
        limits = {"minimum": node.get_min, "maximum": node.get_max, "step": node.get_inc, "unit": node.get_unit}
        facts |= {key: _shown(read(function)) for key, function in limits.items()}
    try:
        value = node.get_value_as_string()
    except glib.Error as error:
        _require_alive(aravis, error)
        return Feature(**facts, trouble=str(error.message))
    return Feature(**facts, value=str(value if value is not None else ""))


def _shown(limit: int | float | str | None) -> str:
    if limit is None:
        return ""
    if isinstance(limit, float):
        return "" if limit and not 1 / NO_LIMIT < abs(limit) < NO_LIMIT else f"{limit:.10g}"
    return str(limit)
