"""Faults by name: what can be done to simulated cameras in words such as `loss=0.05@left`, from tests and from a shell."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

from binpick.camera.base import NAMES
from binpick.errors import InputError
from binpick.sim.gige.clock import host_ns
from binpick.sim.gige.conditions import Conditions
from binpick.sim.gige.features import PTP_STATES
from binpick.sim.gige.group import REBOOT_S, GigeGroup
from binpick.sim.gige.pixels import FORMATS

Deed = Callable[[GigeGroup, int, Any], None]


@dataclass(frozen=True, slots=True)
class Sort:
    """One kind of fault: how its value reads, what it does to a head, and what the help says."""

    read: Callable[[str], Any]
    do: Deed
    says: str


@dataclass(frozen=True, slots=True)
class Fault:
    """`head` None: all of them."""

    name: str
    value: Any
    head: int | None


def _share(text: str) -> float:
    if not 0 <= (share := float(text)) <= 1:
        raise ValueError("a share is between 0 and 1")
    return share


def _amount(text: str) -> float:
    if not 0 <= (amount := float(text)) < float("inf"):
        raise ValueError("not negative")
    return amount


def _rate(text: str) -> float:
    if not (rate := _amount(text)):
        raise ValueError("more than 0")
    return rate


def _count(text: str) -> int:
    if (count := int(text)) < 0:
        raise ValueError("not negative")
    return count


def _switch(text: str) -> bool:
    if text not in ("", "on", "off"):
        raise ValueError("on or off")
    return text != "off"


def _one_of(names: Any) -> Callable[[str], str]:
    def read(text: str) -> str:
        if text not in names and text != "off":
            raise ValueError(f"one of {', '.join(names)}, off")
        return "" if text == "off" else text
    return read


def _transit(field: str) -> Deed:
    return lambda group, head, value: group.change(
        head, transit=replace(group.conditions(head).transit, **{field: value}))


def _condition(field: str, *, inverse: bool = False) -> Deed:
    return lambda group, head, value: group.change(head, **{field: not value if inverse else value})


def _power(group: GigeGroup, head: int, on: bool) -> None:
    if not on:
        group.kill(head)
    elif not group.powered(head):
        group.restart(head)


def _clear(group: GigeGroup, head: int, _value: Any) -> None:
    _power(group, head, True)
    well = Conditions()
    group.change(head, **{field.name: getattr(well, field.name) for field in fields(well)})
    group.ptp.mend(head, host_ns())
    if group.stolen(head):
        group.steal(head, False)


FAULTS = {
    "loss": Sort(_share, _transit("loss"), "SHARE of the image packets is lost, 0 to 1"),
    "duplicate": Sort(_share, _transit("duplicate"), "SHARE of the packets comes twice"),
    "reorder": Sort(_share, _transit("reorder"), "SHARE of the packets is overtaken by up to eight others"),
    "late": Sort(_share, _transit("late"), "SHARE of the packets comes after its image's end"),
    "late_ms": Sort(_amount, _transit("late_ms"), "MILLISECONDS after it, 10 at first"),
    "resends": Sort(_switch, _transit("resends"), "off: no packet is sent again"),
    "seed": Sort(_count, _condition("seed"), "NUMBER from which chance begins anew"),
    "link": Sort(_rate, _condition("link_mbps"), "MBIT/S that the wire carries"),
    "mtu": Sort(_count, _condition("mtu"), "BYTES of the largest packet that gets through"),
    "skew": Sort(_amount, _condition("skew_us"), "MICROSECONDS that it exposes later than triggered"),
    "early_leader": Sort(_switch, _condition("early_leader"), "images are announced when their exposure begins"),
    "pixel_format": Sort(_one_of(FORMATS), _condition("pixel_format"), "NAME of the format that it sends, whatever it is told"),
    "mute": Sort(_switch, _condition("sends", inverse=True), "answers, but sends no images"),
    "freeze": Sort(_switch, lambda group, head, on: group.change(head, sends=not on, answers=not on),
                   "neither answers nor sends nor takes triggers"),
    "unplug": Sort(_switch, _condition("plugged", inverse=True), "its network cable is out; off: in again"),
    "wire": Sort(_switch, _condition("wired"), "off: the trigger wire to it is broken"),
    "power": Sort(_switch, _power, "off: it has none; on: it starts with default settings"),
    "reboot": Sort(lambda text: _amount(text) if text else REBOOT_S, lambda group, head, s: group.reboot(head, s),
                   "SECONDS until it is back, with default settings"),
    "stolen": Sort(_switch, lambda group, head, on: group.steal(head, on), "another program controls it; off: lets go"),
    "misfire": Sort(_switch, lambda group, head, _: group.misfire(head), "exposes once without a trigger"),
    "ptp": Sort(_one_of(PTP_STATES), lambda group, head, state: group.ptp.force(head, state, host_ns()),
                "STATE that its PTP is stuck in, such as Faulty or Listening; off: it begins again"),
    "ptp_offset": Sort(_amount, lambda group, head, ns: group.ptp.stray(head, int(ns), host_ns()),
                       "NANOSECONDS that it is off its master without knowing"),
    "apart": Sort(_switch, lambda group, head, on: group.ptp.move(head, head if on else 0, host_ns()),
                  "its network port hears no other's PTP"),
    "clear": Sort(_switch, _clear, "ends every fault, and gives it power"),
}


def parse(text: str, heads: int = len(NAMES)) -> Fault:
    """`NAME[=VALUE][@HEAD]`; without a head it besets all. Raises InputError that says what there is."""
    rest, _, head = text.partition("@")
    name, _, value = rest.partition("=")
    if name not in FAULTS:
        raise InputError(f"no fault {name!r}: there are {', '.join(FAULTS)}")
    if head and head not in NAMES[:heads]:
        raise InputError(f"{text}: no camera {head!r}: there are {', '.join(NAMES[:heads])}")
    try:
        return Fault(name, FAULTS[name].read(value), NAMES.index(head) if head else None)
    except ValueError as error:
        raise InputError(f"{text}: {name} takes {FAULTS[name].says} ({error})") from None


def apply(group: GigeGroup, fault: Fault) -> None:
    """Now. Raises InputError when a head is asked for what it cannot without power."""
    for head in group.heads if fault.head is None else [fault.head]:
        try:
            FAULTS[fault.name].do(group, head, fault.value)
        except KeyError:
            raise InputError(f"camera {NAMES[head]} has no power: {fault.name} means nothing to it") from None


def manual() -> str:
    """One line for each."""
    return "\n".join(f"{name:<13} {sort.says}" for name, sort in FAULTS.items())
