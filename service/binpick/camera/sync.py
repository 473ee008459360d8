"""The ways to trigger cameras together, each as the whole table of features that a camera gets, in the order that works."""

import zlib
from dataclasses import dataclass

from binpick.camera.action import GROUP
from binpick.settings.cell import AravisCameras


@dataclass(frozen=True, slots=True)
class Step:
    """A feature (SFNC) and its value. `optional`: cameras without it, or that may not write it, do well without; `secret`: it
    cannot be read back."""

    feature: str
    value: str | int | float | bool
    optional: bool = False
    secret: bool = False


PROJECTOR_LINE = "Line2"
"""The Alvium's opto-isolated output, which strobes the projector."""


def device_key(cameras: AravisCameras) -> int:
    """Of action commands: another one for every rig, so that two on one network do not start each other."""
    places = (cameras.left, cameras.right, *cameras.more)
    return zlib.crc32(" ".join(place.address or place.serial for place in places).encode()) or 1


def steps(cameras: AravisCameras, first: bool) -> tuple[Step, ...]:
    """What the rig's first camera, or another one, is set to before its stream starts.

    The order is the Alvium guide's: format, then exposure, then trigger, whose mode is switched on last. PTP is on in every
    mode, since its clock proves the skew.
    """
    return (
        Step("TriggerMode", "Off", optional=True),
        Step("PixelFormat", cameras.pixel_format),
        Step("AcquisitionMode", "Continuous"),
        Step("ExposureMode", "Timed", optional=True),
        Step("ExposureAuto", "Off", optional=True),
        Step("GainAuto", "Off", optional=True),
        Step("GevHeartbeatTimeout", cameras.heartbeat_ms),
        Step("PtpEnable", True, optional=True),
        Step("TriggerSelector", "FrameStart"),
        # a line that was turned over would light the bin between the exposures
        Step("LineSelector", PROJECTOR_LINE, optional=True),
        Step("LineMode", "Output", optional=True),
        Step("LineInverter", False, optional=True),
        *_source(cameras, first),
        Step("TriggerMode", "On"),
    )


def _source(cameras: AravisCameras, first: bool) -> tuple[Step, ...]:
    match cameras.sync, first:
        case "line", True:
            return (Step("TriggerSource", "Software"), Step("LineSelector", cameras.lines.output),
                    Step("LineMode", "Output", optional=True), Step("LineInverter", False, optional=True),
                    Step("LineSource", "ExposureActive"))
        case "line", False:
            return (Step("LineSelector", cameras.lines.input), Step("LineMode", "Input", optional=True),
                    Step("LineInverter", False, optional=True), Step("TriggerSource", cameras.lines.input),
                    Step("TriggerActivation", "RisingEdge"))
        case ("action" | "scheduled_action"), _:
            return (Step("ActionDeviceKey", device_key(cameras), secret=True), Step("ActionSelector", 0),
                    Step("ActionGroupKey", GROUP), Step("ActionGroupMask", GROUP), Step("TriggerSource", "Action0"))
    return (Step("TriggerSource", "Software"),)

