"""The GenICam description (schema 1.1) of a feature table: the file by which a client finds registers under their names."""

import xml.etree.ElementTree as Xml

from binpick.sim.gige.features import MODEL, VENDOR, Feature


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
        if feature.increment:
            _leaf(node, "Inc", feature.increment)
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
        index = Xml.SubElement(node, "pIndex", {"Offset": str(feature.step)})
        index.text = f"{feature.selector}Register"
    _leaf(node, "Length", feature.length)
    _leaf(node, "AccessMode", feature.access)
    _leaf(node, "pPort", "Device")
    if feature.kind != "string":
        # what the camera changes by itself must not be read from a cache
        settled = feature.access == "RW" and not feature.bits and not feature.increment
        _leaf(node, "Cachable", "WriteThrough" if settled else "NoCache")
    if feature.bits and feature.bits[0] == feature.bits[1]:
        _leaf(node, "Bit", feature.bits[0])
    elif feature.bits:
        _leaf(node, "LSB", feature.bits[1])
        _leaf(node, "MSB", feature.bits[0])
    if tag != "StringReg":
        if tag != "FloatReg":
            _leaf(node, "Sign", "Signed" if feature.signed else "Unsigned")
        _leaf(node, "Endianess", "BigEndian")
