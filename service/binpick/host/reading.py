"""Reads a host's snapshot from the files below /proc and /sys."""

import itertools
import os
from collections.abc import Iterator
from ipaddress import IPv4Address, IPv4Network
from pathlib import Path

from binpick.host.snapshot import Host, Port, Route

UP = 0x1
GATEWAY = 0x2
REJECT = 0x200
"""Flags of a route (linux/route.h)."""


def read(root: Path = Path("/")) -> Host:
    """What the files below `root` say; what only system calls know (rings, firewall, synchronisation) stays None."""
    sysctl = root / "proc/sys/net"
    return Host(
        ports=tuple(_ports(root)), routes=tuple(_routes(root / "proc/net/route")),
        rmem_max=_number(sysctl / "core/rmem_max"), rmem_default=_number(sysctl / "core/rmem_default"),
        netdev_max_backlog=_number(sysctl / "core/netdev_max_backlog"),
        rp_filter=_number(sysctl / "ipv4/conf/all/rp_filter") or 0,
        clocksource=_text(root / "sys/devices/system/clocksource/clocksource0/current_clocksource"),
        ptp_ports=tuple(sorted(set(_ptp_ports(root)))), cpus=_cpus(root),
        governors=tuple(sorted({_text(path) for path in (root / "sys/devices/system/cpu").glob(
            "cpu[0-9]*/cpufreq/scaling_governor")} - {""})),
        kernel=_text(root / "proc/sys/kernel/osrelease"))


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:      # not there, not for this user, or, as a link's speed, not known just now
        return ""


def _number(path: Path) -> int | None:
    try:
        return int(_text(path))
    except ValueError:
        return None


def _ports(root: Path) -> Iterator[Port]:
    folder = root / "sys/class/net"
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        mtu = _number(path / "mtu")
        if mtu is None:          # a file such as bonding_masters
            continue
        speed, carrier = _number(path / "speed"), _number(path / "carrier")
        yield Port(name=path.name, mtu=mtu, up=bool(carrier) if carrier is not None else _text(path / "operstate") == "up",
                   speed_mbps=speed if speed is not None and speed > 0 else None,
                   rp_filter=_number(root / "proc/sys/net/ipv4/conf" / path.name / "rp_filter") or 0,
                   physical=(path / "device").exists() and not (path / "phy80211").exists())


def _routes(path: Path) -> Iterator[Route]:
    """Columns: port, destination, gateway, flags, references, uses, metric, mask; addresses in hex, lowest byte first."""
    for line in _text(path).splitlines()[1:]:
        name, destination, gateway, flags, _references, _uses, metric, mask = line.split()[:8]
        if int(flags, 16) & UP and not int(flags, 16) & REJECT:
            yield Route(name, str(IPv4Network(f"{_address(destination)}/{_address(mask)}")),
                        str(_address(gateway)) if int(flags, 16) & GATEWAY else "", int(metric))


def _address(word: str) -> IPv4Address:
    return IPv4Address(bytes.fromhex(word)[::-1])


def _ptp_ports(root: Path) -> Iterator[str]:
    """What the running ptp4l were told by `-i`, or by the sections of the file after `-f`."""
    for command in (root / "proc").glob("[0-9]*/cmdline"):
        words = _text(command).split("\0")
        if Path(words[0]).name != "ptp4l":
            continue
        for option, value in itertools.pairwise(words):
            if option == "-i":
                yield value
            elif option == "-f":
                sections = (line.strip() for line in _text(root / value.lstrip("/")).splitlines())
                yield from (line[1:-1] for line in sections if line.startswith("[") and line not in ("[global]", "[unicast]"))
        yield from (word[2:] for word in words if word.startswith("-i") and len(word) > 2)


def _cpus(root: Path) -> int:
    """The processors that this process may use; of another root, those that are there."""
    if root == Path("/"):
        return len(os.sched_getaffinity(0))
    return max(1, len(list((root / "sys/devices/system/cpu").glob("cpu[0-9]*"))))
