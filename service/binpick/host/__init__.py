"""The machine that the daemon runs on: what the kernel says of it, and what of that would cost images."""

from binpick.host.finding import Finding
from binpick.host.findings import judge
from binpick.host.kernel import look
from binpick.host.reading import read
from binpick.host.snapshot import Host, Port, Route

__all__ = ["Finding", "Host", "Port", "Route", "judge", "look", "read"]
