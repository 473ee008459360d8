"""What was seen of a host at one moment: its network ports, routes, limits, clocks and processors."""

from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Network


@dataclass(frozen=True, slots=True)
class Port:
    """A network interface. None: the kernel does not say."""

    name: str
    mtu: int
    up: bool | None = None
    """The link is there: a cable, with something alive at its other end."""
    speed_mbps: int | None = None
    rp_filter: int = 0
    """Its own reverse path filter: 0 none, 1 strict, 2 loose; the larger of it and the host's counts."""
    rx_ring: tuple[int, int] | None = None
    """Receive descriptors, now and at most."""
    physical: bool = False
    """A socket for a cable: no bridge, tunnel or radio."""


@dataclass(frozen=True, slots=True)
class Route:
    """A row of the main IPv4 routing table; `gateway` is empty for a subnet that the port itself is in."""

    port: str
    network: str
    gateway: str = ""
    metric: int = 0


@dataclass(frozen=True, slots=True)
class Host:
    """Everything that `judge` reads. None: the kernel does not say, or not to this user."""

    ports: tuple[Port, ...] = ()
    routes: tuple[Route, ...] = ()
    rmem_max: int | None = None
    rmem_default: int | None = None
    netdev_max_backlog: int | None = None
    rp_filter: int = 0
    """Of all ports."""
    firewall: str | None = None
    """Empty: nothing drops by policy. Else who does: "ufw", "firewalld", "iptables", or the family, table and chain of nft."""
    clocksource: str = ""
    synchronised: bool | None = None
    """CLOCK_REALTIME is disciplined by NTP or PTP."""
    ptp_ports: tuple[str, ...] = ()
    """The ports that a running ptp4l serves."""
    cpus: int = 1
    governors: tuple[str, ...] = ()
    """The distinct frequency governors of the processors; empty: the kernel does not set their frequency."""
    kernel: str = ""

    def port(self, name: str) -> Port | None:
        """The port of that name."""
        return next((port for port in self.ports if port.name == name), None)

    def way(self, address: str) -> Route | None:
        """The route to an IPv4 address, as the kernel would choose it from the main table. Raises ValueError: it is none."""
        target = IPv4Address(address)
        if target.is_loopback:
            return Route("lo", "127.0.0.0/8")
        fitting = [route for route in self.routes if target in IPv4Network(route.network)]
        return max(fitting, key=lambda route: (IPv4Network(route.network).prefixlen, -route.metric), default=None)
