"""What is said of a host: each fault from a snapshot that has it, and snapshots from files as the kernel writes them."""

from dataclasses import replace
from pathlib import Path

import pytest

from binpick.camera.aravis import stream
from binpick.host import Finding, Host, Port, Route, findings, judge, kernel, look, read

CAMERAS = (("left", "169.254.1.2"), ("right", "169.254.2.2"))
GOOD = Host(
    ports=tuple(Port(name, 9000, up=True, speed_mbps=1000, rx_ring=(4096, 4096), physical=True) for name in ("eth1", "eth2")),
    routes=(Route("eth1", "169.254.1.0/24"), Route("eth2", "169.254.2.0/24")),
    rmem_max=32 << 20, rmem_default=212992, netdev_max_backlog=5000, firewall="", clocksource="tsc", synchronised=True,
    ptp_ports=("eth1", "eth2"), cpus=4, governors=("performance",))


def wrong(host: Host, cameras: tuple[tuple[str, str], ...] = CAMERAS, packet_size: int = 9000) -> list[Finding]:
    return [finding for finding in judge(host, cameras, packet_size) if finding.level != "ok"]


def port(**changes: object) -> Host:
    """The good host but for its first port."""
    return replace(GOOD, ports=(replace(GOOD.ports[0], **changes), GOOD.ports[1]))


def test_a_host_in_order_has_nothing_to_mend() -> None:
    found = judge(GOOD, CAMERAS, 9000)
    assert [finding.level for finding in found] == ["ok"] * len(found)
    assert [finding.what for finding in found] == [
        "way to left", "way to right", "port eth1", "MTU of eth1", "rx ring of eth1", "port eth2", "MTU of eth2",
        "rx ring of eth2", "PTP", "receive buffer", "packet backlog", "firewall", "clock", "clock source", "processors",
        "frequency"]


@pytest.mark.parametrize(("host", "what", "level", "says", "command"), [
    (port(mtu=1500), "MTU of eth1", "fail", "no image comes", "sudo ip link set dev eth1 mtu 9000"),
    (port(up=False), "port eth1", "fail", "no link", "sudo ip link set dev eth1 up"),
    (port(speed_mbps=100), "port eth1", "fail", "bad cable", ""),
    (port(speed_mbps=None), "port eth1", "unknown", "unknown", ""),
    (port(rx_ring=(256, 8192)), "rx ring of eth1", "warn", "256 of 8192", "sudo ethtool -G eth1 rx 4096"),
    (port(rx_ring=None), "rx ring of eth1", "unknown", "does not say", ""),
    (replace(GOOD, ports=GOOD.ports[1:]), "port eth1", "unknown", "container", ""),
    (replace(GOOD, rmem_max=212992), "receive buffer", "fail", "does not fit", "net.core.rmem_max=33554432"),
    (replace(GOOD, rmem_max=4 << 20), "receive buffer", "warn", "three images", "net.core.rmem_max=33554432"),
    (replace(GOOD, rmem_max=None), "receive buffer", "unknown", "cannot be read", ""),
    (replace(GOOD, netdev_max_backlog=1000), "packet backlog", "warn", "dropped", "net.core.netdev_max_backlog=5000"),
    (replace(GOOD, netdev_max_backlog=None), "packet backlog", "unknown", "cannot be read", ""),
    (replace(GOOD, firewall=None), "firewall", "unknown", "root", "sudo nft list ruleset"),
    (replace(GOOD, firewall="ufw"), "firewall", "warn", "no rule", "sudo ufw allow proto udp from 169.254.1.2 to any"),
    (replace(GOOD, firewall="firewalld"), "firewall", "warn", "no rule",
     "--add-source=169.254.2.2 && sudo firewall-cmd --reload"),
    (replace(GOOD, firewall="iptables"), "firewall", "warn", "no rule", "-p udp -s 169.254.1.2,169.254.2.2 -j ACCEPT"),
    (replace(GOOD, firewall="inet filter input"), "firewall", "warn", "no rule",
     "sudo nft insert rule inet filter input ip saddr '{ 169.254.1.2, 169.254.2.2 }' meta l4proto udp accept"),
    (replace(GOOD, synchronised=False), "clock", "warn", "drift", "timedatectl set-ntp true"),
    (replace(GOOD, synchronised=None), "clock", "unknown", "does not say", ""),
    (replace(GOOD, clocksource="hpet"), "clock source", "warn", "hpet", "dmesg"),
    (replace(GOOD, clocksource=""), "clock source", "unknown", "does not say", ""),
    (replace(GOOD, cpus=1), "processors", "warn", "packets are lost", ""),
    (replace(GOOD, governors=("performance", "powersave")), "frequency", "warn", "powersave", "echo performance | sudo tee"),
    (replace(GOOD, governors=()), "frequency", "unknown", "virtual machine", ""),
    (replace(GOOD, ptp_ports=("eth1",)), "PTP", "warn", "no ptp4l on eth2", "ptp4l -S -m -i eth1 -i eth2"),
])
def test_each_fault_is_named_with_what_mends_it(host: Host, what: str, level: str, says: str, command: str) -> None:
    (finding,) = wrong(host)
    assert (finding.what, finding.level) == (what, level)
    assert says in f"{finding.seen}: {finding.reason}"
    assert command in finding.command
    assert bool(command) is bool(finding.command)


def test_a_camera_without_a_way_gets_an_address_on_a_port_that_has_none() -> None:
    uplink = Port("eth0", 1500, up=True, speed_mbps=1000, physical=True)
    host = replace(GOOD, ports=(uplink, replace(GOOD.ports[0], up=False), GOOD.ports[1], Port("br0", 1500, up=True)),
                   routes=(Route("eth0", "0.0.0.0/0", "192.168.0.1"), Route("eth0", "192.168.0.0/24")))
    left, right = wrong(host)
    assert (left.level, right.level) == ("fail", "fail")
    assert "through the router 192.168.0.1" in left.seen
    assert left.command == "sudo ip addr add 169.254.1.1/24 dev eth2 && sudo ip link set dev eth2 up"      # it has a link
    assert right.command == "sudo ip addr add 169.254.2.1/24 dev eth1 && sudo ip link set dev eth1 up"
    (alone,) = wrong(replace(host, routes=host.routes[1:], ports=(uplink,)), cameras=(("left", "10.0.0.1"),))
    assert alone.command.startswith("sudo ip addr add 10.0.0.2/24 dev IFACE &&")
    assert "no route" in alone.seen
    assert "IFACE stands for" in alone.reason
    both = wrong(host, cameras=(("left", "10.0.0.1"), ("right", "10.0.0.2")))      # behind one switch
    assert {finding.command for finding in both} == {
        "sudo ip addr add 10.0.0.3/24 dev eth2 && sudo ip link set dev eth2 up"}


def test_an_address_that_is_none_and_one_that_is_not_known() -> None:
    left, right = wrong(GOOD, cameras=(("left", "camera-1"), ("right", "")))
    assert (left.level, right.level) == ("fail", "unknown")
    assert "no IPv4 address" in left.reason
    assert "serial number" in right.seen


def test_large_packets_are_recommended_where_both_sides_have_small_ones() -> None:
    (small,) = wrong(port(mtu=1500), packet_size=1500, cameras=CAMERAS[:1])
    assert (small.level, small.command) == ("warn", "sudo ip link set dev eth1 mtu 9000")
    (auto,) = wrong(port(mtu=1500), packet_size=0, cameras=CAMERAS[:1])
    assert (auto.level, auto.seen) == ("warn", "1500, cameras.packet_size auto")
    assert not wrong(port(mtu=9000), packet_size=0, cameras=CAMERAS[:1])
    (ready,) = wrong(GOOD, packet_size=1500, cameras=CAMERAS[:1])
    assert (ready.level, ready.command) == ("warn", "")
    assert "packet_size: 9000" in ready.reason


def test_two_cameras_on_one_gigabit_port_and_no_ptp_needed() -> None:
    host = replace(GOOD, routes=(Route("eth1", "169.254.0.0/16"),), ptp_ports=())
    (shared,) = wrong(host)
    assert "left and right" in shared.seen
    assert wrong(replace(host, ports=(replace(host.ports[0], speed_mbps=10000),))) == []


@pytest.mark.parametrize(("of_port", "of_all", "level"), [(1, 0, "fail"), (0, 1, "fail"), (2, 1, "warn"), (0, 0, "warn")])
def test_two_ports_in_one_subnet(of_port: int, of_all: int, level: str) -> None:
    host = replace(GOOD, routes=(Route("eth1", "10.0.0.0/24"), Route("eth2", "10.0.0.0/24")), rp_filter=of_all,
                   ports=tuple(replace(one, rp_filter=of_port) for one in GOOD.ports))
    found = [finding for finding in wrong(host, (("left", "10.0.0.2"), ("right", "10.0.0.3"))) if finding.what == "subnets"]
    assert [finding.level for finding in found] == [level]
    assert ("net/ipv4/conf/eth2/rp_filter=2" in found[0].command) is (level == "fail")


def test_cameras_on_loopback_need_no_network() -> None:
    found = judge(GOOD, (("left", "127.0.0.2"), ("right", "127.0.0.3")), 1500)
    assert [finding.what for finding in found[:3]] == ["way to left", "way to right", "receive buffer"]
    (firewall,) = wrong(replace(GOOD, firewall="ufw"), (("left", "127.0.0.2"), ("right", "")))[1:]
    assert (firewall.what, firewall.command) == ("firewall", "")


def test_the_buffer_is_the_one_that_the_driver_asks_for() -> None:
    assert findings.SOCKET_BUFFER_BYTES == stream.SOCKET_BUFFER_BYTES


FILES = {
    "proc/sys/net/core/rmem_max": "212992\n", "proc/sys/net/core/rmem_default": "212992\n",
    "proc/sys/net/core/netdev_max_backlog": "1000\n", "proc/sys/net/ipv4/conf/all/rp_filter": "2\n",
    "proc/sys/net/ipv4/conf/eth1/rp_filter": "1\n", "proc/sys/kernel/osrelease": "6.1.0-18-amd64\n",
    "proc/net/route": """Iface\tDestination\tGateway \tFlags\tRefCnt\tUse\tMetric\tMask\t\tMTU\tWindow\tIRTT
eth0\t00000000\t010200C0\t0003\t0\t0\t100\t00000000\t0\t0\t0
eth1\t0001FEA9\t00000000\t0001\t0\t0\t0\t00FFFFFF\t0\t0\t0
*\t0000FEA9\t00000000\t0200\t0\t0\t0\t0000FFFF\t0\t0\t0
""",
    "sys/class/net/eth0/mtu": "1500\n", "sys/class/net/eth0/operstate": "down\n", "sys/class/net/eth0/speed": "-1\n",
    "sys/class/net/eth1/mtu": "9000\n", "sys/class/net/eth1/carrier": "1\n", "sys/class/net/eth1/speed": "1000\n",
    "sys/class/net/wlan0/mtu": "1500\n", "sys/class/net/wlan0/device/vendor": "0x8086\n",
    "sys/class/net/wlan0/phy80211/index": "0\n",
    "sys/class/net/eth1/device/vendor": "0x8086\n", "sys/class/net/bonding_masters": "\n",
    "sys/devices/system/clocksource/clocksource0/current_clocksource": "hpet\n",
    "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor": "powersave\n", "sys/devices/system/cpu/cpu1/online": "1\n",
    "sys/devices/system/cpu/cpuidle/current_driver": "none\n",
    "proc/41/cmdline": "/usr/sbin/ptp4l\0-S\0-i\0eth3\0", "proc/42/cmdline": "/usr/sbin/ptp4l\0-f\0/etc/linuxptp/ptp4l.conf\0",
    "proc/43/cmdline": "vi\0-i\0eth9\0", "etc/linuxptp/ptp4l.conf": "[global]\npriority1 1\n[eth1]\ndelay_mechanism E2E\n",
}


def test_a_snapshot_is_read_from_the_kernels_files(tmp_path: Path) -> None:
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    assert read(tmp_path) == Host(
        ports=(Port("eth0", 1500, up=False), Port("eth1", 9000, up=True, speed_mbps=1000, rp_filter=1, physical=True),
               Port("wlan0", 1500, up=False)),
        routes=(Route("eth0", "0.0.0.0/0", "192.0.2.1", 100), Route("eth1", "169.254.1.0/24")),
        rmem_max=212992, rmem_default=212992, netdev_max_backlog=1000, rp_filter=2, clocksource="hpet",
        ptp_ports=("eth1", "eth3"), cpus=2, governors=("powersave",), kernel="6.1.0-18-amd64")


def test_a_host_that_says_nothing_is_unknown_not_well(tmp_path: Path) -> None:
    silent = read(tmp_path)
    assert (silent.ports, silent.rmem_max, silent.synchronised) == ((), None, None)
    assert {finding.what for finding in wrong(silent, cameras=()) if finding.level == "unknown"} >= {
        "receive buffer", "packet backlog", "firewall", "clock", "clock source", "frequency"}


def test_the_most_specific_route_leads_the_way_and_then_the_lowest_metric() -> None:
    host = Host(routes=(Route("wan", "0.0.0.0/0", "10.0.0.1"), Route("slow", "10.1.0.0/16", metric=600),
                        Route("fast", "10.1.0.0/16", metric=100), Route("cell", "10.1.2.0/24")))
    ways = [host.way(address) for address in ("10.1.2.3", "10.1.3.3", "8.8.8.8", "127.0.0.2")]
    assert [way and way.port for way in ways] == ["cell", "fast", "wan", "lo"]
    assert Host().way("10.1.2.3") is None


@pytest.mark.parametrize(("tool", "rules", "found"), [
    ("nft", "table inet filter {\n\tchain input {\n\t\ttype filter hook input priority filter; policy drop;\n\t}\n}\n",
     "inet filter input"),
    ("nft", "table ip f {\n\tchain i {\n\t\ttype filter hook input priority 0; policy accept;\n\t}\n}\n", ""),
    ("nft", "table ip f {\n\tchain o {\n\t\ttype filter hook forward priority 0; policy drop;\n\t}\n}\n", ""),
    ("nft", "table inet firewalld { # progname firewalld\n\tflags owner,persist\n}\n", "firewalld"),
    ("iptables", "-P INPUT DROP\n-A INPUT -i lo -j ACCEPT\n", "iptables"),
    ("iptables", "-P INPUT ACCEPT\n", ""),
])
def test_a_policy_that_drops_is_seen_in_the_rules(tool: str, rules: str, found: str) -> None:
    assert kernel._dropping(tool, rules) == found


def test_this_host_is_looked_at_without_rights_or_faults() -> None:
    here = look()
    loopback = here.port("lo")
    assert loopback is not None
    assert loopback.up
    assert loopback.rx_ring is None
    assert here.cpus >= 1
    assert here.kernel
    assert kernel.ring("no-such-port") is None
