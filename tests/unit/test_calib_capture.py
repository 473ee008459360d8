"""Capture: a set that solves comes of a board that is moved about, with no key pressed; what is useless is not taken."""

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rich.console import Console

from binpick import rig
from binpick.errors import InputError
from binpick.rigcheck import board as boards
from binpick.rigcheck.coverage import Coverage
from binpick_calib import capture, cli, session
from binpick_calib.capture import Step
from binpick_calib.moments import Moment, of_folder
from binpick_calib.viewfinder import Viewfinder, picture

BOARD = boards.parse("chessboard:9x6:0.025")
Pairs = list[tuple[np.ndarray, np.ndarray]]


@pytest.fixture
def pairs(shown_board: Any) -> Pairs:
    """What a rig sees while somebody shows it a board at one place after the other."""
    return list(shown_board.pairs)


def run(monkeypatch: pytest.MonkeyPatch, *args: str) -> int:
    monkeypatch.setattr("sys.argv", ["binpick-calib", *args])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    return int(stopped.value.code or 0)


def test_what_a_folder_fills_up_with_is_captured_and_solves(shown_board: Any, pairs: Pairs, tmp_path: Path,
                                                            monkeypatch: pytest.MonkeyPatch,
                                                            capsys: pytest.CaptureFixture[str]) -> None:
    shots, out = tmp_path / "shots", tmp_path / "views"
    shots.mkdir()
    for number, both in enumerate([pairs[0], (np.full_like(pairs[0][0], 90),) * 2, *pairs], start=1):
        for name, image in zip(("l", "r"), both, strict=True):
            cv2.imwrite(str(shots / f"{name}{number}.png"), image)
    board = "chessboard:9x6:0.025"
    assert run(monkeypatch, "capture", "--board", board, "--out", str(out), "--left", str(shots / "l*.png"), "--right",
               str(shots / "r*.png")) == 0
    told = capsys.readouterr()
    assert "view 1 of 12: new: " in told.err
    assert "not taken: no camera sees the board (no board with 9x6 inner corners seen: the image is all one grey (90 to 90" in (
        told.err)
    assert "not taken: like view 1: move, tilt or turn the board" in told.err
    assert ": enough." in told.out
    command = told.out.split("Next: binpick-calib ")[1].replace("'", "").split()
    command[-1] = str(tmp_path / "rig.json")
    assert run(monkeypatch, *command, "--json") == 0
    solved = json.loads(capsys.readouterr().out)
    # the usual figures of drawn boards: corners to 0.03 px, f to 0.1 %, the baseline to 0.1 mm
    assert solved["views"] >= 12
    assert solved["unused"] == {}
    assert solved["rms_px"] < 0.06
    assert solved["row_error_px"] < 0.03
    assert solved["focal_px"]["left"] == pytest.approx([620, 622], rel=0.001)
    assert solved["baseline_m"] == pytest.approx(np.linalg.norm(shown_board.T_right_left[:3, 3]), abs=0.0001)
    assert rig.load(tmp_path / "rig.json")[0].image_size_px == shown_board.size


@pytest.mark.parametrize(("names", "said"), [
    ((), "no file is called so"),
    (("l1a.png", "l1b.png", "r1a.png", "r1b.png"), "two images of one side carry the same number"),
    (("l1.png", "r2.png"), "no left and right image carry the same number")])
def test_a_folder_that_gives_no_pair_says_why(names: tuple[str, ...], said: str, tmp_path: Path) -> None:
    for name in names:
        (tmp_path / name).touch()
    waiting = next(of_folder(str(tmp_path / "l*.png"), str(tmp_path / "r*.png")))
    assert isinstance(waiting, str)
    assert said in waiting
    told = io.StringIO()
    with Viewfinder(Console(file=told, width=300)) as finder:
        capture.capture(iter([waiting]), BOARD, tmp_path, Coverage(), finder.show)
    assert told.getvalue().startswith("waiting for images ")


def live(images: list[tuple[np.ndarray, np.ndarray] | None], dropped: list[str]) -> Iterator[Moment | str]:
    """Frames of moving cameras; None is where Ctrl-C is pressed."""
    for number, both in enumerate(images):
        if both is None:
            raise KeyboardInterrupt
        yield Moment(both, f"frame {number}", live=True, forget=lambda number=number: dropped.append(f"frame {number}"))


def test_live_a_board_that_moves_is_waited_for(pairs: Pairs, tmp_path: Path) -> None:
    first, second = pairs[:2]
    dropped: list[str] = []
    steps: list[Step] = []
    moments = live([first, first, first, second, second, None], dropped)
    covered = capture.capture(moments, BOARD, tmp_path, Coverage(), steps.append)
    assert [step.taken for step in steps] == [0, 1, 0, 0, 2]
    assert steps[0].said == "the board has just come into view"
    assert steps[3].said.startswith("the board moves: ")
    assert dropped == ["frame 0", "frame 2", "frame 3"]
    assert len(covered.views) == 2
    assert {path.name for path in tmp_path.iterdir()} == {"left_001.png", "left_002.png", "right_001.png", "right_002.png"}


def test_a_broken_off_capture_goes_on(pairs: Pairs, tmp_path: Path) -> None:
    capture.capture(live([pairs[0], pairs[0]], []), BOARD, tmp_path, Coverage(), lambda _: None)
    covered = capture.resumed(tmp_path, BOARD, Coverage())
    assert len(covered.views) == 1
    steps: list[Step] = []
    capture.capture(live([pairs[0], pairs[0], pairs[1], pairs[1]], []), BOARD, tmp_path, covered, steps.append)
    assert steps[1].said == "like view 1: move, tilt or turn the board"
    assert (tmp_path / "right_002.png").exists()
    assert session.closing(covered, tmp_path, "B")[1].endswith("The same command goes on after these.")


def test_a_terminal_shows_what_is_missing(pairs: Pairs) -> None:
    seen, _ = capture.look(pairs[0], BOARD)
    screen = Console(file=io.StringIO(), force_terminal=True, width=100, color_system=None)
    screen.print(picture(Step(Coverage().add(seen), "new: the middle of the left image", 1)))
    with Viewfinder(screen) as finder:
        finder.show(Step(Coverage().add(seen), "the board moves: 9 px since the last frame"))
    shown = screen.file.getvalue()      # type: ignore[attr-defined]
    assert "Views: 1 of 12" in shown
    assert "the upper left corner of the left image" in shown
    assert "▒▒▒" in shown
    assert "view 1 taken: new: the middle of the left image" in shown
    assert "the board moves: 9 px since the last frame" in shown


@pytest.mark.parametrize(("args", "said"), [
    ((), "say where the images come from"), (("--left", "a*.png"), "say where"),
    (("--url", "http://127.0.0.1:9"), "no daemon answers there"), (("--cell", "nowhere.yaml"), "cannot be read"),
    (("--left", "views/l*.png", "--right", "views/r*.png"), "a folder of its own")])
def test_bad_options(args: tuple[str, ...], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                     capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, "capture", "--board", "chessboard:9x6:0.025", "--out", "views", *args) == 2
    assert said in capsys.readouterr().err


def test_another_number_of_cameras_is_refused(pairs: Pairs, tmp_path: Path) -> None:
    three = Moment((*pairs[0], pairs[0][0]), "3", live=False)
    covered = capture.capture(iter([three]), BOARD, tmp_path, Coverage(), lambda _: None)
    assert covered.cameras == ("left", "right", "third")
    assert (tmp_path / "third_001.png").exists()
    with pytest.raises(InputError, match="2 images, but the views so far have 3"):
        capture.capture(iter([Moment(pairs[1], "2", live=False)]), BOARD, tmp_path, covered, lambda _: None)
