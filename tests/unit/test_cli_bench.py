"""`binpick bench` is the whole exam; its parts are commands below it."""

import json
import sys

import pytest

from binpick import cli


def call(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["binpick", "bench", *arguments])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return int(ended.value.code or 0)


def test_the_whole_exam_keeps_its_options_and_names_its_parts(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "200")
    assert call(monkeypatch, "--help") == 0
    says = capsys.readouterr().out
    assert "exam" in says
    assert "grasp" in says
    assert "stereo" in says
    assert call(monkeypatch, "exam", "--help") == 0
    says = capsys.readouterr().out
    for word in ("--world", "--scenes", "--cycles", "--textbook", "--tuning", "--modbus", "--json"):
        assert word in says
    assert call(monkeypatch, "--modbus", "here") == call(monkeypatch, "exam", "--modbus", "here") == 2
    assert capsys.readouterr().err.count("HOST:PORT") == 2


@pytest.mark.parametrize(("part", "options"), [
    ("stereo", ("--world", "--scenes", "--tuning", "--repeats", "--middlebury", "--out", "--json")),
    ("drift", ("--world", "--only", "--calm", "--plain", "--tuning", "--json")),
    ("cameras", ("--pairs", "--only", "--reconnects", "--soak", "--json")),
    ("grasp", ("--world", "--scenes", "--parts", "--clear", "--gate", "--full", "--folder", "--film", "--tuning", "--json")),
])
def test_the_other_parts_have_their_own(monkeypatch, capsys, part, options):
    monkeypatch.setenv("COLUMNS", "200")
    assert call(monkeypatch, part, "--help") == 0
    says = capsys.readouterr().out
    for word in options:
        assert word in says


@pytest.mark.parametrize(("arguments", "says"), [
    (("--tuning", "stereo"), "unexpected extra argument"),
    (("stereo", "--world", "C"), "A, B and all"),
    (("grasp", "--world", "C"), "no exam world 'C'"),
    (("grasp", "--gate", "--full"), "give one of them"),
    (("drift", "--world", "C"), "A, B and all"),
    (("drift", "--only", "wind"), "pitch 0.15 px, pitch 0.25 px"),
    (("cameras", "--reconnects", "3", "--soak", "3"), "give one of them"),
    (("grasp", "--film", "bin.gif"), "a film is a .webp file"),
    (("stereo", "--middlebury", "nowhere"), "no Middlebury scenes"),
])
def test_what_cannot_be_is_one_line(monkeypatch, capsys, arguments, says):
    assert call(monkeypatch, *arguments) == 2
    assert says in capsys.readouterr().err


def test_a_run_without_scenes_of_the_exam_is_json(monkeypatch):
    from binpick.lab import sitting

    run = sitting.run([], [1], 1, None, lambda sheet: None)
    assert list(json.loads(json.dumps(run))) == ["exam_sha256", "seeds", "repeats", "threads", "series", "middlebury"]
