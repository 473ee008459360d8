"""ChArUco boards: the corners that are seen, each known by the markers beside it, so that half a board will do."""

import cv2
import numpy as np
from jaxtyping import Float32, Int32

from binpick.data import Image
from binpick.rigcheck.board import Board
from binpick.rigcheck.chessboard import refine
from binpick.rigcheck.detection import neighbours

FEWEST = 6
"""Fewer corners hold neither a plane's tilt nor a lens."""


def find(image: Image, board: Board) -> tuple[Int32[np.ndarray, "n"], Float32[np.ndarray, "n 2"]] | None:
    """Ids and places of the corners seen, by id; None when they are fewer than six."""
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board.charuco).detectBoard(image)
    if ids is None or len(ids) < FEWEST:
        return None
    order = np.argsort(ids.ravel())
    ids, corners = ids.ravel()[order].astype(np.int32), corners.reshape(-1, 2)[order].astype(np.float32)
    pairs = neighbours(board, ids)
    if not len(pairs):
        return None
    spacing = float(np.linalg.norm(corners[pairs[:, 0]] - corners[pairs[:, 1]], axis=1).min())
    # a marker's white border is as wide as its square leaves: nothing else than the corner may lie in the window
    border = (1 - board.mark_m / board.square_m) / 2
    return ids, refine(image, corners, spacing * min(1.0, 2 * border))
