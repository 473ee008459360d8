"""Does a camera answer, and who controls it? Asked by datagrams: it is not opened, and costs none of a driver's seconds."""

from ipaddress import IPv4Address

from binpick.camera import gvcp

CONTROLLER_ADDRESS = bytes.fromhex("00000a14")
"""READREG's payload for a register that many cameras do not have."""


def answers(address: str) -> bool:
    """Within 0.45 s; False also when the address is none or cannot be reached."""
    return gvcp.ask(address, gvcp.DISCOVERY) is not None


def controller(address: str) -> str | None:
    """"" when it is free, the controller's IPv4 address or "another program" when it is not, None: it does not answer."""
    privilege = gvcp.ask(address, gvcp.READREG, gvcp.PRIVILEGE)
    if privilege is None:
        return None
    if not privilege.held:
        return ""
    told = gvcp.ask(address, gvcp.READREG, CONTROLLER_ADDRESS)
    return str(IPv4Address(told.value)) if told is not None and told.value else "another program"
