"""The page's words and panels for every state and code, without a browser."""

from dataclasses import replace
from html.parser import HTMLParser

import pytest

from binpick import health
from binpick.calibration import Progress, Sample, SampleAnswer, Sighting
from binpick.data import CameraStatus
from binpick.errors import Code
from binpick.message import CalibrationMessage, Level, MarksMessage
from binpick.publish.dashboard import panels, trend, views, words
from binpick.result import (
    BinMessage,
    Drift,
    Funnel,
    GraspMessage,
    PoseMessage,
    Published,
    Request,
    Result,
    ReturnCode,
    Sigma,
    Snapshot,
    SyncMessage,
    ToolMessage,
    failure,
)

CAMERAS = tuple(CameraStatus(name, True, "Alvium G1-240m", f"SN{name}", "169.254.1.2", ptp="Slave", ptp_offset_us=-0.2)
                for name in ("left", "right"))
PANELS = (panels.result, panels.grasps, panels.funnel, panels.timings, panels.cameras, panels.counts)


class Text(HTMLParser):
    """What a person reads; fails on a tag that is not closed."""

    def __init__(self, markup: str) -> None:
        super().__init__()
        self.words: list[str] = []
        self.open: list[str] = []
        self.feed(markup)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    @property
    def all(self) -> str:
        return " ".join(self.words)


def published(code: Code, grasps: int = 0, tool: str = "suction") -> Published:
    pose = PoseMessage(position_m=(0.1, -0.2, 0.3), quaternion_xyzw=(0, 0, 0, 1))
    result = Result(
        cycle_id=12, request=Request(), captured_at="2026-01-02T03:04:05Z", return_code=ReturnCode.of(code),
        bin=BinMessage(found=True, number=1, T_camera_bin=None, fill_level=0.34, coverage=0.9),
        grasps=tuple(GraspMessage(
            id=f"12-{n}", rank=n, tool=ToolMessage(number=1, name=tool, kind="suction"), frame="base", T_frame_pregrasp=pose,
            approach_m=0.1, lift_m=0.1, open_m=0, close_m=0, quality=0.9, sigma=Sigma(xy_m=0.0004, z_m=0.0002, tilt_rad=0.01),
            clearance_m=0.01, part_id=n, **pose.model_dump()) for n in range(1, grasps + 1)),
        funnel=Funnel(counts={"faces": 4, "no_seal": 9, "gate_novel": 1, "collide": 0}, dominating="no_seal"),
        sync=SyncMessage(skew_us=12.4, sigma_us=1, proof="ptp", resends=0, missing=0),
        timing_ms={"acquire": 20.0, "match": 100.0, "compute": 100.0, "total": 120.0})
    return Published(result, b"", 1)


def snapshot(latest: Published | None = None) -> Snapshot:
    return Snapshot(boot_id=1, phase="ready", cameras=CAMERAS, owner="modbus", latest=latest, valid=latest is not None,
                    published=latest, counts=(("finished", 12), ("refused", 3)))


@pytest.mark.parametrize("code", list(Code))
def test_every_panel_shows_every_code(code: Code) -> None:
    for latest in (published(code, grasps=8 if code.carries_poses else 0),
                   Published(failure(12, Request(), code), b"", 1)):
        shown = " ".join(Text(panel(snapshot(latest))).all for panel in PANELS)
        assert code.message in shown
        assert "cycle 12" in shown


def test_a_cell_without_a_cycle_says_so() -> None:
    shown = " ".join(Text(panel(snapshot())).all for panel in PANELS)
    assert "No cycle has run yet." in shown
    assert "first cycle" in Text(panels.caption(None, 0)).all


def test_grasps_are_in_millimetres_and_the_rest_is_counted() -> None:
    shown = Text(panels.grasps(snapshot(published(Code.OK, 8)))).all
    assert "mm in frame base" in shown
    assert "100.0" in shown
    assert "−200.0" in shown
    assert f"and {8 - panels.ROWS} more" in shown


def test_the_funnel_names_the_reason_and_leaves_out_what_took_nothing() -> None:
    markup = panels.funnel(snapshot(published(Code.NOTHING_GRASPABLE)))
    assert 'class="loss top"><span>too uneven to seal' in markup
    shown = Text(markup).all
    assert "Why no grasp" in shown
    assert "gate novel" in shown
    assert words.stage("collide") not in shown


def looked(cells: list[list[int | None]], missing: tuple[str, ...],
           reason: str = "new: the middle of the left image") -> Snapshot:
    sightings = tuple(Sighting(camera=name, found=True, points=54) for name in ("left", "right"))
    sample = Sample(id=5, captured_at="2026-01-02T03:04:05Z", board="chessboard:9x6:0.025", simulated=False, rig_sha256="",
                    cameras_sha256="", T_base_flange=None, sightings=sightings, useful=True, reason=reason)
    coverage = {"views": 5, "wanted": 12, "cells": {"left": cells, "right": cells}}
    answer = SampleAnswer(sample=sample, progress=Progress(enough=not missing, missing=missing, coverage=coverage))
    return snapshot(replace(published(Code.OK), sample=answer))


def test_views_of_a_board_take_the_place_of_grasps() -> None:
    shown = Text(views.panel(looked([[None, 0, 3]], ("the left edge of the left image", "b", "c", "d", "e")))).all
    assert "Views of the board: 5 of 12" in shown
    assert "new: the middle of the left image" in shown
    assert "the left edge of the left image" in shown
    assert "and 1 more" in shown
    markup = views.panel(looked([[None, 0, 3]], ()))
    assert '<i class="out"></i><i class="open"></i><i class="seen">3</i>' in markup
    assert "Enough" in Text(markup).all
    assert views.panel(snapshot(published(Code.OK, 1))) == ""
    assert views.panel(snapshot()) == ""
    assert "<img" not in views.panel(looked([[0]], ("<img src=x>",), reason="<img src=x>"))


def test_what_came_from_outside_is_escaped() -> None:
    evil = '<img src=x onerror="alert(1)">'
    latest = published(Code.OK, 1, tool=evil)
    latest = replace(latest, result=latest.result.model_copy(update={"return_code": ReturnCode.of(Code.OK, evil)}))
    shown = replace(snapshot(latest), cameras=(replace(CAMERAS[0], error=evil, model=evil, name=evil),), withdrawn=evil,
                    valid=False)
    markup = "".join(panel(shown) for panel in PANELS) + panels.banner(words.Banner(evil, "bad", evil), shown)
    assert "<img" not in markup
    assert "&lt;img" in markup


def test_the_banner_tells_the_state_and_its_reason() -> None:
    def told(shown: Snapshot) -> words.Banner:
        return words.banner(shown, health.judge(shown))

    ready = snapshot()
    assert told(ready) == words.Banner("READY", "good", "waiting for a trigger over Modbus/TCP")
    assert "control" in told(replace(ready, owner="none")).reason
    assert told(replace(ready, phase="acquiring", current=3)).word == "CAPTURING"
    assert told(replace(ready, phase="computing", current=3)).reason.startswith("cycle 3")
    down = replace(ready, phase="starting", cameras=(replace(CAMERAS[0], connected=False, error="no answer"), CAMERAS[1]))
    assert told(down) == words.Banner("FAULT", "bad", "camera left is down: no answer")
    assert told(replace(ready, phase="starting", cameras=())).word == "STARTING"
    assert told(replace(ready, faults=("internal error, see the log",))).tone == "warn"
    assert told(replace(down, phase="stopping")).tone == "off"


def said(level: Level, row_px: float | None = 0.42, marks: MarksMessage | None = None) -> CalibrationMessage:
    return CalibrationMessage(level=level, sentence="Rows are off.", row_px=row_px, row_sigma_px=0.01, points=90, off_px=0.42,
                              change_px=None, marks=marks)


@pytest.mark.parametrize(("level", "words_", "tone"), [("ok", "holds", "good"), ("warn", "has drifted", "warn"),
                                                       ("fault", "cannot be trusted", "bad")])
def test_the_calibration_has_a_word_and_a_curve(level: Level, words_: str, tone: str) -> None:
    rows = tuple(0.01 * n for n in range(43))
    known = Drift(level=level, latest=said(level), row_px=rows, cycle_ids=tuple(range(43)))
    markup = trend.panel(replace(snapshot(), drift=known))
    shown = Text(markup).all
    assert words_ in shown
    assert "rows +0.42 px · no reference marks" in shown
    assert f'class="camera {tone}"' in markup
    assert markup.count(",") >= len(rows)
    assert markup.count("<line ") == 4


def test_the_calibrations_panel_says_what_is_not_known() -> None:
    assert trend.panel(snapshot()) == ""
    shown = Text(trend.panel(replace(snapshot(), drift=Drift(marks="to be stored")))).all
    assert "Calibration not looked at yet" in shown
    assert "rows not measured · reference marks not stored" in shown
    one = Drift(latest=said("ok", None), row_px=(0.1,), cycle_ids=(1,), marks="stored")
    assert "reference marks not seen" in Text(trend.panel(replace(snapshot(), drift=one))).all
    marks = MarksMessage(seen=6, shift_m=0.0014, turn_rad=0.0, pitch_rad=0.0, yaw_rad=0.0, roll_rad=0.0, depth_m=0.0)
    moved = replace(one, latest=said("warn", -0.1, marks))
    assert "rows −0.10 px · 6 marks, moved 1.40 mm" in Text(trend.panel(replace(snapshot(), drift=moved))).all


def test_a_result_that_was_taken_back_says_why() -> None:
    shown = replace(snapshot(published(Code.OK, 1)), valid=False, withdrawn="older than 500 ms")
    assert "no longer valid: older than 500 ms" in Text(panels.result(shown)).all


@pytest.mark.parametrize(("seconds", "told"), [(0.2, "now"), (5.4, "5 s ago"), (600.0, "10 min ago"), (9000.0, "2 h ago")])
def test_ages_are_no_finer_than_one_reads_them(seconds: float, told: str) -> None:
    assert words.age(seconds) == told
