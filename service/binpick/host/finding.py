"""One thing that was looked at on a host, and the command that mends it."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class Finding:
    """fail: images will be missing or incomplete; warn: they may be, under load or some day;
    unknown: it could not be seen. `reason` and `command` (as a user with sudo types it; may stay empty) say what to do."""

    what: str
    level: Literal["ok", "warn", "fail", "unknown"]
    seen: str
    reason: str = ""
    command: str = ""


def sysctl(key: str, value: int) -> str:
    """The command that sets it now and for every start to come."""
    file = f"/etc/sysctl.d/90-binpick-{key.replace('.', '-').replace('/', '-')}.conf"
    return f"echo {key}={value} | sudo tee {file} && sudo sysctl -p {file}"
