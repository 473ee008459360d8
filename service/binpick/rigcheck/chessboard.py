"""Chessboards: every inner corner to a fraction of a pixel, numbered from the same printed corner where the print shows it."""

import cv2
import numpy as np
from jaxtyping import Float32

from binpick.data import Image
from binpick.rigcheck.board import Board
from binpick.rigcheck.detection import edges

_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 0.05)
"""Steps below 0.05 px are noise; in a picture of black and white only, going on strays from pixel to pixel by 0.2 px."""
_HALF_PX = 5
"""Half of the window that a sharp corner is refined in, where the next corner is far enough away."""
GLANCE_PX = 640
"""Width of the image that a glance looks at."""
_SOFT_PX = 1.4
"""Edges of a larger sigma: fitting the saddle of a whole neighbourhood is then nearer to the truth than a window's gradients
(drawn boards of 14 to 60 px squares, sigma 3 px: 0.07 to 0.15 px rms against 0.2 to 1 px; sharp ones go the other way)."""


def find(image: Image, board: Board) -> Float32[np.ndarray, "n 2"] | None:
    """The corners row by row as in `Board.points_m`; None when the board is not wholly seen.

    A board that looks the same upside down is numbered from whichever end is met first.
    """
    size = (board.columns, board.rows)
    seen, corners = cv2.findChessboardCorners(image, size)
    # the slower search bears deeper shade and more blur; the fast one then misplaces a corner, if it finds them at all
    if not seen or not _smooth(corners.reshape(board.rows, board.columns, 2)):
        seen, corners = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not seen:
        return None
    corners = corners.reshape(-1, 2)
    ids = np.arange(len(corners), dtype=np.int32)
    if edges(image, board, ids, corners)[0] > _SOFT_PX:
        soft, saddles = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_ACCURACY)
        refined = saddles.reshape(-1, 2) if soft else corners
    else:
        refined = refine(image, corners, spacing_px(corners.reshape(board.rows, board.columns, 2)))
    return _from_the_same_corner(refined.reshape(board.rows, board.columns, 2), image).reshape(-1, 2)


def glimpsed(image: Image, board: Board) -> bool:
    """Whether the quick search finds the board in a smaller image: to say no, the thorough one takes seconds at full size.

    All 52 images of two real sets that the thorough search finds are found; a small, soft or very oblique board may not be.
    """
    share = min(1.0, GLANCE_PX / image.shape[1])
    small = cv2.resize(image, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    quick = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    return bool(cv2.findChessboardCorners(small, (board.columns, board.rows), flags=quick)[0])


def refine(image: Image, corners_px: Float32[np.ndarray, "n 2"], spacing: float) -> Float32[np.ndarray, "n 2"]:
    """The corners moved to where the image's gradients point past them.

    The window must hold one corner only, also where the board is seen obliquely: 11 px each way, as in many examples,
    doubles the residual of small boards, because the next corner reaches into it.
    """
    half = max(2, min(_HALF_PX, int(0.45 * spacing)))
    moved: Float32[np.ndarray, "n 2"] = cv2.cornerSubPix(
        image, np.ascontiguousarray(corners_px).reshape(-1, 1, 2).copy(), (half, half), (-1, -1), _STOP).reshape(-1, 2)
    return moved


def spacing_px(grid: Float32[np.ndarray, "r c 2"]) -> float:
    """The least distance of neighbours in a row or a column."""
    return float(min(np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)))


def _smooth(grid: Float32[np.ndarray, "r c 2"]) -> bool:
    """Whether each corner lies about half way between its neighbours: tilt and lenses shift it by a tenth of their distance."""
    return all(bool((np.linalg.norm(np.diff(grid, 2, axis=axis), axis=2) < 0.3 * spacing_px(grid)).all()) for axis in (0, 1))


def _from_the_same_corner(grid: Float32[np.ndarray, "r c 2"], image: Image) -> Float32[np.ndarray, "r c 2"]:
    rows, columns = grid.shape[:2]
    along, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if along[0] * down[1] - along[1] * down[0] < 0:
        grid = grid[:, ::-1]    # seen from the front, x to y turns clockwise in an image
    first = cv2.getRectSubPix(image, (3, 3), tuple(map(float, grid[:2, :2].mean((0, 1))))).mean()
    last = cv2.getRectSubPix(image, (3, 3), tuple(map(float, grid[-2:, -2:].mean((0, 1))))).mean()
    # with one odd and one even count the first and the last square differ in colour: the first is the dark one
    turned = (rows + columns) % 2 == 1 and first > last
    return np.ascontiguousarray(grid[::-1, ::-1] if turned else grid)
