"""What this process holds: threads, file descriptors, memory; before and after something that should leave nothing behind."""

import gc
import os
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

WARM_SHARE = 0.2
"""Of a series, before memory counts: pools fill in its beginning."""
SETTLE_S = 15.0
"""A thread that lets go of a dead camera takes 5 s."""


@dataclass(frozen=True, slots=True)
class Footprint:
    """`threads` are all of the process, the driver's too."""

    threads: int
    files: int
    memory_mb: float

    def row(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def now() -> Footprint:
    """As it is."""
    own = Path("/proc/self")
    pages = int((own / "statm").read_text().split()[1])
    return Footprint(len(list((own / "task").iterdir())), len(list((own / "fd").iterdir())),
                     round(pages * os.sysconf("SC_PAGESIZE") / 1e6, 1))


def growth_mb(memory: list[tuple[float, float]]) -> float | None:
    """For each unit of the first column, by a line through all but the first fifth; None of fewer than three points."""
    kept = np.array(memory[int(len(memory) * WARM_SHARE):])
    return round(float(np.polyfit(kept[:, 0], kept[:, 1], 1)[0]), 3) if len(kept) > 2 else None


def settled(cameras: int) -> Footprint:
    """Once only the threads of so many open cameras are left, or 15 s have passed."""
    until = time.monotonic() + SETTLE_S
    while sum(thread.name.startswith("binpick-cam-") for thread in threading.enumerate()) > cameras:
        if time.monotonic() > until:
            break
        time.sleep(0.05)
    gc.collect()
    return now()
