"""Printed boards: what is on the page, drawn again from the file alone, is found again at its true scale."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from binpick.rigcheck import sight
from binpick.rigcheck.board import parse
from binpick.rigcheck.detection import Detection
from binpick_calib import cli

PX_PER_MM = 4
NUMBER = r"(-?[\d.]+)"


def run(monkeypatch: pytest.MonkeyPatch, *args: str) -> int:
    """The exit code of `binpick-calib board`."""
    monkeypatch.setattr("sys.argv", ["binpick-calib", "board", *args])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    return int(stopped.value.code or 0)


def fill(page: np.ndarray, outline_mm: np.ndarray) -> None:
    """Black inside an outline; the page's pixel centres stand half a pixel in."""
    cv2.fillPoly(page, [np.rint((outline_mm * PX_PER_MM - 0.5) * 256).astype(np.int32)], 0, shift=8)


def disc(x: float, y: float, radius: float) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    return np.column_stack([x + radius * np.cos(angle), y + radius * np.sin(angle)])


def box(x: float, y: float, width: float, height: float) -> np.ndarray:
    return np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]])


def draw_svg(text: str) -> np.ndarray:
    width, height = (float(side) for side in re.search(rf'viewBox="0 0 {NUMBER} {NUMBER}"', text).groups())
    assert f'width="{width:g}mm" height="{height:g}mm"' in text
    page = np.full((round(height * PX_PER_MM), round(width * PX_PER_MM)), 255, np.uint8)
    for found in re.finditer(rf"M{NUMBER} {NUMBER}h{NUMBER}v{NUMBER}h{NUMBER}z", text):
        fill(page, box(*map(float, found.groups()[:4])))
    for found in re.finditer(rf"M{NUMBER} {NUMBER}a{NUMBER} ", text):
        x, y, radius = map(float, found.groups())
        fill(page, disc(x + radius, y, radius))
    return page


def draw_pdf(data: bytes) -> np.ndarray:
    text = data.decode("latin-1")
    start = int(re.search(r"startxref\n(\d+)", text)[1])
    for number, begin in enumerate(re.findall(r"(\d{10}) 00000 n", text[start:]), start=1):
        assert text[int(begin):].startswith(f"{number} 0 obj"), "the table says where each object begins"
    stream = re.search(r"/Length (\d+) >>\nstream\n(.*)\nendstream", text, re.DOTALL)
    assert len(stream[2]) == int(stream[1])
    box_pt = [float(side) for side in re.search(rf"MediaBox \[0 0 {NUMBER} {NUMBER}\]", text).groups()]
    scale, mirrored, top = map(float, re.match(rf"{NUMBER} 0 0 {NUMBER} 0 {NUMBER} cm", stream[2]).groups())
    assert scale == pytest.approx(72 / 25.4)
    assert mirrored == -scale
    assert top == pytest.approx(box_pt[1], abs=1e-3)
    page = np.full((round(box_pt[1] / scale * PX_PER_MM), round(box_pt[0] / scale * PX_PER_MM)), 255, np.uint8)
    for found in re.finditer(rf"^{NUMBER} {NUMBER} {NUMBER} {NUMBER} re$", stream[2], re.MULTILINE):
        fill(page, box(*map(float, found.groups())))
    curve = rf"(?:{NUMBER} {NUMBER} {NUMBER} {NUMBER} {NUMBER} {NUMBER} c\n)"
    for found in re.finditer(rf"{NUMBER} {NUMBER} m\n{curve}{curve}{curve}{curve}h", stream[2]):
        numbers = np.array(found.groups(), dtype=float).reshape(-1, 2)
        share = np.linspace(0, 1, 16, endpoint=False)[:, None]
        outline = [(1 - share)**3 * numbers[i] + 3 * share * (1 - share)**2 * numbers[i + 1]
                   + 3 * share**2 * (1 - share) * numbers[i + 2] + share**3 * numbers[i + 3] for i in (0, 3, 6, 9)]
        fill(page, np.concatenate(outline))
    return page


@pytest.mark.parametrize("ending", ["svg", "pdf"])
@pytest.mark.parametrize(("spec", "page", "said"), [
    ("chessboard:9x6:0.025", "a4", "chessboard:9x6:0.025"), ("charuco:9x6:0.025", "a4", "charuco:9x6:0.025:0.01875:5x5_1000"),
    ("charuco:7x8:0.03:0.022:apriltag_36h11", "A3", "charuco:7x8:0.03:0.022:apriltag_36h11"),
    ("circles:9x7:0.02", "a4", "circles:9x7:0.02:0.012"), ("acircles:4x11:0.015", "250x250", "acircles:4x11:0.015:0.012")])
def test_a_printed_board_is_found_again_at_its_size(spec: str, page: str, said: str, ending: str, tmp_path: Path,
                                                    monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / f"board.{ending}"
    assert run(monkeypatch, "--board", spec, "--out", str(out), "--page", page) == 0
    data = out.read_bytes()
    assert f"--board {said}".encode() in data
    drawn = draw_svg(data.decode()) if ending == "svg" else draw_pdf(data)
    seen = sight.find(cv2.GaussianBlur(drawn, None, 0.8), parse(said))
    assert isinstance(seen, Detection), seen
    assert len(seen.ids) == len(parse(spec).points_m)
    # every point lies where the board says, to 0.03 mm (an eighth of a pixel here), and the right way round
    places_mm = (seen.corners_px + 0.5) / PX_PER_MM
    assert np.abs(places_mm - places_mm[0] - 1000 * (seen.points_m - seen.points_m[0])[:, :2]).max() < 0.03
    ruler = drawn[round(drawn.shape[0] - 20 * PX_PER_MM)]
    assert np.flatnonzero(ruler < 128).size == pytest.approx(100 * PX_PER_MM, abs=2)
    before = out.read_bytes()
    run(monkeypatch, "--board", spec, "--out", str(out), "--page", page)
    assert out.read_bytes() == before


@pytest.mark.parametrize(("change", "said"), [
    ({"page": "a9"}, "give a4, a3"), ({"board": "chessboard:9x6:0.04"}, "400 x 280 mm needs 412 x 312 mm; --page a2 holds it"),
    ({"board": "chessboard:20x19:0.5"}, "no known page holds it"),
    ({"out": "board.png"}, "a .pdf or an .svg"),
    ({"out": "missing/board.pdf"}, "cannot be written")])
def test_bad_input_is_one_line_and_exit_code_2(change: dict[str, str], said: str, tmp_path: Path,
                                               monkeypatch: pytest.MonkeyPatch,
                                               capsys: pytest.CaptureFixture[str]) -> None:
    options = {"board": "chessboard:9x6:0.025", "page": "a4", "out": "board.pdf"} | change
    options["out"] = str(tmp_path / options["out"])
    assert run(monkeypatch, *(part for name, value in options.items() for part in (f"--{name}", value))) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert said in lines[0]
