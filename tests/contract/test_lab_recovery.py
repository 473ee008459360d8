"""The bench of reconnects and the long run, as short ones: their figures are of the packets that really went."""

import io
import json
import sys

import pytest
from rich.console import Console

from binpick import cli
from binpick.lab import recovery, soak

pytestmark = [pytest.mark.gige, pytest.mark.slow]


def test_outages_are_timed() -> None:
    shares: list[float] = []
    run = recovery.run(3, shares.append)
    assert shares == pytest.approx([1 / 3, 2 / 3, 1])
    assert [(row["fault"], row["step"], row["times"]) for row in run["faults"]] == [
        ("unplug", "idle", 1), ("power=off", "idle", 1), ("reboot=1", "idle", 1)]
    for row in run["faults"]:
        assert 0 < row["found_median_s"] <= row["found_max_s"] < 10          # what the cell takes is tested with the faults
        assert 0 < row["back_median_s"] <= row["back_max_s"] < 15
    sheet = io.StringIO()
    Console(file=sheet, width=150).print(recovery.table(run))
    assert "3 reconnects, before: " in sheet.getvalue()


def test_a_long_run_reads_the_number_of_every_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(soak, "JUDGED", 12)
    run = soak.run(3.0, (640, 400))
    assert run["pairs"] + run["lost"] == 31
    assert (run["lost"], run["mispaired"], run["stale"], run["wrong_images"]) == (0, 0, 0, 0)
    assert 0 < run["rate_hz"] < 11
    sheet = io.StringIO()
    Console(file=sheet, width=150).print(soak.table(run))
    assert "mispaired" in sheet.getvalue()


def test_an_image_that_was_not_sent_so_is_wrong_and_compared_once() -> None:
    log = soak.Log()
    log.images.extend((0, 5, 111, 1, 5, 222))
    log.judge([{5: 111}, {5: 999}])
    log.judge([{}, {}])             # all that was sent is forgotten: so long a run may be
    assert log.wrong == 1


@pytest.mark.parametrize(("option", "value", "figure"), [("--reconnects", "1", "faults"), ("--soak", "1", "mispaired")])
def test_both_are_options_of_the_cameras_bench(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], option: str,
                                               value: str, figure: str) -> None:
    monkeypatch.setattr(sys, "argv", ["binpick", "bench", "cameras", option, value, "--json"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert not ended.value.code
    assert figure in json.loads(capsys.readouterr().out)
