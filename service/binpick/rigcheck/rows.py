"""Rows: how far partners of a production pair lie from their common row, and which small turn of a camera explains it."""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from binpick.data import Image, Rectified

ROWS_PX = 8
"""Partners are looked for this far above and below their row."""
CELLS = (14, 10)
"""The window is divided into so many cells across and down; the best place of each is looked for."""
PATCH_PX, LEAST_SCORE = 11, 0.75
"""A place in the image of half size that is looked for, and how well it must correlate with its partner."""
FINE_PX = 21
"""The window, at full size, in which the partner is found to a fraction of a pixel."""
FEWEST = 30
"""Fewer places do not tell a turn from chance."""
BOTH_WAYS, LEAST_TEXTURE = 0.2, 1e-8
"""Harris' k, which is above 0 only where gradients one way are not below a quarter of those the other way, and the least of his
measure, as `cv2.cornerHarris` scales it: an edge that is almost along a row lets partners slide, and rows with them."""
TUKEY = 4.685
"""Of residuals' spread: places beyond count for nothing (Beaton and Tukey 1974: 95 % efficient on Gaussian noise)."""
ROUNDS = 8


@dataclass(frozen=True, slots=True)
class Rows:
    """What a rectified pair without a board says of the calibration; NaN with a `reason` where too little was seen.

    `row_px`: median row of the right view minus that of the left, of `points` places; `sigma_px` its noise. `pitch_rad` and
    `roll_rad`: the turn of the right camera against the rig file, about the rows and about the optical axis of the
    rectified view (x along the rows, y down, z forward), with their sigmas. `off_px`: root mean square over the places of the
    rows that these turns explain, in which no roll can hide; what noise adds to it on average is taken off.
    """

    row_px: float = float("nan")
    sigma_px: float = float("nan")
    points: int = 0
    off_px: float = float("nan")
    pitch_rad: float = float("nan")
    roll_rad: float = float("nan")
    sigma_pitch_rad: float = float("nan")
    sigma_roll_rad: float = float("nan")
    reason: str = ""

    @property
    def rotation_rad(self) -> tuple[float, float, float]:
        """The turn (pitch, yaw, roll) for `correction.corrected`: rows do not see yaw, which stays 0."""
        return self.pitch_rad, 0.0, self.roll_rad


Places = Float32[np.ndarray, "n 2"]


def check(pair: Rectified) -> Rows:
    """The rows of one shot of a cycle, as rectified for matching; with the pattern on there is more to see.

    Relative yaw moves rows by the product of the two image coordinates only, a baseline's length not at all: neither is told.
    """
    left, right = _partners(pair)
    if len(left) < FEWEST:
        return Rows(points=len(left), reason=f"only {len(left)} places were found in both views, {FEWEST} are needed")
    return fit(left, right, pair.focal_px)


def fit(left: Places, right: Places, focal_px: float) -> Rows:
    """The rows of partners, px from the principal point of their rectified view; robust against a third of wrong ones.

    A camera turned by (a, b, c) about x, y, z sees a point at (x, y) of the image plane z = 1 in row
    y + a (1 + y²) − b x y − c x, to first order; b is taken as 0.
    """
    rows_px = (right[:, 1] - left[:, 1]).astype(np.float64)
    x, y = (right.astype(np.float64) / focal_px).T
    design = focal_px * np.column_stack([1 + y**2, -x])
    weights = np.ones(len(rows_px))
    turn, spread = np.array([np.median(rows_px) / focal_px, 0.0]), np.inf
    for _ in range(ROUNDS):
        residual = rows_px - design @ turn
        spread = 1.4826 * float(np.median(np.abs(residual))) + 1e-3
        weights = np.clip(1 - (residual / (TUKEY * spread)) ** 2, 0, None) ** 2
        turn = np.linalg.solve((design.T * weights) @ design, (design.T * weights) @ rows_px)
    kept = weights > 0
    covariance = spread**2 * np.linalg.inv((design.T * weights) @ design)
    sigma = np.sqrt(np.diag(covariance))
    chance = np.einsum("ij,jk,ik->i", design[kept], covariance, design[kept])
    square = float(np.mean((design[kept] @ turn) ** 2 - chance))
    return Rows(row_px=float(np.median(rows_px[kept])), sigma_px=1.2533 * spread / float(np.sqrt(kept.sum())),
                points=int(kept.sum()), off_px=float(np.sqrt(max(square, 0.0))), pitch_rad=float(turn[0]),
                roll_rad=float(turn[1]), sigma_pitch_rad=float(sigma[0]), sigma_roll_rad=float(sigma[1]))


def _partners(pair: Rectified) -> tuple[Places, Places]:
    """Places seen in both views, px from the principal point of the whole rectified view."""
    halves = [cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for image in (pair.left, pair.right)]
    coarse, shift, found = _coarse(halves[0], halves[1], pair.margin // 2, _textured(halves[0], pair.margin // 2))
    if not found.any():
        nothing = np.zeros((0, 2), np.float32)
        return nothing, nothing
    # the middle of a pixel of half size lies between two of full size
    left = 2 * coarse[found] + np.float32(0.5)
    guess = left + 2 * shift[found]
    right, status, _ = cv2.calcOpticalFlowPyrLK(
        pair.left, pair.right, left.reshape(-1, 1, 2), guess.reshape(-1, 1, 2).copy(), winSize=(FINE_PX, FINE_PX), maxLevel=0,
        criteria=(cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 20, 0.005), flags=cv2.OPTFLOW_USE_INITIAL_FLOW)
    right = right.reshape(-1, 2)
    good = (status.ravel() == 1) & (np.abs(right - guess) < 2.5).all(axis=1)
    window = pair.window
    corner = np.array([window.x - pair.margin - pair.cx_px, window.y - pair.cy_px], np.float32)
    aside = np.array([-window.min_disparity, 0.0], np.float32)
    return (left + corner)[good], (right + corner + aside)[good]


def _textured(image: Image, margin: int) -> Places:
    """The place of each cell with the most texture both ways, away from the window's edges; whole px (x, y)."""
    edge = PATCH_PX // 2 + ROWS_PX // 2 + 2
    strength = cv2.cornerHarris(image, PATCH_PX, 3, BOTH_WAYS)
    rows = np.linspace(edge, image.shape[0] - edge, CELLS[1] + 1).astype(int)
    columns = np.linspace(margin + edge, image.shape[1] - edge, CELLS[0] + 1).astype(int)
    places = []
    for top, bottom in pairwise(rows.tolist()):
        for start, end in pairwise(columns.tolist()):
            if bottom > top and end > start:
                _, most, _, (x, y) = cv2.minMaxLoc(strength[top:bottom, start:end])
                if most > LEAST_TEXTURE:
                    places.append((start + x, top + y))
    return np.array(places, np.float32).reshape(-1, 2)


def _coarse(left: Image, right: Image, disparities: int, places: Places,
            ) -> tuple[Places, Places, Bool[np.ndarray, "n"]]:
    """The places, how far away the right view shows them, and whether it does."""
    half, rows = PATCH_PX // 2, ROWS_PX // 2 + 1
    shift, found = np.zeros_like(places), np.zeros(len(places), bool)
    for number, (x, y) in enumerate(places.astype(int).tolist()):
        patch = left[y - half:y + half + 1, x - half:x + half + 1]
        top, start = max(0, y - half - rows), max(0, x - half - disparities)
        strip = right[top:y + half + rows + 1, start:x + half + 1]
        _, score, _, (column, row) = cv2.minMaxLoc(cv2.matchTemplate(strip, patch, cv2.TM_CCOEFF_NORMED))
        shift[number] = start + column + half - x, top + row + half - y
        found[number] = score > LEAST_SCORE
    return places, shift, found
