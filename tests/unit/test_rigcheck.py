"""Boards in images: OpenCV's own ground truth, drawn boards in blur and shade, and boards whose ends look alike."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import printed
from binpick.errors import InputError
from binpick.rigcheck import chessboard, sight
from binpick.rigcheck.board import Board, Kind, parse
from binpick.rigcheck.detection import Detection, Refusal, judge

TRUTH = Path(__file__).parents[2] / "../shared/data/opencv_extra_calib"
DOTS = Path(__file__).parents[2] / "../shared/data/handeye_rct_10x10"
SIZE = (640, 480)
K = np.array([[620.0, 0, 322], [0, 622, 238], [0, 0, 1]])
needs_truth = pytest.mark.skipif(not TRUTH.is_dir(), reason="OpenCV's calibration truth does not lie in ../shared/data")


def truth(name: str) -> np.ndarray:
    stored = cv2.FileStorage(str(TRUTH / name), cv2.FILE_STORAGE_READ)     # its nodes do not outlive it
    return stored.getNode("corners").mat()


def grey(name: str) -> np.ndarray:
    return cv2.imread(str(TRUTH / name), cv2.IMREAD_GRAYSCALE)


@needs_truth
@pytest.mark.parametrize("number", range(1, 10))
def test_chessboards_of_known_corners(number: int) -> None:
    known = truth(f"chess_corners{number}.dat")
    seen = sight.find(grey(f"chess{number}.png"), Board(known.shape[1], known.shape[0], 0.025))
    assert isinstance(seen, Detection)
    off = np.linalg.norm(seen.corners_px[:, None] - known.reshape(-1, 2), axis=2)
    assert off.min(0).max() < 0.1
    assert off.min(1).max() < 0.1


@needs_truth
@pytest.mark.parametrize("number", [1, 2, 3])
def test_no_board_is_seen_where_there_is_none(number: int) -> None:
    known = truth(f"negative_{number}.dat")
    seen = sight.find(grey(f"negative_{number}.png"), Board(known.shape[1], known.shape[0], 0.025))
    assert isinstance(seen, Refusal)
    assert "no board" in seen.reason


@needs_truth
@pytest.mark.parametrize("number", range(1, 10))
def test_circles_of_known_centres(number: int) -> None:
    known = truth(f"asymmetric_circles/acircles_corners{number}.dat")
    seen = sight.find(grey(f"asymmetric_circles/acircles{number}.png"),
                      Board(known.shape[1], known.shape[0], 0.02, Kind.ASYMMETRIC, 0.012))
    assert isinstance(seen, Detection)
    assert np.linalg.norm(seen.corners_px - known.reshape(-1, 2), axis=1).max() < 0.1


@pytest.mark.skipif(not DOTS.is_dir(), reason="the hand-eye set of dots does not lie in ../shared/data")
def test_dots_photographed() -> None:
    found = [sight.find(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), parse("circles:10x10:0.0254"))
             for path in sorted(DOTS.rglob("*.png"))[:3]]
    assert found
    assert all(isinstance(seen, Detection) for seen in found)


def sheet(board: Board) -> tuple[np.ndarray, np.ndarray]:
    """A drawn board, and the pixel of its first point."""
    side = printed.SIDE_PX
    if board.kind is Kind.CHARUCO:
        drawn = printed.charuco(board.charuco)
    elif board.kind is Kind.CHESSBOARD:
        drawn = printed.chessboard(board.columns, board.rows)
    else:
        places = board.points_m[:, :2] / board.square_m * side + 2 * side
        drawn = np.full((*(places.max(0)[::-1].astype(int) + 2 * side),), 210, np.uint8)
        for x, y in places:
            radius = round((board.mark_m / board.square_m or 0.7) * side * 8)
            cv2.circle(drawn, (round(x * 16), round(y * 16)), radius, 20, -1, cv2.LINE_AA, shift=4)
        return drawn, np.array([2.0 * side, 2.0 * side])
    return drawn, np.array([2 * side - 0.5, 2 * side - 0.5])


def photograph(board: Board, tilt_deg: tuple[float, float, float] = (20.0, 15.0, 8.0), blur_px: float = 0.8, shade: float = 1.0,
               noise: float = 2.0, shift_m: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A camera's view of the drawn board, with light falling off to one side, and where its points truly are."""
    drawn, first = sheet(board)
    metres = board.square_m / printed.SIDE_PX
    R = Rotation.from_euler("xyz", tilt_deg, degrees=True).as_matrix()
    points = board.points_m.astype(float)
    middle = np.array([0.01 + shift_m, 0.005, 2.2 * np.ptp(points, axis=0).max()])
    t = middle - R @ ((points.max(0) + points.min(0)) / 2)
    H = K @ np.column_stack([R[:, :2], t]) @ np.array(
        [[metres, 0, -first[0] * metres], [0, metres, -first[1] * metres], [0, 0, 1]])
    large = cv2.warpPerspective(drawn, np.array([[4, 0, 1.5], [0, 4, 1.5], [0, 0, 1]]) @ H, (SIZE[0] * 4, SIZE[1] * 4),
                                borderValue=120)
    image = cv2.resize(cv2.GaussianBlur(large, None, 4 * blur_px), SIZE, interpolation=cv2.INTER_AREA)
    light = image * np.linspace(shade, 1, SIZE[0])
    seen = (points @ R.T + t) @ K.T
    return (np.clip(light + np.random.default_rng(0).normal(0, noise, light.shape), 0, 255).astype(np.uint8),
            seen[:, :2] / seen[:, 2:])


KINDS = ["chessboard:9x6:0.025", "charuco:9x6:0.025:0.018:5x5_100", "circles:9x7:0.02:0.012", "acircles:4x11:0.02:0.016"]


@pytest.mark.parametrize("spec", KINDS)
@pytest.mark.parametrize(("blur_px", "shade", "within_px"), [(0.8, 1.0, 0.08), (0.8, 0.25, 0.15), (3.0, 0.5, 0.35)])
def test_every_kind_is_found_in_blur_and_shade(spec: str, blur_px: float, shade: float, within_px: float) -> None:
    board = parse(spec)
    if board.kind is Kind.CHARUCO:
        blur_px = min(blur_px, 0.8)     # a cell of a marker is 3 px wide
    image, true_px = photograph(board, blur_px=blur_px, shade=shade)
    seen = sight.find(image, board)
    assert isinstance(seen, Detection), seen
    assert len(seen.ids) == len(true_px) or (board.kind is Kind.CHARUCO and len(seen.ids) > 0.8 * len(true_px))
    aligned = sight.align(planted(seen, true_px[seen.ids]), seen)
    assert isinstance(aligned, Detection)
    assert np.sqrt(np.mean(np.sum((aligned.corners_px - true_px[seen.ids])**2, axis=1))) < within_px
    # pixels, and the drawing's own, add to the lens's softness; light that falls off takes from the edges' height
    assert seen.quality.blur_px == pytest.approx(np.hypot(blur_px, 0.6), rel=0.4)


def planted(seen: Detection, true_px: np.ndarray) -> Detection:
    return replace(seen, corners_px=true_px.astype(np.float32))


def test_a_dots_centre_is_not_its_outlines() -> None:
    # a dot seen obliquely is larger on its near side: the outline's centre lies 0.08 px off here
    image, true_px = photograph(parse("circles:9x7:0.02:0.012"))
    off = {}
    for spec in ("circles:9x7:0.02", "circles:9x7:0.02:0.012"):
        seen = sight.find(image, parse(spec))
        aligned = sight.align(planted(seen, true_px), seen)
        off[spec] = np.linalg.norm((aligned.corners_px - true_px).mean(0))
    assert off["circles:9x7:0.02"] > 0.06
    assert off["circles:9x7:0.02:0.012"] < 0.01


@pytest.mark.parametrize(("spec", "turns"), [
    ("chessboard:9x6:0.025", 0), ("chessboard:10x6:0.025", 1), ("chessboard:9x7:0.025", 1), ("circles:9x7:0.02", 1),
    ("circles:10x10:0.0254", 3), ("acircles:4x11:0.02", 0), ("charuco:8x6:0.025", 0)])
def test_boards_that_look_the_same_after_a_turn(spec: str, turns: int) -> None:
    board = parse(spec)
    assert len(board.turns) == turns
    middle = board.points_m.mean(0)
    for ids in board.turns:
        turned = board.points_m[ids] - middle
        assert np.allclose(np.linalg.norm(turned, axis=1), np.linalg.norm(board.points_m - middle, axis=1), atol=1e-6)
        assert not np.array_equal(ids, np.arange(len(ids)))


@pytest.mark.parametrize("spec", ["chessboard:8x6:0.025", "chessboard:9x7:0.025", "circles:9x7:0.02", "circles:8x8:0.02"])
def test_ends_that_look_alike_are_told_apart_by_the_other_camera(spec: str) -> None:
    board = parse(spec)
    left = sight.find(photograph(board, (10, -12, 4))[0], board)
    right_image, true_px = photograph(board, (8, -2, -4), shift_m=-0.02)
    right = sight.find(right_image, board)
    assert isinstance(left, Detection)
    assert isinstance(right, Detection)
    for ids in (np.arange(len(true_px)), *board.turns):
        both = sight.pair(left, replace(right, corners_px=right.corners_px[ids]))
        assert not isinstance(both, Refusal)
        assert np.array_equal(both[1].corners_px, sight.align(left, right).corners_px)
    # where the camera lies on its side to the other, nothing tells
    turn = np.array([[0, 1], [-1, 0]], np.float32) if len(board.turns) == 1 else np.array([[1, 1], [-1, 1]], np.float32)
    refused = sight.pair(left, replace(left, corners_px=left.corners_px @ turn.T))
    assert isinstance(refused, Refusal)
    assert "looks the same after a turn" in refused.reason


@pytest.mark.parametrize("spec", ["chessboard:9x6:0.025", "acircles:4x11:0.02", "charuco:9x6:0.025"])
def test_a_board_that_shows_its_end_is_numbered_from_there_also_upside_down(spec: str) -> None:
    board = parse(spec)
    image, true_px = photograph(board)
    for shown, known in ((image, true_px), (np.ascontiguousarray(image[::-1, ::-1]), np.array(SIZE) - 1 - true_px)):
        seen = sight.find(shown, board)
        assert isinstance(seen, Detection)
        assert np.abs(seen.corners_px - known[seen.ids]).max() < 0.35


def test_half_a_charuco_board_will_do() -> None:
    board = parse("charuco:9x6:0.025:0.018:5x5_100")
    image, true_px = photograph(board)
    covered = image.copy()
    covered[:, 330:] = 90
    whole, half = sight.find(image, board), sight.find(covered, board)
    assert isinstance(whole, Detection)
    assert isinstance(half, Detection)
    assert 15 < len(half.ids) < 40
    assert np.abs(half.corners_px - true_px[half.ids]).max() < 0.2
    both = sight.pair(whole, half)
    assert not isinstance(both, Refusal)
    assert np.array_equal(both[0].points_m, both[1].points_m)
    few = replace(half, ids=half.ids[:3], corners_px=half.corners_px[:3])
    assert "only 3 of the same points" in sight.pair(whole, few).reason


@pytest.mark.parametrize("tilt_deg", [(0.0, 0.0, 10.0), (35.0, 0.0, 0.0), (0.0, 45.0, 20.0)])
def test_quality_says_how_the_board_stands(tilt_deg: tuple[float, float, float]) -> None:
    board = parse("chessboard:9x6:0.025")
    image, _ = photograph(board, tilt_deg)
    quality = sight.find(image, board).quality
    R = Rotation.from_euler("xyz", tilt_deg, degrees=True).as_matrix()
    sight_line = np.array([0.01, 0.005, 0.44]) / np.linalg.norm([0.01, 0.005, 0.44])
    assert quality.tilt_rad == pytest.approx(np.arccos(R[:, 2] @ sight_line), abs=np.radians(5))
    assert quality.cell == (1, 1)
    assert 0.1 < quality.spread < 0.2
    assert quality.residual_px < 0.1
    assert quality.contrast > 100


def test_a_board_moved_by_hand_is_not_called_sharp() -> None:
    board = parse("chessboard:9x6:0.025")
    image, _ = photograph(board, (20.0, 15.0, 0.0))
    still, moved = (sight.find(shown, board) for shown in (image, cv2.blur(image, (9, 1))))
    assert still.quality.blur_px < 1.3
    assert moved.quality.blur_px > 2


def test_one_tag_is_a_board_and_two_are_none() -> None:
    board = parse("apriltag:36h11:0.08")
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    image = np.full((480, 640), 210, np.uint8)
    image[150:310, 200:360] = cv2.aruco.generateImageMarker(family, 10, 160)
    seen = sight.find(cv2.GaussianBlur(image, None, 0.8), board)
    assert isinstance(seen, Detection)
    assert seen.corners_px == pytest.approx(np.array([[199.5, 149.5], [359.5, 149.5], [199.5, 309.5], [359.5, 309.5]]), abs=0.6)
    assert not isinstance(sight.pair(seen, seen), Refusal)
    image[20:120, 450:550] = cv2.aruco.generateImageMarker(family, 3, 100)
    assert "or several" in sight.find(image, board).reason


def test_what_is_no_board_is_refused_with_the_reason() -> None:
    board = parse("chessboard:9x6:0.025")
    assert "all one grey (60 to 60 of 255)" in sight.find(np.full((480, 640), 60, np.uint8), board).reason
    assert sight.find(photograph(board)[0], parse("circles:9x6:0.02")).reason == "no board with 9x6 dots seen"
    bent = replace(sight.find(photograph(board)[0], board))
    image = photograph(board)[0]
    strewn = bent.corners_px + np.random.default_rng(0).normal(0, 8, bent.corners_px.shape).astype(np.float32)
    assert "do not lie on one plane board" in judge(image, board, bent.ids, strewn, 30.0).reason


@pytest.mark.parametrize("spec", ["chessboard:9x6:0.025", "charuco:9x6:0.025:0.018:5x5_100", "circles:9x7:0.02",
                                  "charuco:7x5:0.03:0.02:apriltag_36h11", "circles:9x7:0.02:0.012", "acircles:4x11:0.02:0.016",
                                  "apriltag:36h11:0.08"])
def test_a_board_is_written_as_it_is_read(spec: str) -> None:
    assert str(parse(spec)) == spec


@pytest.mark.parametrize(("spec", "said"), [
    ("dots:9x6:0.02", "acircles:4x11:0.02"), ("chessboard:9x6:0.025:0.01", "no markers"),
    ("charuco:9x6:0.025:0.024", "0.2 to 0.9"), ("charuco:9x6:0.025:0.018:9x9_100", "no dictionary is called 9x9_100"),
    ("charuco:20x20:0.025:0.018:4x4_50", "4x4_50 has 50"), ("circles:9x7:0.02:0.012:5x5_100", "only a ChArUco"),
    ("circles:2x7:0.02", "3 to 50 dots"), ("acircles:4x10:0.02", "an odd number of rows"),
    ("apriltag:36h12:0.08", "no dictionary is called apriltag_36h12"), ("apriltag:36h11:80", "in metres")])
def test_bad_board(spec: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        parse(spec)


def test_a_glance_finds_what_is_there_and_says_no_at_once(shown_board: Any) -> None:
    board = parse(shown_board.spec)
    for image in (picture for pair in shown_board.pairs for picture in pair):
        assert chessboard.glimpsed(cv2.resize(image, None, fx=2.5, fy=2.5), board)
    image = shown_board.pairs[0][0]
    glanced, found = sight.glance(image, board), sight.find(image, board)
    assert isinstance(glanced, Detection)
    assert isinstance(found, Detection)
    assert (glanced.corners_px == found.corners_px).all()
    nothing = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 255, (1000, 1600), np.uint8), None, 9)
    refused = sight.glance(nothing, board)
    assert isinstance(refused, Refusal)
    assert refused.reason.startswith("no board with 9x6 inner corners seen")
