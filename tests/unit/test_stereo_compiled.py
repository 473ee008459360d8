"""Compiled functions answer as Python does, also where nothing can be kept on disk."""

import logging
import types

import pytest

from binpick.stereo import compiled as module
from binpick.stereo.compiled import compiled


def ratio(a: float, b: float) -> float:
    return a / b


def test_dividing_by_zero_is_infinity() -> None:
    assert compiled(ratio)(1.0, 0.0) == float("inf")


def test_what_cannot_be_kept_is_compiled_anew_and_said(caplog: pytest.LogCaptureFixture) -> None:
    nowhere = types.FunctionType(ratio.__code__.replace(co_filename="/proc/nowhere.py"), {}, "ratio")
    with caplog.at_level(logging.WARNING):
        assert compiled(nowhere)(1.0, 4.0) == 0.25
    assert "cannot be kept, starting takes longer" in caplog.text


def test_what_was_kept_is_void_when_any_module_of_the_package_changed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Functions contain those that they call: of another file, which may be all that changed."""
    compiled(ratio)(1.0, 4.0)
    kept = compiled(ratio)
    kept(1.0, 4.0)
    monkeypatch.setattr(module, "SOURCES", "others")
    anew = compiled(ratio)
    anew(1.0, 4.0)
    assert [sum(each.stats.cache_hits.values()) for each in (kept, anew)] == [1, 0]
