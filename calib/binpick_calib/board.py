"""The boards that views are made of: a whole board's points as plain arrays, from `binpick.rigcheck`."""

import numpy as np
from jaxtyping import Float32, UInt8

from binpick.rigcheck import sight
from binpick.rigcheck.board import Board as Board
from binpick.rigcheck.board import parse as parse
from binpick.rigcheck.detection import Refusal


def find(image: UInt8[np.ndarray, "h w"], board: Board) -> Float32[np.ndarray, "n 2"] | None:
    """The board's points to a fraction of a pixel, row by row as in `points_m`; None when it is not wholly seen."""
    found = sight.find(image, board)
    if isinstance(found, Refusal) or len(found.ids) != len(board.points_m):
        return None
    return found.corners_px


def align(left_px: Float32[np.ndarray, "n 2"], right_px: Float32[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n 2"]:
    """The right points, turned end to end when they are numbered against the left ones.

    Cameras of a rig stand upright to each other within far less than 90 degrees.
    """
    same_way = (left_px[-1] - left_px[0]) @ (right_px[-1] - right_px[0]) > 0
    return right_px if same_way else np.ascontiguousarray(right_px[::-1])
