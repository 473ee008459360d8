"""The bench of the camera pair: its figures come from the simulator's truth, image by image."""

import io

import pytest
from rich.console import Console

from binpick.lab import cameras
from binpick.lab.cameras import Trial
from binpick.lab.rig import SMALL

pytestmark = pytest.mark.gige


def test_a_series_is_judged_by_what_the_cameras_did() -> None:
    trials = [Trial("injected", "action", 6, SMALL, skew_us=2500.0, max_skew_us=1e6),
              Trial("lost", "software", 6, SMALL, apart=True, loss=0.2, packet_size=1500, max_skew_us=1e6)]
    injected, lost = rows = list(cameras.run(trials))
    for row in rows:
        assert (row["accepted"], row["wrong_images"], row["lost"]) == (6, 0, 0)
        assert row["within_3_sigma"] == 1.0
        assert 0 < row["arrival_ms"]["p50"] <= row["arrival_ms"]["p95"]
    assert (injected["proofs"], injected["resends"]) == ({"ptp": 6}, 0)
    assert injected["sigma_us"]["max"] < 2
    assert lost["proofs"] == {"latch": 6}
    assert lost["resends"] > 100
    sheet = io.StringIO()
    Console(file=sheet, width=200).print(cameras.table(rows))
    assert "6 of 6" in sheet.getvalue()


def test_the_programme_covers_every_mode_skew_and_loss() -> None:
    names = [trial.name for trial in cameras.programme(500)]
    assert names == ["line", "scheduled_action", "action", "software", "0 µs, PTP", "50 µs, PTP", "500 µs, PTP", "5000 µs, PTP",
                     "0 µs, apart", "50 µs, apart", "500 µs, apart", "5000 µs, apart", "1% lost", "5% lost", "20% lost"]
