"""A long run of pairs whose pictures carry their number: none lost, none mispaired, and nothing that grows."""

import time
import zlib
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from rich.table import Table

from binpick.camera import backends
from binpick.camera.group import CameraGroup
from binpick.data import StereoPair
from binpick.errors import CameraError
from binpick.lab import footprint
from binpick.lab.rig import FULL, LIGHT, Plan, Rig, free
from binpick.sim.gige.numbered import read

PATIENCE_NS = 20_000_000_000
PERIOD_S = 0.1
JUDGED = 5000
"""Pairs after which their images are compared: the simulator tells the checksums of each camera's last 20 000."""


@dataclass
class Log:
    """What happened. `offset` is how many more exposures the first camera made than the second, since power-up; `images` are
    head, shot and checksum, one after the other, of those not compared yet; `wrong` of the others were not what was sent;
    `memory` is in MB by minutes."""

    pairs: int = 0
    lost: int = 0
    mispaired: int = 0
    stale: int = 0
    late: int = 0
    offset: int | None = None
    newest: int = 0
    images: "array[int]" = field(default_factory=lambda: array("q"))
    wrong: int = 0
    memory: list[tuple[float, float]] = field(default_factory=list)

    def take(self, pair: StereoPair) -> None:
        """One pair that was accepted."""
        (left, first), (right, second) = numbers = [read(frame.image) for frame in pair.frames]
        self.offset = first - second if self.offset is None else self.offset
        self.pairs += 1
        self.mispaired += (left, right) != (0, 1) or first - second != self.offset
        self.stale += first <= self.newest
        self.newest = first
        for number, frame in zip(numbers, pair.frames, strict=True):
            self.images.extend((*number, zlib.crc32(frame.image.data)))

    def judge(self, sent: Sequence[dict[int, int]]) -> None:
        """Compares the images with the checksums of what each camera sent, by shot."""
        self.wrong += sum(sent[head][shot] != crc32 for head, shot, crc32 in zip(*[iter(self.images)] * 3, strict=True))
        del self.images[:]


def run(seconds: float, size_px: tuple[int, int] = FULL,
        tick: Callable[[float], None] = lambda _: None) -> dict[str, Any]:
    """Ten pairs a second for so long; `tick` is told how far it is, 0 to 1."""
    plan = Plan(free(), size_px, numbered=True)
    with Rig(plan) as rig:
        group = backends.group(plan.cameras(max_skew_us=1_000_000.0))
        group.open(time.monotonic_ns() + PATIENCE_NS)
        try:
            log = Log()
            _capture(group, log)
            before, began = footprint.now(), time.monotonic()
            _keep_pace(group, rig, log, seconds, tick)
            took_s, after = time.monotonic() - began, footprint.now()
            log.judge([rig.sent(head) for head in (0, 1)])
        finally:
            group.close()
    return {"seconds": round(took_s, 1), "pairs": log.pairs, "rate_hz": round((log.pairs - 1) / took_s, 2), "lost": log.lost,
            "mispaired": log.mispaired, "stale": log.stale, "wrong_images": log.wrong, "late_starts": log.late,
            "refused": group.statuses()[0].refused, "memory_mb_per_minute": footprint.growth_mb(log.memory),
            "before": before.row(), "after": after.row()}


def _keep_pace(group: CameraGroup, rig: Rig, log: Log, seconds: float, tick: Callable[[float], None]) -> None:
    began = time.monotonic()
    for turn in range(1, int(seconds / PERIOD_S) + 1):
        ahead = began + turn * PERIOD_S - time.monotonic()
        log.late += ahead < -PERIOD_S
        time.sleep(max(0.0, ahead))
        _capture(group, log)
        if turn % 10 == 0:
            elapsed = time.monotonic() - began
            log.memory.append((elapsed / 60, footprint.now().memory_mb))
            tick(min(1.0, elapsed / seconds))
        if turn % JUDGED == 0:
            log.judge([rig.sent(head) for head in (0, 1)])


def _capture(group: CameraGroup, log: Log) -> None:
    try:
        pair = group.capture(LIGHT, time.monotonic_ns() + PATIENCE_NS)
    except CameraError:
        log.lost += 1
        group.open(time.monotonic_ns() + PATIENCE_NS)
        log.offset, log.newest = None, 0          # as the cell does
        return
    log.take(pair)


def table(row: dict[str, Any]) -> Table:
    """Simulator figures."""
    sheet = Table("figure", "value", title="Ten pairs a second on simulated cameras (simulator figures, not a camera's)")
    for name, value in row.items():
        sheet.add_row(name.replace("_", " "), ", ".join(f"{k.replace('_', ' ')} {v}" for k, v in value.items())
                      if isinstance(value, dict) else str(value))
    return sheet
