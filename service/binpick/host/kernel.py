"""What of a host no file says: receive rings, the clock's discipline, the firewall."""

import ctypes
import fcntl
import os
import re
import shutil
import socket
import struct
import subprocess
from dataclasses import replace
from pathlib import Path

from binpick.host.reading import read
from binpick.host.snapshot import Host

SIOCETHTOOL = 0x8946
ETHTOOL_GRINGPARAM = 0x10
TIME_ERROR = 5
"""What adjtimex(2) returns for a clock that nothing disciplines."""
TIMEX_BYTES = 512
"""Larger than struct timex on any machine."""
PATHS = os.pathsep.join((os.environ.get("PATH", ""), "/usr/sbin", "/sbin"))
"""A user's PATH often lacks where Debian keeps nft and iptables."""
INPUT_CHAIN = re.compile(r"type filter hook input [^\n]*policy drop")


def look() -> Host:
    """This machine now. Reads only, and needs no rights; a firewall's rules are shown to root alone, else that stays None."""
    seen = read()
    ports = tuple(replace(port, rx_ring=ring(port.name)) for port in seen.ports)
    return replace(seen, ports=ports, synchronised=_synchronised(), firewall=_firewall())


def ring(port: str) -> tuple[int, int] | None:
    """Receive descriptors of a port, now and at most; None: its driver does not say."""
    words = bytearray(struct.pack("9I", ETHTOOL_GRINGPARAM, *[0] * 8))     # struct ethtool_ringparam
    parameters = (ctypes.c_char * len(words)).from_buffer(words)
    request = struct.pack("16sP16x", port.encode()[:15], ctypes.addressof(parameters))
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
            fcntl.ioctl(any_socket, SIOCETHTOOL, request)
    except OSError:
        return None
    _, most, _, _, _, now, *_ = struct.unpack("9I", bytes(parameters))
    return (now, most) if most else None


def _synchronised() -> bool | None:
    timex = (ctypes.c_char * TIMEX_BYTES)()      # all zero: modes 0 only reads
    state = ctypes.CDLL(None).adjtimex(timex)
    return None if state < 0 else bool(state != TIME_ERROR)


def _firewall() -> str | None:
    """As in `Host.firewall`: a look at policies, not at every rule."""
    if "ENABLED=yes" in _file("/etc/ufw/ufw.conf"):
        return "ufw"
    tools = {"nft": ("list", "ruleset"), "iptables": ("-S", "INPUT")}
    paths = {tool: path for tool in tools if (path := shutil.which(tool, path=PATHS))}
    asked = {tool: _output(path, *tools[tool]) for tool, path in paths.items()}
    for tool, rules in asked.items():
        if rules is not None and (found := _dropping(tool, rules)):
            return found
    return "" if any(rules is not None for rules in asked.values()) else None


def _dropping(tool: str, rules: str) -> str:
    if tool == "iptables":
        return "iptables" if "-P INPUT DROP" in rules else ""
    if "table inet firewalld" in rules:          # accepts by policy and rejects by its last rule
        return "firewalld"
    table = chain = ""
    for line in rules.splitlines():
        words = line.split()
        if words[:1] == ["table"]:
            table = f"{words[1]} {words[2]}"
        elif words[:1] == ["chain"]:
            chain = words[1]
        elif INPUT_CHAIN.search(line):
            return f"{table} {chain}"
    return ""


def _file(path: str) -> str:
    try:
        return Path(path).read_text(encoding="utf-8")
    except OSError:
        return ""


def _output(*command: str) -> str | None:
    """None: it does not answer this user."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=5, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None
