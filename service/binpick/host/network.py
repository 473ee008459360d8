"""Judges the way from each camera to this host: route, link, packet size, receive ring, and what two ports share."""

from collections.abc import Iterator, Sequence
from ipaddress import IPv4Network

from binpick.host.finding import Finding, sysctl
from binpick.host.snapshot import Host, Port, Route

CAMERA_MBPS = 1000
JUMBO = 8000
"""An MTU from which large packets are worth their name, bytes."""
RING = 2048
"""Descriptors that hold a pair of images in 1500-byte packets for as long as an interrupt may wait."""
KEPT = "the command holds until the next start; for good: {} in the [Link] section of a file of /etc/systemd/network/*.link"


def judge(host: Host, cameras: Sequence[tuple[str, str]], packet_size: int) -> Iterator[Finding]:
    """As `findings.judge`; the ports follow the cameras that they lead to."""
    ports: dict[str, list[str]] = {}
    offers = Offers(host, [address for _, address in cameras])
    for name, address in cameras:
        route, finding = _way(host, name, address, offers)
        yield finding
        if route is not None and route.port != "lo":
            ports.setdefault(route.port, []).append(name)
    for name, led in ports.items():
        port = host.port(name)
        if port is None:
            yield Finding(f"port {name}", "unknown", "the kernel does not show it (a container without the host's network?)")
        else:
            yield from _port(port, led, packet_size)
    yield from _subnets(host, tuple(ports))
    yield from _ptp(host, tuple(ports))


class Offers:
    """The command that puts a port into a camera's subnet; cameras of one subnet get one port.

    Offered are real ports without any subnet, those with a link first: that is where a camera's subnet probably belongs.
    """

    def __init__(self, host: Host, cameras: Sequence[str]) -> None:
        taken = {route.port for route in host.routes}
        self._ports = iter([port.name for up in (True, False) for port in host.ports
                            if port.physical and bool(port.up) is up and port.name not in taken])
        self._cameras = cameras
        self._made: dict[IPv4Network, str] = {}

    def command(self, address: str) -> str:
        """IFACE stands in it where no port is left to offer."""
        subnet = IPv4Network(f"{address}/24", strict=False)      # the smallest that people use
        if subnet not in self._made:
            beside = next(str(host) for host in subnet.hosts() if str(host) not in self._cameras)
            port = next(self._ports, "IFACE")
            self._made[subnet] = f"sudo ip addr add {beside}/24 dev {port} && sudo ip link set dev {port} up"
        return self._made[subnet]


def _way(host: Host, name: str, address: str, offers: Offers) -> tuple[Route | None, Finding]:
    what = f"way to {name}"
    if not address:
        return None, Finding(what, "unknown", "the cell file gives no address, and no camera of its serial number answers")
    try:
        route = host.way(address)
    except ValueError:
        return None, Finding(what, "fail", address, "that is no IPv4 address: correct it in the cell file")
    if route is not None and not route.gateway:
        return route, Finding(what, "ok", f"{address} by {route.port}")
    seen = f"{address}: no route" if route is None else f"{address} by {route.port}, through the router {route.gateway}"
    command = offers.command(address)
    which = "; IFACE stands for the port's name" if "IFACE" in command else ""
    return None, Finding(what, "fail", seen, "no port of this host is in the camera's subnet: give the one that leads to it "
                         f"an address there{which}; the command holds until the next start, the network's settings for good",
                         command)


def _port(port: Port, led: Sequence[str], packet_size: int) -> Iterator[Finding]:
    what = f"port {port.name}"
    if port.up is False:
        yield Finding(what, "fail", "no link", "check cable, power and the camera's lights",
                      f"sudo ip link set dev {port.name} up")
        return
    if port.speed_mbps is None:
        yield Finding(what, "unknown", "its speed is unknown")
    elif port.speed_mbps < CAMERA_MBPS:
        yield Finding(what, "fail", f"{port.speed_mbps} Mb/s", "the camera sends faster: a bad cable or plug, or an old switch")
    elif len(led) > 1 and port.speed_mbps == CAMERA_MBPS:
        yield Finding(what, "warn", f"{port.speed_mbps} Mb/s for {' and '.join(led)}", "two images share the wire: 38 ms "
                      "instead of 19, and the switch has to hold one of them; a port for each camera is better")
    else:
        yield Finding(what, "ok", f"{port.speed_mbps} Mb/s, leads to {' and '.join(led)}")
    yield _mtu(port, packet_size)
    yield _ring(port)


def _mtu(port: Port, packet_size: int) -> Finding:
    what, seen = f"MTU of {port.name}", f"{port.mtu}, cameras.packet_size {packet_size or 'auto'}"
    wanted = max(9000, packet_size)
    command = f"sudo ip link set dev {port.name} mtu {wanted}"
    if port.mtu < packet_size:
        return Finding(what, "fail", seen, f"packets do not fit: no image comes; {KEPT.format(f'MTUBytes={wanted}')}", command)
    if (packet_size or port.mtu) >= JUMBO:
        return Finding(what, "ok", seen)
    if port.mtu >= JUMBO:
        return Finding(what, "warn", seen, f"set packet_size: {min(port.mtu, 9000)} in the cell file, if any switch between "
                       "allows it: a sixth of the packets, and of the work")
    return Finding(what, "warn", seen, "with 9000, here and as packet_size in the cell file, an image is a sixth of the "
                   "packets; " + KEPT.format("MTUBytes=9000"), command)


def _ring(port: Port) -> Finding:
    what = f"rx ring of {port.name}"
    if port.rx_ring is None:
        return Finding(what, "unknown", "its driver does not say")
    now, most = port.rx_ring
    if now >= min(most, RING):
        return Finding(what, "ok", f"{now} of {most}")
    wanted = min(most, 4096)
    return Finding(what, "warn", f"{now} of {most}", "packets are lost when the processor is late to fetch them; "
                   + KEPT.format(f"RxBufferSize={wanted}"), f"sudo ethtool -G {port.name} rx {wanted}")


def _subnets(host: Host, ports: Sequence[str]) -> Iterator[Finding]:
    """Two ports in one subnet: the kernel sends to both cameras by the first."""
    for route in host.routes:
        sharing = [other.port for other in host.routes if other.network == route.network and not other.gateway]
        if route.gateway or len(set(sharing)) < 2 or route.port != sharing[0] or not set(sharing) & set(ports):
            continue
        names = " and ".join(dict.fromkeys(sharing))
        strict = [name for name in dict.fromkeys(sharing) if _strict(host, name)]
        seen = f"{names} are both in {route.network}"
        better = "give each port a subnet of its own"
        if strict:
            yield Finding("subnets", "fail", f"{seen}; rp_filter of {' and '.join(strict)} is strict",
                          f"what the second camera sends is thrown away: {better}, or let it pass",
                          " && ".join(sysctl(f"net/ipv4/conf/{name}/rp_filter", 2) for name in strict))
        else:
            yield Finding("subnets", "warn", seen, f"this host sends to both by {sharing[0]}, so the camera on the other port "
                          f"is not found: {better}")


def _strict(host: Host, name: str) -> bool:
    port = host.port(name)
    return port is not None and max(port.rp_filter, host.rp_filter) == 1


def _ptp(host: Host, ports: Sequence[str]) -> Iterator[Finding]:
    """Cameras on one port agree on a clock among themselves; on two ports only this host can bring them together."""
    if len(ports) < 2:
        return
    missing = [port for port in ports if port not in host.ptp_ports]
    if not missing:
        yield Finding("PTP", "ok", f"ptp4l serves {' and '.join(ports)}")
        return
    served = " ".join(f"-i {port}" for port in ports)
    yield Finding("PTP", "warn", f"no ptp4l on {' and '.join(missing)}", "each camera is master of its own clock, and their "
                  "time stamps cannot be compared: pairs may be refused as exposed far apart; the command runs until Ctrl-C, "
                  "with the kernel's time stamps (-S)",
                  f"sudo apt-get install -y linuxptp && sudo ptp4l -S -m {served} --priority1=1")
