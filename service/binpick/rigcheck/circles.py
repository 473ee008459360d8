"""Grids of dots, symmetric and asymmetric: every centre, numbered as seen from the printed side."""

import cv2
import numpy as np
from jaxtyping import Float, Float32

from binpick.data import Image
from binpick.rigcheck.board import Board, Kind


def find(image: Image, board: Board) -> Float32[np.ndarray, "n 2"] | None:
    """The centres row by row as in `Board.points_m`; None when the grid is not wholly seen.

    Where the board tells the dots' diameter, what perspective shifts the centre of an outline by is taken off. Where the
    plain search fails, uneven light is taken out and dots are grouped before they are counted.
    """
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if board.kind is Kind.ASYMMETRIC else cv2.CALIB_CB_SYMMETRIC_GRID
    detector = _blobs(image, board)
    for prepared, how in ((None, 0), (_evened, 0), (_evened, cv2.CALIB_CB_CLUSTERING)):
        seen, centres = cv2.findCirclesGrid(image if prepared is None else prepared(image, board), (board.columns, board.rows),
                                            flags=kind | how, blobDetector=detector)
        if seen:
            return _from_the_front(centres.reshape(-1, 2), board)
    return None


def _blobs(image: Image, board: Board) -> cv2.Feature2D:
    """OpenCV's own settings, but that dots may be as large as the grid allows (they end at 5000 square pixels)."""
    settings = cv2.SimpleBlobDetector.Params()
    settings.maxArea = max(settings.maxArea, image.size / (board.columns * board.rows))
    return cv2.SimpleBlobDetector.create(settings)


def _evened(image: Image, board: Board) -> Image:
    """The image as a share of the light that falls on the paper: the brightest within a dot's distance, smoothed."""
    reach = max(image.shape) // max(board.columns, board.rows) | 1
    paper = cv2.blur(cv2.dilate(image, np.ones((reach, reach), np.uint8)), (reach, reach))
    evened: Image = cv2.divide(image, np.maximum(paper, 8), scale=230)
    return evened


def _from_the_front(centres: Float32[np.ndarray, "n 2"], board: Board) -> Float32[np.ndarray, "n 2"]:
    H, _ = cv2.findHomography(board.points_m[:, :2], centres)
    if H is None:
        return centres
    if np.linalg.det(H / H[2, 2]) < 0:     # x to y must turn clockwise in an image
        centres = centres[board.mirrored]
        H, _ = cv2.findHomography(board.points_m[:, :2], centres)
    return np.ascontiguousarray(centres - _shift(H, board))


def _shift(H: Float[np.ndarray, "3 3"], board: Board) -> Float32[np.ndarray, "n 2"]:
    """How far the centre of a dot's outline lies from the dot's centre, px: the outline is the conic H^-T C H^-1.

    Its centre is read off the conic of its tangents, H C* H^T, C* being that of the dot (Hartley and Zisserman, 2.2.3).
    """
    places = np.column_stack([board.points_m[:, :2], np.ones(board.columns * board.rows)]).astype(np.float64)
    tangents = np.einsum("ij,nj,nk,lk->nil", H, places, -places, H) + H @ np.diag([1.0, 1.0, 0.0]) @ H.T * (board.mark_m / 2)**2
    seen = places @ H.T
    shift: Float32[np.ndarray, "n 2"] = (tangents[:, :2, 2] / tangents[:, 2:, 2] - seen[:, :2] / seen[:, 2:]).astype(np.float32)
    return shift
