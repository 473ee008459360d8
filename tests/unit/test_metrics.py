"""The text Prometheus reads."""

import math
from dataclasses import replace

from binpick.metrics import Facts, Metrics


def sample(text: str, name: str) -> float:
    return float(next(line for line in text.splitlines() if line.startswith(name + " ")).rsplit(" ", 1)[1])


def facts() -> Facts:
    return Facts(refused=2, late=1, gate_stopped=4, camera_failures={"left": 3, "right": 0}, frame_age_s=1.5, ready=True,
                 pairs_refused=5)


def test_counts_cycles_by_code_and_times_every_stage() -> None:
    metrics = Metrics(facts)
    metrics.finished(0, "ok", {"match": 120.0, "total": 250.0})
    metrics.finished(0, "ok", {"match": 80.0, "total": 150.0})
    metrics.finished(-4, "cameras", {})
    text = metrics.text().decode()
    assert sample(text, 'binpick_cycles_total{code="0",name="ok"}') == 2
    assert sample(text, 'binpick_cycles_total{code="-4",name="cameras"}') == 1
    assert sample(text, 'binpick_stage_seconds_count{stage="match"}') == 2
    assert math.isclose(sample(text, 'binpick_stage_seconds_sum{stage="total"}'), 0.4)
    assert sample(text, 'binpick_stage_seconds_bucket{le="0.1",stage="match"}') == 1


def test_asks_the_cell_at_every_scrape() -> None:
    now = [facts()]
    metrics = Metrics(lambda: now[0])
    text = metrics.text().decode()
    assert sample(text, "binpick_refused_total") == 2
    assert sample(text, "binpick_late_total") == 1
    assert sample(text, "binpick_gate_stopped_total") == 4
    assert sample(text, 'binpick_camera_failures_total{camera="left"}') == 3
    assert sample(text, "binpick_pairs_refused_total") == 5
    assert sample(text, "binpick_frame_age_seconds") == 1.5
    assert sample(text, "binpick_ready") == 1
    now[0] = Facts(refused=3, late=1, gate_stopped=4, camera_failures={}, frame_age_s=math.nan, ready=False)
    text = metrics.text().decode()
    assert sample(text, "binpick_refused_total") == 3
    assert math.isnan(sample(text, "binpick_frame_age_seconds"))
    assert sample(text, "binpick_ready") == 0


def test_what_the_watchdog_could_not_measure_is_absent() -> None:
    now = replace(facts(), calibration={"level": 1.0, "row_px": -0.4})
    text = Metrics(lambda: now).text().decode()
    assert sample(text, "binpick_calibration_level") == 1
    assert sample(text, "binpick_calibration_row_px") == -0.4
    assert "binpick_calibration_marks" not in text
    assert "binpick_calibration" not in Metrics(facts).text().decode()


def test_two_apps_in_one_process_do_not_meet() -> None:
    first, second = Metrics(facts), Metrics(facts)
    first.finished(0, "ok", {})
    assert b'binpick_cycles_total{' not in second.text()
