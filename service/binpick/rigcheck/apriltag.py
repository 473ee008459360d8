"""A single AprilTag as a board: its four outer corners, numbered as its black square is printed."""

import cv2
import numpy as np
from jaxtyping import Float32

from binpick.data import Image
from binpick.rigcheck.board import Board


def find(image: Image, board: Board) -> Float32[np.ndarray, "n 2"] | None:
    """The corners row by row as in `Board.points_m`; None unless exactly one tag of the family is seen, whatever its number."""
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}".upper()))
    found, _, _ = cv2.aruco.ArucoDetector(family, settings).detectMarkers(image)
    if len(found) != 1:
        return None
    corners: Float32[np.ndarray, "n 2"] = np.ascontiguousarray(found[0][0][[0, 1, 3, 2]], dtype=np.float32)
    return corners
