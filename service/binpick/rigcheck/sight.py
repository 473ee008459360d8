"""The sight of a board: found in an image or refused with the reason, and numbered alike in images that belong together."""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float32, Int32

from binpick.data import Image
from binpick.rigcheck import apriltag, charuco, chessboard, circles
from binpick.rigcheck.board import Board, Kind
from binpick.rigcheck.detection import Detection, Refusal, judge, neighbours

CLEAR = 0.3
"""How much better (of 2) the best numbering's directions must agree than the next: cameras turned by less than 73 degrees."""
_FAINT = 12
"""Grey levels between dark and light below which nothing can be found."""


def find(image: Image, board: Board) -> Detection | Refusal:
    """The board's points in an image, and how well it is seen."""
    if board.kind is Kind.CHARUCO:
        seen = charuco.find(image, board)
    else:
        finder = {Kind.CHESSBOARD: chessboard, Kind.TAG: apriltag}.get(board.kind, circles)
        corners = finder.find(image, board)
        seen = None if corners is None else (np.arange(len(corners), dtype=np.int32), corners)
    if seen is None:
        return Refusal(_why_not(image, board))
    ids, corners = seen
    pairs = neighbours(board, ids)
    spacing_px = float(np.linalg.norm(corners[pairs[:, 0]] - corners[pairs[:, 1]], axis=1).min())
    quality = judge(image, board, ids, corners, spacing_px)
    if isinstance(quality, Refusal):
        return quality
    return Detection(board, (image.shape[1], image.shape[0]), ids, corners, quality)


def glance(image: Image, board: Board) -> Detection | Refusal:
    """As `find`, for live images: quick to say no, at the price of a board now and then that is hard to see."""
    if board.kind is Kind.CHESSBOARD and not chessboard.glimpsed(image, board):
        return Refusal(_why_not(image, board))
    return find(image, board)


def _why_not(image: Image, board: Board) -> str:
    points = {Kind.CHESSBOARD: "inner corners", Kind.CHARUCO: "inner corners and its markers"}.get(board.kind, "dots")
    what = f"no board with {board.columns}x{board.rows} {points} seen"
    if board.kind is Kind.TAG:
        what = f"not one tag of {board.dictionary} seen, or several"
    dark, light = np.quantile(cv2.resize(image, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA), [0.02, 0.98])
    if light - dark < _FAINT:
        return f"{what}: the image is all one grey ({dark:.0f} to {light:.0f} of 255)"
    return what


def align(reference: Detection, detection: Detection) -> Detection | Refusal:
    """The detection, numbered as the reference: another camera's image of the same moment, or the camera's one before.

    A board that looks the same after a half (or quarter) turn is numbered from any of its ends. The numbering is taken whose
    points lie to each other as in the reference; refused when two fit alike.
    """
    board = detection.board
    if board != reference.board:
        return Refusal(f"one image shows {reference.board}, the other {board}")
    if not board.turns:
        return detection
    numberings = [detection.corners_px, *(detection.corners_px[ids] for ids in board.turns)]
    model, *shapes = (_shape(corners) for corners in (reference.corners_px, *numberings))
    fits = [float((model * shape).sum()) for shape in shapes]
    best, second = sorted(range(len(fits)), key=lambda number: -fits[number])[:2]
    if fits[best] - fits[second] < CLEAR:
        return Refusal(f"{board} looks the same after a turn, and the two images show it too far turned to each other to tell "
                       "its ends apart: use a board with one odd and one even count of corners")
    return replace(detection, corners_px=np.ascontiguousarray(numberings[best]))


def _shape(corners_px: Float32[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n 2"]:
    """The points about their middle, as a unit vector."""
    centred = corners_px - corners_px.mean(0)
    unit: Float32[np.ndarray, "n 2"] = centred / np.linalg.norm(centred)
    return unit


def pair(left: Detection, right: Detection) -> tuple[Detection, Detection] | Refusal:
    """Two cameras' detections of one moment, numbered alike and cut to the points that both see."""
    aligned = align(left, right)
    if isinstance(aligned, Refusal):
        return aligned
    common = np.intersect1d(left.ids, aligned.ids)
    fewest = min(charuco.FEWEST, len(left.board.points_m))
    if len(common) < fewest:
        return Refusal(f"both cameras see only {len(common)} of the same points, {fewest} are needed")
    return _cut(left, common), _cut(aligned, common)


def _cut(detection: Detection, ids: Int32[np.ndarray, "k"]) -> Detection:
    kept = np.isin(detection.ids, ids)
    return replace(detection, ids=detection.ids[kept], corners_px=detection.corners_px[kept])
