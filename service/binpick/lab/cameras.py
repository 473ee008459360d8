"""The camera pair on simulated cameras: is the reported skew the true one, how soon are both here, what do losses do?"""

import time
import tracemalloc
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from rich.table import Table

from binpick.camera import backends
from binpick.camera.group import CameraGroup
from binpick.data import StereoPair
from binpick.errors import CameraError, PairRefused
from binpick.lab.rig import FULL, LIGHT, SMALL, Plan, Rig, free
from binpick.settings.cell import Sync

LIMIT_US = 1000.0
"""max_skew_us of the series with injected skews: below it pairs are accepted, above it never."""
PATIENCE_S = 20.0
OPEN_S = 5.0
MODES: tuple[Sync, ...] = ("line", "scheduled_action", "action", "software")
SKEWS_US = (0.0, 50.0, 500.0, 5000.0)
LOSSES = (0.01, 0.05, 0.20)


@dataclass(frozen=True, slots=True)
class Trial:
    """One series of pairs. `apart`: cameras that hear no PTP; `skew_us` is injected, `loss` is a share of the packets."""

    name: str
    sync: Sync
    pairs: int
    size_px: tuple[int, int] = FULL
    apart: bool = False
    skew_us: float = 0.0
    loss: float = 0.0
    max_skew_us: float = 5000.0
    offset_s: float = 0.78
    drift_ppm: float = 40.0
    packet_size: int | Literal["auto"] = "auto"


@dataclass(frozen=True, slots=True)
class Taken:
    """What a pair said; of its images only frame id and checksum."""

    skew_us: float
    sigma_us: float
    proof: str
    arrival_ms: float
    resends: int
    images: tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class Judged:
    """A pair beside the truth. `whole`: every bit of both images is what was sent."""

    taken: Taken
    true_us: float
    whole: bool


def programme(pairs: int) -> list[Trial]:
    """Modes at full size; injected skews by PTP and by latches, clocks apart by up to 1 s and 50 ppm; losses."""
    modes = [Trial(mode, mode, pairs) for mode in MODES]
    skews = [Trial(f"{skew:.0f} µs, {'apart' if apart else 'PTP'}", "line", pairs, SMALL, apart, skew, max_skew_us=LIMIT_US,
                   offset_s=offset_s, drift_ppm=drift)
             for apart in (False, True)
             for skew, offset_s, drift in zip(SKEWS_US, (1.0, -1.0, 0.3, -0.5), (50.0, -50.0, 25.0, 50.0), strict=True)]
    losses = [Trial(f"{loss:.0%} lost", "software", pairs, loss=loss, packet_size=1500) for loss in LOSSES]
    return [*modes, *skews, *losses]


def run(trials: Sequence[Trial]) -> Iterator[dict[str, Any]]:
    """One series' figures after the other."""
    for trial in trials:
        plan = Plan(free(), trial.size_px, trial.apart, trial.offset_s, trial.drift_ppm)
        cameras = plan.cameras(sync=trial.sync, max_skew_us=trial.max_skew_us, packet_size=trial.packet_size)
        with Rig(plan) as rig:
            group = backends.group(cameras)
            _open(group)
            try:
                yield _series(trial, rig, group)
            finally:
                group.close()


def _in(seconds: float) -> int:
    return time.monotonic_ns() + int(seconds * 1e9)


def _series(trial: Trial, rig: Rig, group: CameraGroup) -> dict[str, Any]:
    _settle(group)
    if trial.skew_us:
        rig.change(1, skew_us=trial.skew_us)
    if trial.loss:
        rig.lose(trial.loss, seed=7)
    before, busy_s = group.statuses()[0].refused, 0.0
    judged: list[Judged] = []
    taken: list[Taken] = []
    lost = 0
    for _ in range(trial.pairs):
        busy_s -= time.process_time()
        try:
            pair = group.capture(LIGHT, _in(PATIENCE_S))
        except PairRefused:
            continue
        except CameraError:            # as the cell does; frames are counted from 1 again
            lost, judged, taken = lost + 1, judged + _judge(taken, rig), []
            _open(group)
            continue
        finally:
            busy_s += time.process_time()
        taken.append(Taken(pair.skew_us, pair.sigma_us, pair.proof, pair.arrival_ms, sum(f.resends for f in pair.frames),
                           tuple((f.frame_id, zlib.crc32(f.image.tobytes())) for f in pair.frames)))
    rig.lose(0.0, seed=7)
    copies = _copies(group) if trial.size_px == FULL and not trial.loss else None
    return {"name": trial.name, "sync": trial.sync, "pairs": trial.pairs, "lost": lost,
            "refused": group.statuses()[0].refused - before, "cpu_ms": round(busy_s * 1000 / trial.pairs, 2), "copies": copies,
            **_figures(trial, judged + _judge(taken, rig))}


def _open(group: CameraGroup) -> None:
    """As often as it takes. Raises CameraError after PATIENCE_S."""
    until_ns = _in(PATIENCE_S)
    while True:
        try:
            group.open(_in(OPEN_S))
        except CameraError:
            if time.monotonic_ns() > until_ns:
                raise
            time.sleep(0.2)
        else:
            return


def _pair(group: CameraGroup) -> StereoPair:
    """One pair that is not counted, as soon as there is one."""
    while True:
        try:
            return group.capture(LIGHT, _in(PATIENCE_S))
        except PairRefused:
            continue
        except CameraError:
            _open(group)


def _settle(group: CameraGroup) -> None:
    """First pairs until PTP has found its place."""
    until = time.monotonic() + 3
    while time.monotonic() < until:
        pair = _pair(group)
        if pair.proof == "ptp" or [status.ptp for status in group.statuses()] == ["Master", "Master"]:
            return


def _copies(group: CameraGroup) -> float:
    """How often an image's bytes are held at most while a pair is taken, beyond the driver's own buffers."""
    tracemalloc.start()
    try:
        pair = _pair(group)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    return round(peak / sum(frame.image.nbytes for frame in pair.frames), 2)


def _judge(taken: list[Taken], rig: Rig) -> list[Judged]:
    truths = [rig.truth(index) for index in (0, 1)] if taken else []
    found = []
    for pair in taken:
        left, right = (truth[block] for truth, (block, _) in zip(truths, pair.images, strict=True))
        sent = (left.crc32, right.crc32)
        found.append(Judged(pair, (right.started_ns - left.started_ns) / 1000, sent == tuple(crc for _, crc in pair.images)))
    return found


def _figures(trial: Trial, judged: list[Judged]) -> dict[str, Any]:
    error = np.array([abs(shot.taken.skew_us - shot.true_us) for shot in judged])
    sigma = np.array([shot.taken.sigma_us for shot in judged])
    return {"accepted": len(judged), "proofs": dict(Counter(shot.taken.proof for shot in judged)),
            "within_3_sigma": float(np.mean(error <= 3 * sigma)) if judged else None,
            "error_us": _quantiles(error), "sigma_us": _quantiles(sigma),
            "arrival_ms": _quantiles([shot.taken.arrival_ms for shot in judged]),
            "resends": sum(shot.taken.resends for shot in judged), "wrong_images": sum(not shot.whole for shot in judged),
            "accepted_beyond_limit": sum(abs(shot.true_us) > trial.max_skew_us for shot in judged)}


def _quantiles(values: Sequence[float] | np.ndarray) -> dict[str, float] | None:
    if not len(values):
        return None
    return {name: round(float(np.percentile(values, q)), 2) for name, q in (("p50", 50), ("p95", 95), ("max", 100))}


def table(rows: Sequence[dict[str, Any]]) -> Table:
    """Simulator figures, one row a series."""
    sheet = Table("series", "accepted", "lost", "refused", "proof", "|error| µs p50/p95/max", "in 3σ", "σ µs p50/max",
                  "both here ms p50/p95", "CPU ms", "copies", "resends", "wrong", "beyond",
                  title="Camera pair on simulated cameras (simulator figures, not a camera's)")
    for row in rows:
        error, sigma, arrival = (row[name] or dict.fromkeys(("p50", "p95", "max"), float("nan"))
                                 for name in ("error_us", "sigma_us", "arrival_ms"))
        sheet.add_row(row["name"], f"{row['accepted']} of {row['pairs']}", str(row["lost"]), str(row["refused"]),
                      " ".join(f"{name} {number}" for name, number in row["proofs"].items()),
                      f"{error['p50']:.1f} / {error['p95']:.1f} / {error['max']:.1f}",
                      "-" if row["within_3_sigma"] is None else f"{row['within_3_sigma']:.1%}",
                      f"{sigma['p50']:.1f} / {sigma['max']:.1f}", f"{arrival['p50']:.1f} / {arrival['p95']:.1f}",
                      f"{row['cpu_ms']:.1f}", "-" if row["copies"] is None else f"{row['copies']:.2f}", str(row["resends"]),
                      str(row["wrong_images"]), str(row["accepted_beyond_limit"]))
    return sheet
