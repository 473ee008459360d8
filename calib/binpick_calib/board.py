"""The board: what is printed on it, and where its corners are seen in an image."""

import re
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from binpick.errors import InputError

SUBPIXEL = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)


@dataclass(frozen=True, slots=True)
class Board:
    """A chessboard of `columns` x `rows` inner corners."""

    columns: int
    rows: int
    square_m: float

    def __str__(self) -> str:
        return f"chessboard:{self.columns}x{self.rows}:{self.square_m:g}"

    @property
    def points_m(self) -> Float32[np.ndarray, "n 3"]:
        """The corners in the board's frame, row by row; z = 0, away from the viewer."""
        grid = np.zeros((self.rows, self.columns, 3), np.float32)
        grid[..., 0], grid[..., 1] = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        return grid.reshape(-1, 3) * np.float32(self.square_m)


def parse(spec: str) -> Board:
    """The board of `chessboard:9x6:0.025` (inner corners, side of a square in metres). Raises InputError."""
    found = re.fullmatch(r"chessboard:(\d+)x(\d+):(\d*\.?\d+)", spec.strip().lower())
    if not found:
        raise InputError(f"--board {spec}: write it as chessboard:9x6:0.025 (inner corners, side of a square in metres)")
    columns, rows, square_m = int(found[1]), int(found[2]), float(found[3])
    if not (3 <= rows <= 50 and 3 <= columns <= 50) or columns == rows:
        raise InputError(f"--board {spec}: 3 to 50 inner corners each way, and not the same number both ways")
    if not 0.001 <= square_m <= 0.5:
        raise InputError(f"--board {spec}: a square of {square_m:g} m; give its side in metres, 0.001 to 0.5")
    return Board(columns, rows, square_m)


def find(image: UInt8[np.ndarray, "h w"], board: Board) -> Float32[np.ndarray, "n 2"] | None:
    """The board's corners to a fraction of a pixel, row by row as in `points_m`; None when it is not wholly seen.

    A board with one odd and one even count is numbered from the same printed corner in every image; one that looks the same
    upside down is numbered from whichever end OpenCV meets first (see `align`).
    """
    seen, corners = cv2.findChessboardCorners(image, (board.columns, board.rows))
    if not seen:
        return None
    grid = corners.reshape(board.rows, board.columns, 2)
    spacing_px = min(np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1))
    # the window must hold one corner only, also where the board is seen obliquely: a quarter of the closest spacing
    # (a fixed 11 px, as in many examples, doubles the residual of small boards: the next corner reaches into it)
    half = max(2, int(spacing_px / 4))
    refined = cv2.cornerSubPix(image, corners, (half, half), (-1, -1), SUBPIXEL)
    return _from_the_same_corner(refined.reshape(board.rows, board.columns, 2), image).reshape(-1, 2)


def edge_px(image: UInt8[np.ndarray, "h w"], corners_px: Float32[np.ndarray, "n 2"], board: Board) -> float:
    """How wide the printed edges are, from 10 to 90 % of their contrast: blur of lens, motion and focus together."""
    grid = corners_px.reshape(-1, 1, 2)
    # a hand moves the board one way: across that way the edges stay sharp
    return max(float(cv2.estimateChessboardSharpness(image, (board.columns, board.rows), grid, 0.8, upright)[0][0])
               for upright in (False, True))


def _from_the_same_corner(grid: Float32[np.ndarray, "r c 2"], image: UInt8[np.ndarray, "h w"]) -> Float32[np.ndarray, "r c 2"]:
    rows, columns = grid.shape[:2]
    along, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if along[0] * down[1] - along[1] * down[0] < 0:
        grid = grid[:, ::-1]    # seen from the front, x to y turns clockwise in an image
    first = cv2.getRectSubPix(image, (3, 3), tuple(map(float, grid[:2, :2].mean((0, 1))))).mean()
    last = cv2.getRectSubPix(image, (3, 3), tuple(map(float, grid[-2:, -2:].mean((0, 1))))).mean()
    # with one odd and one even count the first and the last square differ in colour: the first is the dark one
    turned = (rows + columns) % 2 == 1 and first > last
    return np.ascontiguousarray(grid[::-1, ::-1] if turned else grid)


def align(left_px: Float32[np.ndarray, "n 2"], right_px: Float32[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n 2"]:
    """The right corners, turned end to end when they are numbered against the left ones.

    Cameras of a rig stand upright to each other within far less than 90 degrees. A board seen in part carries numbers.
    """
    if np.isnan(left_px).any() or np.isnan(right_px).any():
        return right_px
    same_way = (left_px[-1] - left_px[0]) @ (right_px[-1] - right_px[0]) > 0
    return right_px if same_way else np.ascontiguousarray(right_px[::-1])
