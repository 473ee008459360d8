"""The camera's features: one table, from which the registers and the GenICam description are both made.

Names and enumerations follow the Standard Features Naming Convention as an Allied Vision Alvium uses it; the addresses of
bootstrap registers are those of GigE Vision 1.2, all others are handed out in the table's order.
"""

from dataclasses import dataclass, field, replace
from typing import Literal

from binpick.sim.gige.action import SIGNALS
from binpick.sim.gige.pixels import FORMATS

FEATURE_BASE = 0xA000
XML_BASE = 0x20000
MONO8 = FORMATS["Mono8"]
FIRMWARE = "binpick-sim 1.0"
VENDOR = "Allied Vision"
MODEL = "Alvium G1-240m"
SIZE_PX = (1936, 1216)
"""Width and height of its sensor."""
LINES = 4
LINK_BYTES_PER_S = 125_000_000
GVSP_OVERHEAD = 36
"""Bytes of IP, UDP and GVSP headers that count as part of GevSCPSPacketSize."""

Kind = Literal["integer", "float", "enumeration", "command", "string", "boolean"]


@dataclass(frozen=True, slots=True)
class Feature:
    """One row. `bits` (most, least significant; bit 0 is the highest) picks a field of a shared register; `selector` names
    the feature that indexes it, every `stride` bytes; `pins` are the indices that hold one value for good; `value` is the
    power-up value, for a command the value that executes it; a written float is rounded up to a multiple of its `increment`."""

    name: str
    category: str
    kind: Kind
    value: int | float | str = 0
    access: Literal["RO", "RW", "WO"] = "RW"
    address: int = 0
    length: int = 4
    minimum: int | float = 0
    maximum: int | float = 0xFFFFFFFF
    unit: str = ""
    entries: dict[str, int] = field(default_factory=dict)
    bits: tuple[int, int] | None = None
    selector: str = ""
    count: int = 1
    stride: int = 0
    pins: dict[int, int] = field(default_factory=dict)
    signed: bool = False
    increment: float = 0.0

    @property
    def step(self) -> int:
        """From one index' register to the next one's."""
        return self.stride or self.length


def _switch(*names: str) -> dict[str, int]:
    return {name: number for number, name in enumerate(names)}


OFF_ON = _switch("Off", "On")
AUTO = _switch("Off", "Once", "Continuous")
TRIGGER_SOURCES = _switch("Software", "Line0", "Line1", "Line3", "Action0", "Action1")
ACTIVATIONS = _switch("RisingEdge", "FallingEdge", "AnyEdge")
LINE_MODES = _switch("Input", "Output")
SERVO_STATES = _switch("Unknown", "Locked", "Disabled")
LINE_SOURCES = _switch("Off", "AcquisitionActive", "FrameTriggerWait", "FrameActive", "ExposureActive")
PTP_STATES = _switch("Initializing", "Faulty", "Disabled", "Listening", "PreMaster", "Master", "Passive", "Uncalibrated",
                     "Slave")


def table(width: int, height: int, serial: str) -> list[Feature]:
    """All features of a camera of that size, addresses filled in."""
    return _placed([*_device(serial), *_image(width, height), *_acquisition(), *_lines(), *_transport(width, height), *_time()])


def _device(serial: str) -> list[Feature]:
    device, action = "DeviceControl", "ActionControl"
    return [
        Feature("DeviceVendorName", device, "string", VENDOR, "RO", 0x48, 32),
        Feature("DeviceModelName", device, "string", MODEL, "RO", 0x68, 32),
        Feature("DeviceFirmwareVersion", device, "string", FIRMWARE, "RO", 0x88, 32),
        Feature("DeviceManufacturerInfo", device, "string", "simulated by binpick", "RO", 0xA8, 48),
        Feature("DeviceSerialNumber", device, "string", serial, "RO", 0xD8, 16),
        Feature("DeviceUserID", device, "string", "", "RW", 0xE8, 16),
        Feature("DeviceReset", device, "command", 1, "WO"),
        Feature("DeviceLinkSpeed", device, "integer", LINK_BYTES_PER_S, "RO", unit="B/s"),
        Feature("DeviceLinkThroughputLimitMode", device, "enumeration", 1, entries=OFF_ON),
        Feature("DeviceLinkThroughputLimit", device, "integer", LINK_BYTES_PER_S, minimum=32_375_000,
                maximum=LINK_BYTES_PER_S, unit="B/s"),
        Feature("ActionDeviceKey", action, "integer", 0, address=0x90C),
        Feature("ActionSelector", action, "integer", 0, maximum=SIGNALS - 1),
        Feature("ActionGroupKey", action, "integer", 0, address=0x9800, selector="ActionSelector", count=SIGNALS, stride=16),
        Feature("ActionGroupMask", action, "integer", 0, address=0x9804, selector="ActionSelector", count=SIGNALS, stride=16),
    ]


def _image(width: int, height: int) -> list[Feature]:
    image = "ImageFormatControl"
    fixed = {"SensorWidth": width, "SensorHeight": height, "Width": width, "Height": height, "OffsetX": 0, "OffsetY": 0}
    return [*(Feature(name, image, "integer", value, "RO", unit="px") for name, value in fixed.items()),
            Feature("PixelFormat", image, "enumeration", MONO8, entries=FORMATS)]


def _acquisition() -> list[Feature]:
    acquire, analog = "AcquisitionControl", "AnalogControl"
    longest_us, highest_db = 10_000_000, 24
    return [
        Feature("AcquisitionMode", acquire, "enumeration", 2, entries=_switch("SingleFrame", "MultiFrame", "Continuous")),
        Feature("AcquisitionStart", acquire, "command", 1, "WO"),
        Feature("AcquisitionStop", acquire, "command", 1, "WO"),
        Feature("AcquisitionFrameCount", acquire, "integer", 1, minimum=1, maximum=65535),
        Feature("AcquisitionFrameRateEnable", acquire, "boolean", 1),
        Feature("AcquisitionFrameRate", acquire, "float", 10.0, length=8, minimum=0.1, maximum=50.0, unit="Hz"),
        Feature("TriggerSelector", acquire, "enumeration", 0, entries=_switch("FrameStart")),
        Feature("TriggerMode", acquire, "enumeration", 0, entries=OFF_ON),
        Feature("TriggerSource", acquire, "enumeration", 0, entries=TRIGGER_SOURCES),
        Feature("TriggerActivation", acquire, "enumeration", 0, entries=ACTIVATIONS),
        Feature("TriggerSoftware", acquire, "command", 1, "WO"),
        Feature("ExposureMode", acquire, "enumeration", 0, entries=_switch("Timed")),
        Feature("ExposureAuto", acquire, "enumeration", 0, entries=AUTO),
        Feature("ExposureAutoMin", acquire, "float", 20.0, length=8, minimum=20, maximum=longest_us, unit="us"),
        Feature("ExposureAutoMax", acquire, "float", 100_000.0, length=8, minimum=20, maximum=longest_us, unit="us"),
        Feature("ExposureTime", acquire, "float", 5000.0, length=8, minimum=20, maximum=longest_us, unit="us"),
        Feature("GainAuto", analog, "enumeration", 0, entries=AUTO),
        Feature("GainAutoMin", analog, "float", 0.0, length=8, minimum=0, maximum=highest_db, unit="dB"),
        Feature("GainAutoMax", analog, "float", 24.0, length=8, minimum=0, maximum=highest_db, unit="dB"),
        Feature("Gain", analog, "float", 0.0, length=8, minimum=0, maximum=highest_db, unit="dB"),
    ]


def _lines() -> list[Feature]:
    line = "DigitalIOControl"
    return [
        Feature("LineSelector", line, "enumeration", 0, entries=_switch(*(f"Line{number}" for number in range(LINES)))),
        # the opto-isolated ones cannot turn round
        Feature("LineMode", line, "enumeration", LINE_MODES["Input"], entries=LINE_MODES, selector="LineSelector", count=LINES,
                pins={2: LINE_MODES["Output"], 3: LINE_MODES["Input"]}),
        Feature("LineSource", line, "enumeration", 0, entries=LINE_SOURCES, selector="LineSelector", count=LINES),
        Feature("LineInverter", line, "boolean", 0, selector="LineSelector", count=LINES),
    ]


def _transport(width: int, height: int) -> list[Feature]:
    network = "TransportLayerControl"
    return [
        Feature("PayloadSize", network, "integer", width * height, "RO", unit="B"),
        Feature("GevHeartbeatTimeout", network, "integer", 3000, "RW", 0x938, minimum=500, maximum=60000, unit="ms"),
        Feature("GevCCP", network, "integer", 0, "RW", 0xA00, maximum=3),
        Feature("GevSCPHostPort", network, "integer", 0, "RW", 0xD00, bits=(16, 31)),
        Feature("GevSCPSFireTestPacket", network, "boolean", 0, "RW", 0xD04, bits=(0, 0)),
        Feature("GevSCPSDoNotFragment", network, "boolean", 0, "RW", 0xD04, bits=(1, 1)),
        Feature("GevSCPSPacketSize", network, "integer", 1500, "RW", 0xD04, minimum=576, maximum=16000, unit="B",
                bits=(16, 31)),
        Feature("GevSCPD", network, "integer", 0, "RW", 0xD08),
        Feature("GevSCDA", network, "integer", 0, "RW", 0xD18),
        Feature("GevSCSP", network, "integer", 0, "RO", 0xD1C),
    ]


def _time() -> list[Feature]:
    time, network = "DeviceControl", "TransportLayerControl"
    return [
        Feature("TimestampLatch", time, "command", 1, "WO"),
        Feature("TimestampReset", time, "command", 1, "WO"),
        Feature("TimestampLatchValue", time, "integer", 0, "RO", length=8, unit="ns"),
        Feature("GevTimestampTickFrequency", network, "integer", 1_000_000_000, "RO", 0x93C, 8, unit="Hz"),
        Feature("GevTimestampControlLatch", network, "command", 2, "WO", 0x944),
        Feature("GevTimestampValue", network, "integer", 0, "RO", 0x948, 8),
        Feature("PtpEnable", network, "boolean", 0),
        Feature("PtpStatus", network, "enumeration", PTP_STATES["Disabled"], "RO", entries=PTP_STATES),
        Feature("PtpServoStatus", network, "enumeration", 0, "RO", entries=SERVO_STATES),
        Feature("PtpDataSetLatch", network, "command", 1, "WO"),
        Feature("PtpOffsetFromMaster", network, "integer", 0, "RO", length=8, unit="ns", signed=True),
        Feature("PtpClockID", network, "integer", 0, "RO", length=8),
        Feature("PtpGrandmasterClockID", network, "integer", 0, "RO", length=8),
    ]


def _placed(rows: list[Feature]) -> list[Feature]:
    placed, address = [], FEATURE_BASE
    for row in rows:
        if row.address:
            placed.append(row)
        else:
            placed.append(replace(row, address=address))
            address += -(-row.step * row.count // 8) * 8
    return placed
