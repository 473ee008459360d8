"""A detection: where a board's points are seen in one image, and how well it is seen."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int32

from binpick.data import Image
from binpick.rigcheck.board import Board, Kind

GRID = 3
"""The image is divided into this many cells each way: a good set of views has its middles in all of them."""


@dataclass(frozen=True, slots=True)
class Quality:
    """How well a view shows the board.

    `blur_px`: sigma of its edges (a sharp lens: 0.6 to 1; NaN where no edge could be judged); `contrast`: of light and dark,
    grey levels; `spacing_px`: the least distance of neighbouring points; `tilt_rad`: between the board's normal and the line of
    sight; `cell`: column and row of the image's cell that holds the middle of the points; `spread`: share of the image that
    their hull covers; `residual_px`: rms distance from a plane board seen without distortion.
    """

    blur_px: float
    contrast: float
    spacing_px: float
    tilt_rad: float
    cell: tuple[int, int]
    spread: float
    residual_px: float


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """Points of a board in one image: `points_m` of the board's frame are seen at `corners_px`; `ids` number them."""

    board: Board
    image_size_px: tuple[int, int]
    ids: Int32[np.ndarray, "n"]
    corners_px: Float32[np.ndarray, "n 2"]
    quality: Quality

    @property
    def points_m(self) -> Float32[np.ndarray, "n 3"]:
        """The points seen, in the board's frame."""
        points: Float32[np.ndarray, "n 3"] = self.board.points_m[self.ids]
        return points


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why an image or a pair of images is of no use: a sentence for people."""

    reason: str


def judge(image: Image, board: Board, ids: Int32[np.ndarray, "n"], corners_px: Float32[np.ndarray, "n 2"],
          spacing_px: float) -> Quality | Refusal:
    """The quality of points found in an image; refused when no plane board lies under them."""
    points = board.points_m[ids][:, :2].astype(np.float64)
    H, _ = cv2.findHomography(points, corners_px)
    if H is None:
        return Refusal("the points found lie on one line")
    off = np.linalg.norm(cv2.perspectiveTransform(points[None], H)[0] - corners_px, axis=1)
    residual_px = float(np.sqrt(np.mean(off**2)))
    if residual_px > 0.15 * spacing_px:     # bent boards and wide lenses reach 0.05
        return Refusal(f"the points found do not lie on one plane board ({residual_px:.1f} px off it)")
    height, width = image.shape
    middle = corners_px.mean(0)
    blur_px, contrast = edges(image, board, ids, corners_px)
    return Quality(blur_px, contrast, spacing_px, _tilt_rad(H, points.mean(0)),
                   (int(np.clip(middle[0] * GRID / width, 0, GRID - 1)), int(np.clip(middle[1] * GRID / height, 0, GRID - 1))),
                   float(cv2.contourArea(cv2.convexHull(corners_px))) / (width * height), residual_px)


def _tilt_rad(H: Float[np.ndarray, "3 3"], middle: Float[np.ndarray, "2"]) -> float:
    """A small square there is foreshortened by the cosine of the tilt: no focal length is needed to see it."""
    x, y, w = H @ [*middle, 1.0]
    local = (H[:2, :2] - np.outer([x / w, y / w], H[2, :2])) / w
    short, long = sorted(np.linalg.svd(local, compute_uv=False))
    return float(np.arccos(np.clip(short / long, 0, 1)))


def neighbours(board: Board, ids: Int32[np.ndarray, "n"]) -> Int32[np.ndarray, "k 2"]:
    """Places in `ids` of neighbours in a row, and from row to row."""
    place = np.full((board.rows, board.columns), -1, dtype=np.int32)
    place.flat[ids] = np.arange(len(ids), dtype=np.int32)
    pairs = np.concatenate([np.stack([place[:, :-1], place[:, 1:]], -1).reshape(-1, 2),
                            np.stack([place[:-1], place[1:]], -1).reshape(-1, 2)])
    return pairs[(pairs >= 0).all(1)]


def edges(image: Image, board: Board, ids: Int32[np.ndarray, "n"],
          corners_px: Float32[np.ndarray, "n 2"]) -> tuple[float, float]:
    """Sigma of the board's edges, px, and its contrast, grey levels: medians over profiles between neighbouring points.

    Of rows and columns the softer counts: a hand moves a board one way, and across that way the edges stay sharp. Between two
    corners of a chessboard or tag the edge is crossed at half way, square to it; between two dots the profile leaves the one
    and enters the other. The steepest slope of a step of height c blurred by sigma is c / (sigma * sqrt(2 pi)).
    """
    pairs = neighbours(board, ids)
    in_row = ids[pairs[:, 1]] - ids[pairs[:, 0]] == 1
    both = [_edge(*_profiles(image, board, corners_px, pairs[way])) for way in (in_row, ~in_row) if way.any()]
    sigmas = [sigma_px for sigma_px, _ in both if np.isfinite(sigma_px)]
    return max(sigmas, default=float("nan")), min((contrast for _, contrast in both), default=0.0)


def _profiles(image: Image, board: Board, corners_px: Float32[np.ndarray, "n 2"],
              pairs: Int32[np.ndarray, "k 2"]) -> tuple[Float[np.ndarray, "k 65"], Float[np.ndarray, "k"]]:
    """Grey levels along lines across the edges between neighbours, and the distance of two samples, px."""
    start, along = corners_px[pairs[:, 0]], corners_px[pairs[:, 1]] - corners_px[pairs[:, 0]]
    if board.kind in (Kind.CHESSBOARD, Kind.CHARUCO, Kind.TAG):
        start, along = start + along / 2, np.stack([-along[:, 1], along[:, 0]], axis=1)
        start = start - along / 2
    at = start[:, None] + np.linspace(0, 1, 65, dtype=np.float32)[:, None] * along[:, None]
    values = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return values.astype(np.float64), np.linalg.norm(along, axis=1).astype(np.float64) / 64


def _edge(values: Float[np.ndarray, "k 65"], step_px: Float[np.ndarray, "k"]) -> tuple[float, float]:
    """Medians of sigma (NaN where all is flat) and contrast."""
    # over one pixel and more: linear interpolation between pixels has no slopes within them
    wide = min(64, max(1, round(float(1 / np.median(step_px)))))
    slope = np.abs(values[:, wide:] - values[:, :-wide]).max(1) / (wide * step_px)
    contrast = np.quantile(values, 0.9, axis=1) - np.quantile(values, 0.1, axis=1)
    steep = slope > 0
    sigma_px = float(np.median(contrast[steep] / (slope[steep] * np.sqrt(2 * np.pi)))) if steep.any() else float("nan")
    return sigma_px, float(np.median(contrast))
