"""The report: one page without a link, whose figures are the rig's, and which says what was not used and what to do better."""

import json
import re
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import printed
from binpick import geometry, rig
from binpick.errors import InputError
from binpick.geometry import epipolar
from binpick.rig import Rig
from binpick.rigcheck import sight
from binpick.rigcheck.board import parse
from binpick.rigcheck.detection import Detection
from binpick_calib import advice, cli, outlook, residuals, solve, views
from binpick_calib.report import page

BOARD = parse("chessboard:9x6:0.025")
SIZE = (640, 480)
K = np.array([[620.0, 0, 322], [0, 620, 238], [0, 0, 1]])
T_RIGHT = geometry.make(Rotation.from_euler("xyz", [0.4, 8, 0.8], degrees=True).as_matrix(), np.array([-0.12, 0.001, 0.012]))
CHROMIUM = Path("/usr/bin/chromium")


def photograph(T_camera_board: np.ndarray) -> np.ndarray:
    return printed.seen(printed.chessboard(BOARD.columns, BOARD.rows), BOARD.square_m, K, T_camera_board, SIZE, 2, 1.5)


@dataclass(frozen=True)
class Made:
    """A set with one blurred image and one board that moved, solved; its page, and the one made of the rig file."""

    folder: Path
    rig: Rig
    html: str
    again: str


def calib(monkeypatch: pytest.MonkeyPatch, *args: str) -> int:
    monkeypatch.setattr("sys.argv", ["binpick-calib", *args])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    return int(stopped.value.code or 0)


def sides(folder: Path) -> list[str]:
    return ["--left", str(folder / "left*.png"), "--right", str(folder / "right*.png")]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    folder = tmp_path_factory.mktemp("report")
    random = np.random.default_rng(5)
    for number in range(1, 11):
        R = Rotation.from_euler("zyx", [random.uniform(-20, 20), *random.uniform(-30, 30, 2)], degrees=True).as_matrix()
        middle = np.array([0.02 + random.uniform(-0.06, 0.06), random.uniform(-0.05, 0.05), random.uniform(0.45, 0.6)])
        T = geometry.make(R, middle - R @ BOARD.points_m.mean(0).astype(float))
        left, right = photograph(T), photograph(T_RIGHT @ T)
        right = np.roll(right, 4, axis=1) if number == 4 else right
        cv2.imwrite(str(folder / f"left{number}.png"), cv2.GaussianBlur(left, None, 2) if number == 7 else left)
        cv2.imwrite(str(folder / f"right{number}.png"), right)
    patch, rig_file = pytest.MonkeyPatch(), folder / "rig.json"
    assert calib(patch, "solve", *sides(folder), "--board", str(BOARD), "--out", str(rig_file), "--json", "--report",
                 str(folder / "solved.html")) == 0
    assert calib(patch, "report", "--rig", str(rig_file), *sides(folder), "--out", str(folder / "report.html")) == 0
    patch.undo()
    solved = rig.load(rig_file)[0]
    assert solved.quality is not None
    return Made(folder, solved, (folder / "solved.html").read_text(), (folder / "report.html").read_text())


def test_the_page_stands_alone(made: Made) -> None:
    assert made.html == made.again, "the rig file and its images tell all that solving knew"
    words, pictures = re.subn(r"data:image/png;base64,[A-Za-z0-9+/]+=*", "held", made.html)
    assert pictures == page.PAIRS + 3
    assert set(re.findall(r"""(?:src|href)\s*=\s*["']?([^"'\s>]*)""", words)) == {"held"}
    assert not re.findall(r"http|//|url\(|@import|<script|<link", words)


def tile(html: str, name: str) -> str:
    return str(re.findall(f'<b id="{name}">([^<]*)</b>', html)[0])


def test_its_figures_are_the_rigs(made: Made) -> None:
    quality, (left, right) = made.rig.quality, made.rig.cameras
    assert tile(made.html, "rms_px") == f"{quality.rms_px:.3f} px"
    assert tile(made.html, "row_px") == f"{quality.row_error_px:.3f} px"
    assert tile(made.html, "baseline_m") == f"{1000 * np.linalg.norm(right.T_camera_rig[:3, 3]):.2f} mm"
    assert tile(made.html, "focal_px") == f"{left.K[0][0]:.1f}, {right.K[0][0]:.1f} px"
    assert tile(made.html, "views") == str(len(quality.per_view_px)) == "8"
    assert f"{left.K[0][0]:.2f} ± {quality.sigma['left.fx_px']:.2f}" in made.html
    told = {name: np.array(json.loads(f"[{text}]"))[0] if text.startswith("[[") else np.array(json.loads(text))
            for name, text in re.findall(r'<pre data-name="([^"]*)">([^<]*)</pre>', made.html)}
    assert list(told) == [*(f"{what} {side}" for side in ("left", "right") for what in ("K", "distortion")),
                          "R", "T", "E", "F", "R1", "R2", "P1", "P2", "Q"]
    assert told["K right"] == pytest.approx(right.K_px)
    assert told["T"] == pytest.approx(right.T_camera_rig[:3, 3])
    assert told["E"] == pytest.approx(epipolar.essential(right.T_camera_rig), abs=1e-9)
    # Q is what a rectified pixel and its disparity become a point by
    z = 0.5
    disparity = told["P1"][0, 0] * np.linalg.norm(told["T"]) / z
    point = told["Q"] @ [told["P1"][0, 2], told["P1"][1, 2], disparity, 1]
    assert point[2] / point[3] == pytest.approx(z, rel=1e-6)


def test_what_was_not_used_is_shown_with_the_reason(made: Made) -> None:
    shown = re.findall(r'<li><div class="prints">(.*?)</div><b>([^<]*)</b> ([^<]*)</li>', made.html)
    assert [(names, reason.split(":")[0], prints.count("<img")) for prints, names, reason in shown] == [
        ("left7.png", "blurred", 1), ("left4.png, right4.png", "the board moved between the two images", 2)]


def test_other_images_than_the_rigs_are_told(made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                             capsys: pytest.CaptureFixture[str]) -> None:
    camera = made.rig.cameras[0]
    longer = tuple(tuple(1.01 * value if row == column and row < 2 else value for column, value in enumerate(values))
                   for row, values in enumerate(camera.K))
    other = made.rig.model_copy(update={"cameras": (camera.model_copy(update={"K": longer}), made.rig.cameras[1])})
    (tmp_path / "rig.json").write_bytes(rig.dump(other))
    out = tmp_path / "report.html"
    assert calib(monkeypatch, "report", "--rig", str(tmp_path / "rig.json"), *sides(made.folder), "--out", str(out)) == 0
    assert "other parameters than the rig file" in out.read_text()
    assert float(tile(out.read_text(), "rms_px").split()[0]) > 3 * made.rig.quality.rms_px
    assert "other parameters than the rig file" not in made.html

    (tmp_path / "rig.json").write_bytes(rig.dump(made.rig.model_copy(update={"board": None})))
    assert calib(monkeypatch, "report", "--rig", str(tmp_path / "rig.json"), *sides(made.folder), "--out", str(out)) == 2
    assert "give --board" in capsys.readouterr().err
    small = made.rig.model_copy(update={"image_size_px": (320, 240)})
    (tmp_path / "rig.json").write_bytes(rig.dump(small))
    assert calib(monkeypatch, "report", "--rig", str(tmp_path / "rig.json"), *sides(made.folder), "--out", str(out)) == 2
    assert "the images have 640x480 px, the rig file is for 320x240" in capsys.readouterr().err


@pytest.fixture(scope="module")
def fit(made: Made) -> residuals.Residuals:
    """Of the first views only: what is missing then?"""
    shots, _ = views.match(str(made.folder / "left*.png"), str(made.folder / "right*.png"))
    seen = views.detect([shot for shot in shots if shot.number not in (4, 7)], BOARD)
    return residuals.of(made.rig, seen, BOARD)


def test_advice_says_what_is_missing_and_what_no_image_tells(made: Made, fit: residuals.Residuals) -> None:
    ahead = outlook.of(fit.fitted, SIZE, np.linspace(0.4, 1.0, 4))
    told = advice.of(made.rig, fit, ahead)
    assert any("4 more views: there are 8 of 12" in sentence for sentence in told)
    rows = replace(fit, rows=replace(fit.rows, down_px=fit.rows.down_px + 0.6))
    assert advice.of(made.rig, rows, ahead)[0].startswith("Rows differ by 0.6")
    assert any("vertical axis" in sentence for sentence in advice.untold(fit, BOARD, 0.5))


def test_depth_errors_follow_distance(fit: residuals.Residuals) -> None:
    ahead = outlook.of(fit.fitted, SIZE, np.array([0.5, 1.0]))
    assert ahead.matching_m[0] == pytest.approx(0.5**2 * outlook.MATCHED_PX / (620 * 0.1206), rel=0.02)
    assert ahead.matching_m[1] == pytest.approx(4 * ahead.matching_m[0])
    assert (ahead.worst_m >= ahead.middle_m).all()
    assert ahead.middle_m[1] > ahead.middle_m[0] > 0
    # half a pixel of turn about the vertical axis is half a pixel of disparity, near enough
    assert outlook.blind_m(fit.fitted, 0.5, 0.5 / 620) == pytest.approx(5 * ahead.matching_m[0], rel=0.05)


def test_residuals_of_images_the_rig_was_not_made_of_are_refused(made: Made) -> None:
    shots, _ = views.match(str(made.folder / "left*.png"), str(made.folder / "right*.png"))
    seen = views.detect(shots, BOARD)
    rejecting = made.rig.quality.model_copy(update={"rejected": {f"left{n}.png": "seen double" for n in range(1, 8)}})
    with pytest.raises(InputError, match="3 of the views that the rig was made of"):
        residuals.of(made.rig.model_copy(update={"quality": rejecting}), seen, BOARD)


def test_three_cameras_are_told_apart(made: Made) -> None:
    third = geometry.make(np.eye(3), np.array([-0.05, 0.0, 0.0]))
    camera = made.rig.cameras[0].model_copy(update={"name": "camera3", "T_cam_rig": tuple(map(tuple, third.tolist()))})
    shots, used = [], []
    for number, place in enumerate(np.linspace(-0.03, 0.06, 7), start=1):
        R = Rotation.from_euler("xyz", [20 * (-1)**number, 25 * np.sin(2 * number), 4], degrees=True).as_matrix()
        T = geometry.make(R, np.array([place, 0.0, 0.5]) - R @ BOARD.points_m.mean(0).astype(float))
        found = [sight.find(photograph(step @ T), BOARD) for step in (np.eye(4), T_RIGHT, third)]
        assert all(isinstance(one, Detection) for one in found)
        shots.append(views.Shot(number, tuple(Path(f"{side}{number}.png") for side in views.sides(3))))
        used.append(views.view(shots[-1], BOARD, found))
    rig_of_three = solve.solve(views.Views(SIZE, tuple(used), {}), BOARD, "2026-01-01").rig
    fitted = residuals.of(rig_of_three, views.Views(SIZE, tuple(used), {}), BOARD)
    html = page.of(rig_of_three, fitted, BOARD, shots)
    assert len(fitted.misses) == 3
    assert html.count('class="map"') == 6
    assert rig_of_three.cameras[2].T_camera_rig[:3, 3] == pytest.approx(camera.T_camera_rig[:3, 3], abs=0.001)


@pytest.mark.browser
@pytest.mark.slow
@pytest.mark.skipif(not CHROMIUM.exists(), reason="needs Debian's chromium")
def test_a_browser_shows_and_prints_it(made: Made) -> None:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=["--no-sandbox", "--disable-gpu"])
        tab = browser.new_page(viewport={"width": 1280, "height": 900})
        asked: list[str] = []
        tab.on("request", lambda request: asked.append(request.url.split(":")[0]))
        tab.goto((made.folder / "solved.html").as_uri())
        assert tab.locator("#rms_px").inner_text() == tile(made.html, "rms_px")
        assert tab.evaluate("document.documentElement.scrollWidth") <= 1280
        assert tab.evaluate("[...document.images].every(i => i.naturalWidth > 100)")
        assert tab.locator("svg image").count() == page.PAIRS
        shown = cv2.imdecode(np.frombuffer(tab.screenshot(full_page=True), np.uint8), cv2.IMREAD_COLOR)
        assert len(np.unique(shown.reshape(-1, 3), axis=0)) > 500
        assert len(tab.pdf()) > 100_000
        assert set(asked) <= {"file", "data"}
        browser.close()
