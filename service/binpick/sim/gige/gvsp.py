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
from jaxtyping import Bool, UInt8

from binpick.data import Image
from binpick.sim.gige.features import GVSP_OVERHEAD, MONO8

HEADER = 8
LEADER, TRAILER, PAYLOAD = 1, 2, 3
IMAGE = 1
MAX_BLOCK = 0xFFFF
KEPT_BLOCKS = 4
UDP_SEGMENT = 103
"""The socket option of linux/udp.h, which Python does not name."""
BURST_BYTES = 60_000
"""Below the largest IPv4 datagram."""
MAX_SEGMENTS = 60
"""The kernel cuts a datagram into at most 64."""


class Block:
    """One image in packets: 0 is the leader, then the payload, last the trailer. `sent` of them have left already."""

    def __init__(self, number: int, timestamp_ns: int, image: Image, packet_size: int) -> None:
        height, width = image.shape
        payload = packet_size - GVSP_OVERHEAD
        data = np.ascontiguousarray(image).reshape(-1)
        whole = data.size // payload
        self.number = number
        self.sent = 0
        self.rows: UInt8[np.ndarray, "packets bytes"] = np.empty((whole, HEADER + payload), np.uint8)
        self.rows[:, :5] = np.frombuffer(_header(number, PAYLOAD, 0)[:5], np.uint8)
        self.rows[:, 5:HEADER] = np.arange(1, whole + 1, dtype=">u4").view(np.uint8).reshape(-1, 4)[:, 1:]
        self.rows[:, HEADER:] = data[:whole * payload].reshape(whole, payload)
        self.leader = _header(number, LEADER, 0) + struct.pack(
            ">HHIIIIIIIHH", 0, IMAGE, timestamp_ns >> 32, timestamp_ns & 0xFFFFFFFF, MONO8, width, height, 0, 0, 0, 0)
        rest = data[whole * payload:].tobytes()
        tail = [_header(number, PAYLOAD, whole + 1) + rest] if rest else []
        self.tail = [*tail, _header(number, TRAILER, whole + len(tail) + 1) + struct.pack(">HHI", 0, IMAGE, height)]

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


def _header(block: int, kind: int, packet: int) -> bytes:
    return struct.pack(">HHI", 0, block, kind << 24 | packet)


class Sender:
    """The stream channel's socket. `send` is for one thread, `resend` for another."""

    def __init__(self, address: str, bits_per_s: float) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((address, 0))
        self._bits_per_s = bits_per_s
        self._kept: OrderedDict[int, Block] = OrderedDict()
        self._lock = threading.Lock()
        self._loss = 0.0
        self._resends = True
        self._random = np.random.default_rng(0)
        self.resent = 0

    @property
    def port(self) -> int:
        """The port that packets come from."""
        return int(self._socket.getsockname()[1])

    def drop(self, fraction: float, seed: int, resends: bool = True) -> None:
        """From now on loses that share of all packets, resent ones too, or sends none again."""
        with self._lock:
            self._loss, self._random, self._resends = fraction, np.random.default_rng(seed), resends

    def forget(self) -> None:
        """A new acquisition: block numbers start again."""
        with self._lock:
            self._kept.clear()

    def test(self, target: tuple[str, int], packet_size: int) -> None:
        """One packet of that size, by which a client learns whether the network carries it."""
        self._socket.sendto(bytes(packet_size - GVSP_OVERHEAD + HEADER), target)

    def send(self, block: Block, target: tuple[str, int]) -> None:
        """The whole image, at the link's pace. Raises OSError when the socket is closed meanwhile."""
        with self._lock:
            self._kept[block.number] = block
            while len(self._kept) > KEPT_BLOCKS:
                self._kept.popitem(last=False)
            lost = self._random.random(block.count) < self._loss
        if not lost[0]:
            self._socket.sendto(block.leader, target)
        self._send_rows(block, ~lost[1:1 + len(block.rows)], target)
        for packet, gone in zip(block.tail, lost[1 + len(block.rows):], strict=True):
            if not gone:
                self._socket.sendto(packet, target)
        block.sent = block.count

    def _send_rows(self, block: Block, kept: Bool[np.ndarray, "packets"], target: tuple[str, int]) -> None:
        size = block.rows.shape[1]
        segments = self._segments(size)
        start = time.monotonic()
        for first in range(0, len(kept), segments):
            burst = block.rows[first:first + segments][kept[first:first + segments]]
            if len(burst):
                self._socket.sendto(burst.data, target)
            block.sent = 1 + min(first + segments, len(kept))
            ahead = start + (first + segments) * size * 8 / self._bits_per_s - time.monotonic()
            if ahead > 0.0002:       # shorter sleeps overshoot
                time.sleep(ahead)

    def _segments(self, size: int) -> int:
        """How many packets of `size` bytes one call may carry."""
        try:
            self._socket.setsockopt(socket.IPPROTO_UDP, UDP_SEGMENT, size)
        except OSError:              # a kernel without the offload
            return 1
        return max(1, min(MAX_SEGMENTS, BURST_BYTES // size))

    def resend(self, target: tuple[str, int], number: int, first: int, last: int) -> None:
        """Packets `first` to `last` of a kept block, as far as they have been sent once; of other blocks, nothing."""
        with self._lock:
            block = self._kept.get(number)
            if block is None or not self._resends:
                return
            chosen = range(first, min(last + 1, block.sent))
            lost = self._random.random(len(chosen)) < self._loss
            self.resent += len(chosen)
        for index, gone in zip(chosen, lost, strict=True):
            if not gone:
                self._socket.sendto(block.packet(index), target)

    def close(self) -> None:
        """Silent from here on."""
        self._socket.close()
