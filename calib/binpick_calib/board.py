"""The boards that views are made of: a board's points as one plain array, NaN where unseen, from `binpick.rigcheck`."""

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from binpick.rigcheck import sight
from binpick.rigcheck.board import Board as Board
from binpick.rigcheck.board import Kind
from binpick.rigcheck.board import parse as parse
from binpick.rigcheck.detection import Refusal, edges

_TEN_TO_NINETY = 2.563
"""Width of a blurred step from 10 to 90 % of its height, in sigmas."""


def find(image: UInt8[np.ndarray, "h w"], board: Board) -> Float32[np.ndarray, "n 2"] | None:
    """The board's points to a fraction of a pixel, row by row as in `points_m`; NaN: not seen; None when it is not found."""
    found = sight.find(image, board)
    if isinstance(found, Refusal):
        return None
    points_px = np.full((board.columns * board.rows, 2), np.nan, np.float32)
    points_px[found.ids] = found.corners_px
    return points_px


def edge_px(image: UInt8[np.ndarray, "h w"], corners_px: Float32[np.ndarray, "n 2"], board: Board) -> float:
    """How wide the printed edges are, from 10 to 90 % of their contrast: blur of lens, motion and focus together."""
    if board.kind is Kind.CHESSBOARD:
        # a hand moves the board one way: across that way the edges stay sharp
        return max(float(cv2.estimateChessboardSharpness(image, (board.columns, board.rows), corners_px.reshape(-1, 1, 2), 0.8,
                                                         upright)[0][0]) for upright in (False, True))
    ids = np.flatnonzero(np.isfinite(corners_px[:, 0])).astype(np.int32)
    return _TEN_TO_NINETY * edges(image, board, ids, corners_px[ids])[0]


def align(left_px: Float32[np.ndarray, "n 2"], right_px: Float32[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n 2"]:
    """The right points, turned end to end when they are numbered against the left ones.

    Cameras of a rig stand upright to each other within far less than 90 degrees. A board seen in part carries numbers.
    """
    if np.isnan(left_px).any() or np.isnan(right_px).any():
        return right_px
    same_way = (left_px[-1] - left_px[0]) @ (right_px[-1] - right_px[0]) > 0
    return right_px if same_way else np.ascontiguousarray(right_px[::-1])
