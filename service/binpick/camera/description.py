"""What a camera says of itself to somebody who only looks: how it was found, its features, its GenICam description."""

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Found:
    """A camera that answered a broadcast. `address` may be one that this host has no way to."""

    address: str
    serial: str
    model: str
    vendor: str
    mac: str


@dataclass(frozen=True, slots=True)
class Feature:
    """One GenICam feature, read as it stands: where a selector picks among several, the one it points at.

    `access` is RO, WO or RW, with " locked" when the camera takes no writing just now, or "-" for one that it does not have.
    Limits are empty for what has none. `trouble` says why there is no value.
    """

    name: str
    category: str
    kind: str
    access: str
    value: str = ""
    unit: str = ""
    minimum: str = ""
    maximum: str = ""
    step: str = ""
    entries: tuple[str, ...] = ()
    trouble: str = ""

    @property
    def shown(self) -> str:
        """The value with its unit, or why there is none."""
        return f"({self.trouble})" if self.trouble else f"{self.value} {self.unit}".strip()

    @property
    def range(self) -> str:
        """What may be written, in one line; empty for what is only read."""
        if not self.access.startswith("RW"):
            return ""
        if self.entries:
            return " | ".join(self.entries)
        if not self.minimum and not self.maximum:
            return ""
        return f"{self.minimum} to {self.maximum}" + (f" by {self.step}" if self.step not in ("", "1") else "")


@dataclass(frozen=True, slots=True)
class Description:
    """Everything that can be read of one camera."""

    address: str
    genicam_xml: bytes = field(repr=False)
    features: tuple[Feature, ...]
    registers: dict[str, str]
    """GigE Vision's own, address and content in hexadecimal."""
    controlled: bool
    """By another program, at that moment."""

    def value(self, name: str) -> str:
        """The value of a feature; empty: it has none of that name."""
        return next((feature.value for feature in self.features if feature.name == name), "")
