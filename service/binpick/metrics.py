"""What Prometheus reads: finished cycles and their stage times are counted here, all else is asked for at each scrape."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

from prometheus_client import CollectorRegistry, Counter, Histogram, exposition
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

MEDIA_TYPE = exposition.CONTENT_TYPE_LATEST
BUCKETS_S = (0.001, 0.003, 0.01, 0.03, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0, 10.0)
"""From one array operation to the longest usual time limit; finest around the 0.3 s a cycle may compute."""

CALIBRATION = {
    "level": "What the watchdog says of the calibration: 0 ok, 1 warning, 2 fault.",
    "row_px": "Rows of the right image below the left's in the last cycle, px.",
    "off_px": "What counts for the watchdog's limits: rows over the whole view and the last cycles, px.",
    "change_px": "Change of the row error over 100 cycles, px.",
    "marks_seen": "Reference marks that both cameras saw.",
    "marks_shift_m": "Cameras against the cell since the reference marks were stored, m.",
    "marks_turn_rad": "Cameras against the cell since the reference marks were stored, rad.",
    "depth_error_m": "What the reference marks say depth is off, m.",
    "correction_rad": "Turn by which the second camera is corrected, rad.",
}


@dataclass(frozen=True, slots=True)
class Facts:
    """What the cell counts itself, at one instant; `frame_age_s` is since the last trigger, NaN before the first."""

    refused: int
    late: int
    gate_stopped: int
    camera_failures: Mapping[str, int]
    frame_age_s: float
    ready: bool
    pairs_refused: int = 0
    calibration: Mapping[str, float] = field(default_factory=dict)
    """The watchdog's figures, by the names of CALIBRATION; unknown ones are absent."""


class Metrics:
    """One registry per app, so that two apps in a process do not meet."""

    def __init__(self, facts: Callable[[], Facts]) -> None:
        self._registry = CollectorRegistry()
        self._cycles = Counter("binpick_cycles", "Finished cycles by return code.", ["code", "name"], registry=self._registry)
        self._stages = Histogram("binpick_stage_seconds", "Time of a cycle's stages, and their total.", ["stage"],
                                 registry=self._registry, buckets=BUCKETS_S)
        self._registry.register(_Scrape(facts))

    def finished(self, code: int, name: str, timing_ms: Mapping[str, float]) -> None:
        """A cycle has ended; stages it did not reach are absent."""
        self._cycles.labels(str(code), name).inc()
        for stage, duration_ms in timing_ms.items():
            self._stages.labels(stage).observe(duration_ms / 1000)

    def text(self) -> bytes:
        """The exposition, in MEDIA_TYPE."""
        return exposition.generate_latest(self._registry)


class _Scrape(Collector):
    """Turns the facts of the moment into metrics."""

    def __init__(self, facts: Callable[[], Facts]) -> None:
        self._facts = facts

    def collect(self) -> Iterator[Metric]:
        """Called by the registry at each scrape."""
        facts = self._facts()
        yield CounterMetricFamily("binpick_refused", "Cycles refused: busy, not ready or not in control.", facts.refused)
        yield CounterMetricFamily("binpick_late", "Results dropped because their cycle had been withdrawn.", facts.late)
        yield CounterMetricFamily("binpick_gate_stopped", "Poses that the last gate stopped: look into it.", facts.gate_stopped)
        failures = CounterMetricFamily("binpick_camera_failures", "Failures of a camera.", labels=["camera"])
        for camera, count in facts.camera_failures.items():
            failures.add_metric([camera], count)
        yield failures
        yield CounterMetricFamily("binpick_pairs_refused", "Pairs refused: of no one instant, not whole, or not proved.",
                                  facts.pairs_refused)
        yield GaugeMetricFamily("binpick_frame_age_seconds", "Since the last trigger that gave a pair.", facts.frame_age_s)
        for name, sentence in CALIBRATION.items():
            if name in facts.calibration:
                yield GaugeMetricFamily(f"binpick_calibration_{name}", sentence, facts.calibration[name])
        yield GaugeMetricFamily("binpick_ready", "1 when a cycle would start now.", int(facts.ready))

    def describe(self) -> list[Metric]:
        """Nothing is asked at registration."""
        return []
