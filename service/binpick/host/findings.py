"""Judges a host's snapshot: what would cost images, why, and the command that mends it."""

from collections.abc import Iterator, Sequence
from ipaddress import IPv4Address

from binpick.host import network
from binpick.host.finding import Finding, sysctl
from binpick.host.snapshot import Host

SOCKET_BUFFER_BYTES = 8 << 20
"""What the camera's driver asks the kernel for; it gets no more than net.core.rmem_max."""
FRAME_BYTES = 1936 * 1216
BACKLOG_PACKETS = 5000
"""A pair of images is 3200 packets of 1500 bytes."""
GOOD_CLOCKS = ("tsc", "arch_sys_counter", "kvm-clock", "hyperv_clocksource_tsc_page")
"""Read without a system call, in tens of nanoseconds."""


def judge(host: Host, cameras: Sequence[tuple[str, str]], packet_size: int) -> list[Finding]:
    """Findings about the way to each camera (name, IPv4 address or empty), then about the machine.

    `packet_size` is the GVSP packet size with its IP header, bytes; 0: as large as arrives. Loopback cameras need no network.
    """
    return [*network.judge(host, cameras, packet_size), *_socket_buffer(host), *_backlog(host),
            *_firewall(host, [address for _, address in cameras if _remote(address)]), *_clock(host), *_processors(host)]


def _remote(address: str) -> bool:
    """An address, and not one of this host's own: loopback passes every firewall."""
    try:
        return not IPv4Address(address).is_loopback
    except ValueError:
        return False


def _socket_buffer(host: Host) -> Iterator[Finding]:
    what, most = "receive buffer", host.rmem_max
    if most is None:
        yield Finding(what, "unknown", "net.core.rmem_max cannot be read")
        return
    default = f", rmem_default {host.rmem_default / 1e6:.2g} MB (not used)" if host.rmem_default is not None else ""
    seen = f"net.core.rmem_max {most / 1e6:.2g} MB{default}"
    if most >= SOCKET_BUFFER_BYTES:
        yield Finding(what, "ok", seen)
        return
    small = most < FRAME_BYTES
    reason = "an image does not fit: packets are lost whenever this machine is busy" if small else \
        "less than three images: packets are lost when this machine is held up"
    yield Finding(what, "fail" if small else "warn", seen, reason, sysctl("net.core.rmem_max", 33554432))


def _backlog(host: Host) -> Iterator[Finding]:
    what, packets = "packet backlog", host.netdev_max_backlog
    if packets is None:
        yield Finding(what, "unknown", "net.core.netdev_max_backlog cannot be read")
        return
    seen = f"net.core.netdev_max_backlog {packets}"
    if packets >= BACKLOG_PACKETS:
        yield Finding(what, "ok", seen)
    else:
        yield Finding(what, "warn", seen, "both cameras send at once; what does not fit is dropped",
                      sysctl("net.core.netdev_max_backlog", BACKLOG_PACKETS))


def _firewall(host: Host, addresses: Sequence[str]) -> Iterator[Finding]:
    what = "firewall"
    if host.firewall is None:
        yield Finding(what, "unknown", "root alone can read its rules, with nft or iptables",
                      "cameras send UDP to ports that change: it must let in what comes from them; this shows it",
                      "sudo nft list ruleset || sudo iptables -S")
    elif not host.firewall:
        yield Finding(what, "ok", "nothing drops packets by policy")
    else:
        yield Finding(what, "warn", f"{host.firewall} drops what no rule lets in", "cameras send UDP to ports that change: "
                      "unless a rule lets it in, they are not found or send no images", _admit(host.firewall, addresses))


def _admit(firewall: str, addresses: Sequence[str]) -> str:
    if not addresses:
        return ""
    if firewall == "ufw":
        return " && ".join(f"sudo ufw allow proto udp from {address} to any" for address in addresses)
    if firewall == "firewalld":
        sources = " ".join(f"--add-source={address}" for address in addresses)
        return f"sudo firewall-cmd --permanent --zone=trusted {sources} && sudo firewall-cmd --reload"
    if firewall == "iptables":
        return f"sudo iptables -I INPUT -p udp -s {','.join(addresses)} -j ACCEPT"
    return f"sudo nft insert rule {firewall} ip saddr '{{ {', '.join(addresses)} }}' meta l4proto udp accept"


def _clock(host: Host) -> Iterator[Finding]:
    if host.synchronised:
        yield Finding("clock", "ok", "synchronised")
    elif host.synchronised is None:
        yield Finding("clock", "unknown", "the kernel does not say whether it is synchronised")
    else:
        yield Finding("clock", "warn", "not synchronised", "times in results and recordings drift away from those of PLC and "
                      "robot", "sudo apt-get install -y systemd-timesyncd && sudo timedatectl set-ntp true")
    source = host.clocksource or "unknown"
    if source in GOOD_CLOCKS:
        yield Finding("clock source", "ok", source)
    elif source == "unknown":
        yield Finding("clock source", "unknown", "the kernel does not say")
    else:
        yield Finding("clock source", "warn", source, "reading the time takes a system call, and is less even than the "
                      "processor's own counter; the kernel's log says why it gave that up",
                      "sudo dmesg | grep -iE 'tsc|clocksource'")


def _processors(host: Host) -> Iterator[Finding]:
    seen = f"{host.cpus} for this process"
    if host.cpus >= 2:
        yield Finding("processors", "ok", seen)
    else:
        yield Finding("processors", "warn", seen, "receiving images and computing share it: cycles take twice as long, and "
                      "packets are lost meanwhile")
    if not host.governors:
        yield Finding("frequency", "unknown", "the kernel does not set it (a virtual machine, or the firmware does)")
    elif host.governors == ("performance",):
        yield Finding("frequency", "ok", "governor performance")
    else:
        yield Finding("frequency", "warn", f"governor {', '.join(host.governors)}", "the first part of each cycle runs slowly; "
                      "the command holds until the next start",
                      "echo performance | sudo tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor")
