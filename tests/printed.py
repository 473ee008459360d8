"""A printed board as a camera sees it: drawn several times finer than the image, blurred as by a lens."""

import cv2
import numpy as np

SIDE_PX = 40
"""Of a square of the drawn board."""


def paper(squares: np.ndarray) -> np.ndarray:
    """Ink where `squares` are 0, on paper that is one square wider on every side."""
    return cv2.copyMakeBorder(squares.astype(np.uint8) * 190 + 20, *[SIDE_PX] * 4, cv2.BORDER_CONSTANT, value=210)


def chessboard(columns: int, rows: int) -> np.ndarray:
    """So many inner corners."""
    return paper(np.kron(np.add.outer(np.arange(rows + 1), np.arange(columns + 1)) % 2, np.ones((SIDE_PX, SIDE_PX))))


def charuco(board: cv2.aruco.CharucoBoard) -> np.ndarray:
    columns, rows = board.getChessboardSize()
    return paper(board.generateImage((columns * SIDE_PX, rows * SIDE_PX), marginSize=0) // 255)


def seen(board: np.ndarray, square_m: float, K: np.ndarray, T_camera_board: np.ndarray, size_px: tuple[int, int],
         finer: int, blur_px: float) -> np.ndarray:
    """The board lies on its frame's z = 0, its first inner corner in the origin; `blur_px` are pixels of the finer image."""
    metres, first = square_m / SIDE_PX, 2 * SIDE_PX - 0.5
    T_board_paper = np.array([[metres, 0, -first * metres], [0, metres, -first * metres], [0, 0, 1]])
    H = K @ T_camera_board[:3, [0, 1, 3]] @ T_board_paper
    way = np.array([[finer, 0, (finer - 1) / 2], [0, finer, (finer - 1) / 2], [0, 0, 1]]) @ H
    large = cv2.warpPerspective(board, way, (size_px[0] * finer, size_px[1] * finer), borderValue=120)
    return cv2.resize(cv2.GaussianBlur(large, None, blur_px), size_px, interpolation=cv2.INTER_AREA)
