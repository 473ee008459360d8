"""GVSP, the stream protocol: an image as leader, payload and trailer packets, sent at a pace and kept for resends.

GigE Vision 1.2, standard (16 bit) block ids. Packets leave in bursts that the kernel cuts up (UDP segmentation offload): a
packet for each system call would cost the simulator more time than the exposure.
"""

import socket
import struct
import threading
import time
from collections import OrderedDict

import numpy as np
from jaxtyping import UInt8

from binpick.sim.gige.features import GVSP_OVERHEAD
from binpick.sim.gige.pixels import Payload
from binpick.sim.gige.transit import Indices, Transit

HEADER = 8
LEADER, TRAILER, PAYLOAD = 1, 2, 3
IMAGE = 1
KEPT_BLOCKS = 4
UDP_SEGMENT = 103
"""The socket option of linux/udp.h, which Python does not name."""
BURST_BYTES = 60_000
"""Below the largest IPv4 datagram."""
MAX_SEGMENTS = 60
"""The kernel cuts a datagram into at most 64."""
BURST_S = 0.0005
"""What may leave at once: a slow link's packets come one by one."""
Target = tuple[str, int]


class Block:
    """One image in packets: 0 is the leader, then the payload, last the trailer. `sent` of them have left already."""

    def __init__(self, number: int, timestamp_ns: int, image: Payload, packet_size: int) -> None:
        payload, data = packet_size - GVSP_OVERHEAD, image.data
        whole = data.size // payload
        self.number = number
        self.size = packet_size
        self.sent = 0
        self.rows: UInt8[np.ndarray, "packets bytes"] = np.empty((whole, HEADER + payload), np.uint8)
        self.rows[:, :5] = np.frombuffer(_header(number, PAYLOAD, 0)[:5], np.uint8)
        self.rows[:, 5:HEADER] = np.arange(1, whole + 1, dtype=">u4").view(np.uint8).reshape(-1, 4)[:, 1:]
        self.rows[:, HEADER:] = data[:whole * payload].reshape(whole, payload)
        self.leader = leader(number, timestamp_ns, image.format, image.width, image.height)
        rest = data[whole * payload:].tobytes()
        tail = [_header(number, PAYLOAD, whole + 1) + rest] if rest else []
        self.tail = [*tail, _header(number, TRAILER, whole + len(tail) + 1) + struct.pack(">HHI", 0, IMAGE, image.height)]

    @property
    def count(self) -> int:
        """Packets in all."""
        return 1 + len(self.rows) + len(self.tail)

    def packet(self, index: int) -> bytes:
        """Any one of them."""
        if index == 0:
            return self.leader
        if index <= len(self.rows):
            return bytes(self.rows[index - 1])
        return self.tail[index - 1 - len(self.rows)]


def leader(block: int, timestamp_ns: int, pixel_format: int, width: int, height: int) -> bytes:
    """The packet that announces an image."""
    return _header(block, LEADER, 0) + struct.pack(">HHIIIIIIIHH", 0, IMAGE, timestamp_ns >> 32, timestamp_ns & 0xFFFFFFFF,
                                                   pixel_format, width, height, 0, 0, 0, 0)


def _header(block: int, kind: int, packet: int) -> bytes:
    return struct.pack(">HHI", 0, block, kind << 24 | packet)


class Sender:
    """The stream channel's socket. `send` is for one thread, `resend` for another.

    `gap_ns` is waited between packets beyond what the link takes; payload packets larger than `mtu` do not get through; none
    do while it is `silent`.
    """

    def __init__(self, address: str, bits_per_s: float) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((address, 0))
        self.bits_per_s, self.gap_ns, self.mtu = bits_per_s, 0, 0xFFFF
        self._kept: OrderedDict[int, Block] = OrderedDict()
        self._lock = threading.Lock()
        self._transit = Transit()
        self._random = np.random.default_rng(0)
        self.resent = 0
        self.silent = False

    @property
    def port(self) -> int:
        """The port that packets come from."""
        return int(self._socket.getsockname()[1])

    def disturb(self, transit: Transit, seed: int) -> None:
        """From now on that happens to packets; what is sent again can be lost again."""
        with self._lock:
            self._transit, self._random = transit, np.random.default_rng(seed)

    def forget(self) -> None:
        """A new acquisition: block numbers start again."""
        with self._lock:
            self._kept.clear()

    def test(self, target: Target, packet_size: int) -> None:
        """One packet of that size, by which a client learns whether the network carries it."""
        if packet_size <= self.mtu:
            self._socket.sendto(bytes(packet_size - GVSP_OVERHEAD + HEADER), target)

    def lead(self, packet: bytes, target: Target) -> None:
        """A leader before its image."""
        self._socket.sendto(packet, target)

    def send(self, block: Block, target: Target, led: bool = False) -> None:
        """The whole image, at the link's pace; `led`: its leader has gone. Raises OSError when the socket is closed."""
        with self._lock:
            self._kept[block.number] = block
            while len(self._kept) > KEPT_BLOCKS:
                self._kept.popitem(last=False)
            transit = self._transit
            order, late = transit.plan(block.count, self._random)
        if led:
            order, late = order[order != 0], late[late != 0]
        if block.size > self.mtu:
            order = order[(order == 0) | (order > len(block.rows))]
            late = late[:0]
        self._send(block, order, target)
        block.sent = block.count
        if len(late):
            time.sleep(transit.late_ms / 1000)
            self._send(block, late, target)

    def _send(self, block: Block, order: Indices, target: Target) -> None:
        """Runs of whole payload packets as bursts, all others one by one."""
        start, size = time.monotonic(), block.rows.shape[1]
        per_packet_s = size * 8 / self.bits_per_s + self.gap_ns / 1e9
        segments = max(1, min(self._segments(size), int(BURST_S / per_packet_s)))
        gone = 0
        whole = (order > 0) & (order <= len(block.rows))
        for run in np.split(order, np.flatnonzero(np.diff(whole)) + 1):
            for first in range(0, len(run), segments):
                burst = run[first:first + segments]
                self._burst(block, burst, target)
                block.sent, gone = max(block.sent, int(burst.max()) + 1), gone + len(burst)
                ahead = start + gone * per_packet_s - time.monotonic()
                if ahead > 0.0002:       # shorter sleeps overshoot
                    time.sleep(ahead)

    def _burst(self, block: Block, packets: Indices, target: Target) -> None:
        if self.silent:                # since a moment ago, in the midst of an image
            return
        if 0 < packets[0] <= len(block.rows):
            self._socket.sendto(block.rows[packets - 1].data, target)
            return
        for index in packets:
            self._socket.sendto(block.packet(int(index)), target)

    def _segments(self, size: int) -> int:
        """How many packets of `size` bytes one call may carry."""
        try:
            self._socket.setsockopt(socket.IPPROTO_UDP, UDP_SEGMENT, size)
        except OSError:              # a kernel without the offload
            return 1
        return max(1, min(MAX_SEGMENTS, BURST_BYTES // size))

    def resend(self, target: Target, number: int, first: int, last: int) -> None:
        """Packets `first` to `last` of a kept block, as far as they have been sent once; of other blocks, nothing."""
        with self._lock:
            block = self._kept.get(number)
            if block is None or not self._transit.resends:
                return
            chosen = range(first, min(last + 1, block.sent))
            lost = self._random.random(len(chosen)) < self._transit.loss
            self.resent += len(chosen)
        for index, gone in zip(chosen, lost, strict=True):
            fits = block.size <= self.mtu or not 0 < index <= len(block.rows)
            if fits and not gone:
                self._socket.sendto(block.packet(index), target)

    def close(self) -> None:
        """Silent from here on."""
        self._socket.close()
