"""Reads the cell's snapshots into the metrics."""

import math
import time
from contextlib import aclosing

from binpick.metrics import Facts, Metrics
from binpick.publish.events import snapshots
from binpick.publish.ports import View
from binpick.result import Snapshot

NS_PER_S = 1e9
LEVELS = ("ok", "warn", "fault")


async def run(view: View, metrics: Metrics) -> None:
    """Counts every finished cycle once, also those that ended between two snapshots; ends when the cell stops."""
    counted = 0
    async with aclosing(snapshots(view)) as changes:
        async for snapshot in changes:
            latest = snapshot.latest.result.cycle_id if snapshot.latest else 0
            # a cycle that left memory unseen (the last 16 are kept) is not counted: that takes 16 ends within one wake-up
            for cycle_id in range(counted + 1, latest + 1):
                if (published := view.finished(cycle_id)) is not None:
                    result = published.result
                    metrics.finished(result.return_code.value, result.return_code.name, result.timing_ms)
            counted = latest


def facts(view: View) -> Facts:
    """What the cell counts itself, now."""
    snapshot = view.snapshot()
    counts = dict(snapshot.counts)
    latest = snapshot.latest
    age_s = math.nan if latest is None or latest.result.captured_at is None else (
        (time.monotonic_ns() - latest.triggered_ns) / NS_PER_S)
    return Facts(refused=counts.get("refused", 0), late=counts.get("late", 0), gate_stopped=counts.get("gate_stopped", 0),
                 frame_age_s=age_s, camera_failures={camera.name: camera.failures for camera in snapshot.cameras},
                 ready=snapshot.phase == "ready",
                 pairs_refused=max((camera.refused for camera in snapshot.cameras), default=0),
                 calibration=_calibration(snapshot))


def _calibration(snapshot: Snapshot) -> dict[str, float]:
    """The watchdog's last word; what could not be measured is absent."""
    seen = snapshot.drift.latest if snapshot.drift is not None else None
    if seen is None:
        return {}
    figures: dict[str, float | None] = {"level": float(LEVELS.index(seen.level)), "row_px": seen.row_px, "off_px": seen.off_px,
                                         "change_px": seen.change_px}
    if (marks := seen.marks) is not None:
        figures |= {"marks_seen": float(marks.seen), "marks_shift_m": marks.shift_m, "marks_turn_rad": marks.turn_rad,
                    "depth_error_m": marks.depth_m}
    figures["correction_rad"] = math.hypot(*seen.correction.rotation_rad) if seen.correction is not None else 0.0
    return {name: value for name, value in figures.items() if value is not None}
