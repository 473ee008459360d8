"""The camera's features: one table, from which the registers and the GenICam description are both made.

Names and enumerations follow the Standard Features Naming Convention as an Allied Vision Alvium uses it; the addresses of
bootstrap registers are those of GigE Vision 1.2, all others are handed out in the table's order.
"""

import xml.etree.ElementTree as Xml
from dataclasses import dataclass, field, replace
from typing import Literal

FEATURE_BASE = 0xA000
XML_BASE = 0x20000
MONO8 = 0x01080001
FIRMWARE = "binpick-sim 1.0"
VENDOR = "Allied Vision"
MODEL = "Alvium G1-240m"
GVSP_OVERHEAD = 36
"""Bytes of IP, UDP and GVSP headers that count as part of GevSCPSPacketSize."""

Kind = Literal["integer", "float", "enumeration", "command", "string", "boolean"]


@dataclass(frozen=True, slots=True)
class Feature:
    """One row. `bits` (most, least significant; bit 0 is the highest) picks a field of a shared register; `selector` names
    the enumeration that indexes it; `value` is the power-up value, for a command the value that executes it."""

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


def _switch(*names: str) -> dict[str, int]:
    return {name: number for number, name in enumerate(names)}


OFF_ON = _switch("Off", "On")
AUTO = _switch("Off", "Once", "Continuous")
LINE_SOURCES = _switch("Off", "AcquisitionActive", "FrameTriggerWait", "FrameActive", "ExposureActive")
PTP_STATES = _switch("Initializing", "Faulty", "Disabled", "Listening", "PreMaster", "Master", "Passive", "Uncalibrated",
                     "Slave")


def table(width: int, height: int, serial: str) -> list[Feature]:
    """All features of a camera of that size, addresses filled in."""
    device, image, acquire, analog, line, network = (
        "DeviceControl", "ImageFormatControl", "AcquisitionControl", "AnalogControl", "DigitalIOControl",
        "TransportLayerControl")
    rows = [
        Feature("DeviceVendorName", device, "string", VENDOR, "RO", 0x48, 32),
        Feature("DeviceModelName", device, "string", MODEL, "RO", 0x68, 32),
        Feature("DeviceFirmwareVersion", device, "string", FIRMWARE, "RO", 0x88, 32),
        Feature("DeviceManufacturerInfo", device, "string", "simulated by binpick", "RO", 0xA8, 48),
        Feature("DeviceSerialNumber", device, "string", serial, "RO", 0xD8, 16),
        Feature("DeviceUserID", device, "string", "", "RW", 0xE8, 16),
        Feature("SensorWidth", image, "integer", width, "RO", unit="px"),
        Feature("SensorHeight", image, "integer", height, "RO", unit="px"),
        Feature("Width", image, "integer", width, "RO", unit="px"),
        Feature("Height", image, "integer", height, "RO", unit="px"),
        Feature("OffsetX", image, "integer", 0, "RO", unit="px"),
        Feature("OffsetY", image, "integer", 0, "RO", unit="px"),
        Feature("PixelFormat", image, "enumeration", MONO8, entries={"Mono8": MONO8}),
        Feature("AcquisitionMode", acquire, "enumeration", 0, entries=_switch("Continuous")),
        Feature("AcquisitionStart", acquire, "command", 1, "WO"),
        Feature("AcquisitionStop", acquire, "command", 1, "WO"),
        Feature("TriggerSelector", acquire, "enumeration", 0, entries=_switch("FrameStart")),
        Feature("TriggerMode", acquire, "enumeration", 0, entries=OFF_ON),
        Feature("TriggerSource", acquire, "enumeration", 0, entries=_switch("Software")),
        Feature("TriggerActivation", acquire, "enumeration", 0, entries=_switch("RisingEdge")),
        Feature("TriggerSoftware", acquire, "command", 1, "WO"),
        Feature("ExposureMode", acquire, "enumeration", 0, entries=_switch("Timed")),
        Feature("ExposureAuto", acquire, "enumeration", 0, entries=AUTO),
        Feature("ExposureTime", acquire, "float", 5000.0, length=8, minimum=20, maximum=10_000_000, unit="us"),
        Feature("GainAuto", analog, "enumeration", 0, entries=AUTO),
        Feature("Gain", analog, "float", 0.0, length=8, minimum=0, maximum=24, unit="dB"),
        Feature("LineSelector", line, "enumeration", 0, entries=_switch("Line0", "Line1", "Line2", "Line3")),
        Feature("LineSource", line, "enumeration", 0, entries=LINE_SOURCES, selector="LineSelector", count=4),
        Feature("PayloadSize", network, "integer", width * height, "RO", unit="B"),
        Feature("GevTimestampTickFrequency", network, "integer", 1_000_000_000, "RO", 0x93C, 8, unit="Hz"),
        Feature("GevTimestampControlLatch", network, "command", 2, "WO", 0x944),
        Feature("GevTimestampValue", network, "integer", 0, "RO", 0x948, 8),
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
        Feature("PtpEnable", network, "boolean", 0),
        Feature("PtpStatus", network, "enumeration", PTP_STATES["Disabled"], "RO", entries=PTP_STATES),
    ]
    return _placed(rows)


def _placed(rows: list[Feature]) -> list[Feature]:
    placed, address = [], FEATURE_BASE
    for row in rows:
        if row.address:
            placed.append(row)
        else:
            placed.append(replace(row, address=address))
            address += -(-row.length * row.count // 8) * 8
    return placed


def description(features: list[Feature]) -> bytes:
    """The GenICam XML (schema 1.1) of the table."""
    root = Xml.Element("RegisterDescription", {
        "ModelName": MODEL.replace(" ", "_").replace("-", "_"), "VendorName": VENDOR.replace(" ", "_"),
        "StandardNameSpace": "GEV", "SchemaMajorVersion": "1", "SchemaMinorVersion": "1", "SchemaSubMinorVersion": "0",
        "MajorVersion": "1", "MinorVersion": "0", "SubMinorVersion": "0", "ToolTip": "Simulated camera",
        "ProductGuid": "6b1c0d5e-8f4e-4d52-9d3b-b1b1c4000001", "VersionGuid": "6b1c0d5e-8f4e-4d52-9d3b-b1b1c4000002",
        "xmlns": "http://www.genicam.org/GenApi/Version_1_1"})
    categories = list(dict.fromkeys(f.category for f in features))
    _category(root, "Root", categories)
    for name in categories:
        _category(root, name, [f.name for f in features if f.category == name])
    selected = {f.selector: [g.name for g in features if g.selector == f.selector] for f in features if f.selector}
    for feature in features:
        _node(root, feature, selected.get(feature.name, []))
    Xml.SubElement(root, "Port", {"Name": "Device", "NameSpace": "Standard"})
    return b'<?xml version="1.0" encoding="utf-8"?>\n' + Xml.tostring(root)


def _category(root: Xml.Element, name: str, members: list[str]) -> None:
    category = Xml.SubElement(root, "Category", {"Name": name, "NameSpace": "Standard"})
    for member in members:
        _leaf(category, "pFeature", member)


def _leaf(parent: Xml.Element, tag: str, text: object) -> None:
    Xml.SubElement(parent, tag).text = str(text)


def _node(root: Xml.Element, feature: Feature, selected: list[str]) -> None:
    if feature.kind == "string":
        _register(root, "StringReg", feature.name, feature)
        return
    register = f"{feature.name}Register"
    node = Xml.SubElement(root, feature.kind.capitalize(), {"Name": feature.name, "NameSpace": "Standard"})
    for entry, number in feature.entries.items():
        _leaf(Xml.SubElement(node, "EnumEntry", {"Name": entry, "NameSpace": "Standard"}), "Value", number)
    _leaf(node, "pValue", register)
    if feature.kind in ("integer", "float"):
        if feature.access != "RO":
            _leaf(node, "Min", feature.minimum)
            _leaf(node, "Max", feature.maximum)
        if feature.unit:
            _leaf(node, "Unit", feature.unit)
    if feature.kind == "command":
        _leaf(node, "CommandValue", feature.value)
    if feature.kind == "boolean":
        _leaf(node, "OnValue", 1)
        _leaf(node, "OffValue", 0)
    for name in selected:
        _leaf(node, "pSelected", name)
    tag = "FloatReg" if feature.kind == "float" else "MaskedIntReg" if feature.bits else "IntReg"
    _register(root, tag, register, feature)


def _register(root: Xml.Element, tag: str, name: str, feature: Feature) -> None:
    node = Xml.SubElement(root, tag, {"Name": name, "NameSpace": "Custom"})
    _leaf(node, "Address", hex(feature.address))
    if feature.selector:
        index = Xml.SubElement(node, "pIndex", {"Offset": str(feature.length)})
        index.text = f"{feature.selector}Register"
    _leaf(node, "Length", feature.length)
    _leaf(node, "AccessMode", feature.access)
    _leaf(node, "pPort", "Device")
    if feature.kind != "string":
        # what the camera changes by itself must not be read from a cache
        _leaf(node, "Cachable", "WriteThrough" if feature.access == "RW" and not feature.bits else "NoCache")
    if feature.bits and feature.bits[0] == feature.bits[1]:
        _leaf(node, "Bit", feature.bits[0])
    elif feature.bits:
        _leaf(node, "LSB", feature.bits[1])
        _leaf(node, "MSB", feature.bits[0])
    if tag != "StringReg":
        if tag != "FloatReg":
            _leaf(node, "Sign", "Unsigned")
        _leaf(node, "Endianess", "BigEndian")
