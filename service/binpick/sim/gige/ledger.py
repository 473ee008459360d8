"""The truth behind the images: when each was exposed on the host's clock, and which bytes left for it."""

import threading
import zlib
from collections import deque
from dataclasses import dataclass

from binpick.data import Light
from binpick.sim.gige.pixels import Bytes, Payload
from binpick.sim.gige.sensor import Shot

ENTRIES = 20_000
KEPT = 8
"""Images of each head whose bytes are kept; of older ones there is the checksum."""


@dataclass(frozen=True, slots=True, eq=False)
class Entry:
    """One image of one head. `shot` counts exposures since power-up, `block` is its number on the wire (frame id),
    `started_ns` the start of exposure on the host's clock (since 1970), `timestamp_ns` the same as the head's clock has it.
    `crc32` is of the payload as it left. `sent`: whether it left at all, be it with losses."""

    head: int
    shot: int
    block: int
    started_ns: int
    timestamp_ns: int
    light: Light
    format: int
    crc32: int
    sent: bool


class Ledger:
    """Written by the heads' threads, read by anyone."""

    def __init__(self, heads: int) -> None:
        self._lock = threading.Lock()
        self._entries: list[deque[Entry]] = [deque(maxlen=ENTRIES) for _ in range(heads)]
        self._images: list[deque[tuple[int, Bytes]]] = [deque(maxlen=KEPT) for _ in range(heads)]

    def enter(self, head: int, shot: Shot, timestamp_ns: int, payload: Payload, sent: bool) -> None:
        """One image, when it leaves."""
        entry = Entry(head, shot.number, shot.block, shot.started_ns, timestamp_ns, shot.light, payload.format,
                      zlib.crc32(payload.data.data), sent)
        with self._lock:
            self._entries[head].append(entry)
            self._images[head].append((shot.block, payload.data))

    def truth(self, head: int) -> tuple[Entry, ...]:
        """Its images, oldest first."""
        with self._lock:
            return tuple(self._entries[head])

    def image(self, head: int, block: int) -> Bytes:
        """The payload of its last image of that number. Raises KeyError when it is none of the last ones."""
        with self._lock:
            kept = dict(self._images[head])
        return kept[block]
