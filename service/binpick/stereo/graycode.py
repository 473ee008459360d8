"""Gray code of a programmable projector: each camera reads the projector's columns, equal columns are matches."""

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, Int16, Int32

from binpick.data import (
    BLACK_PATTERN,
    FIRST_GRAY_PATTERN,
    GRAY_CODE_SIZE_PX,
    Depth,
    Disparity,
    Image,
    Light,
    Mask,
    Rectified,
    frozen,
)
from binpick.stereo import direct
from binpick.stereo.search import SCALE

LEAST_CONTRAST = 8
"""Grey levels between white and black from which a pixel is read; fitted on the exam's steel, tuning seeds."""
CLEAR = 4
"""Grey levels between an image and its inverse from which a bit is certain; one uncertain bit is a code edge."""
NOISE = 3.5
"""1-sigma of that difference, grey levels: sqrt(2) times a CMOS sensor's 2.5 at half its scale."""
FLOOR_PX = 0.07
"""1-sigma that is left without noise: stripes are sampled by pixels, twice; fitted on the exam's tuning seeds."""
ROW_TOLERANCE = 2
"""Projector rows by which a match may differ: rounding and rectification, 1 each. A mirror image is further off."""
LONGEST_GAP_PX = 6.0
LARGEST_STEP_PX = 1.0
"""Between two code edges a pixel is interpolated when they are near to each other, in the image and in disparity."""

Codes = Int32[np.ndarray, "h w"]
Steps = Int16[np.ndarray, "n h w"]


@dataclass(frozen=True, slots=True, eq=False)
class _Edges:
    """Where one column of the projector gives way to the next, in the order of rows and columns of the image.

    `key` is image row times columns of the code plus column, `x` the place in the row, px, `row` the projector's row there,
    `sigma` the place's noise, px.
    """

    key: Int[np.ndarray, "n"]
    y: Int[np.ndarray, "n"]
    x: Float32[np.ndarray, "n"]
    row: Int32[np.ndarray, "n"]
    sigma: Float32[np.ndarray, "n"]

    def take(self, some: Bool[np.ndarray, "n"]) -> "_Edges":
        """Some of them, in order."""
        return _Edges(self.key[some], self.y[some], self.x[some], self.row[some], self.sigma[some])


def complete(lights: tuple[Light, ...]) -> bool:
    """Whether the shots hold the whole sequence: every image and its inverse, white and black."""
    return set(range(FIRST_GRAY_PATTERN, BLACK_PATTERN + 1)) <= {light.pattern for light in lights if light.projector}


def measure(shots: tuple[Rectified, ...], lights: tuple[Light, ...], speckle_px: int) -> Depth:
    """The depth of the window's pixels from a complete sequence, without islands of up to `speckle_px` pixels.

    `fill` gives the nearest measured disparity (0 when there is none).
    """
    disparity, sigma_px = decode(shots, lights)
    low = shots[0].window.min_disparity
    raw = np.where(np.isfinite(disparity), (disparity - low) * SCALE, -SCALE).round().astype(np.int16)
    if speckle_px:
        cv2.filterSpeckles(raw, -SCALE, speckle_px, 2 * SCALE)
    measured = raw >= 0
    nan = np.float32(np.nan)
    disparity, sigma_px = np.where(measured, disparity, nan), np.where(measured, sigma_px, nan)
    return Depth(disparity=frozen(disparity), fill=partial(_filled, disparity, measured),
                 confidence=frozen(measured.astype(np.uint8) * 255), measured=frozen(measured), sigma_px=frozen(sigma_px))


def _filled(disparity: Disparity, measured: Mask) -> Disparity:
    if not measured.any():
        return np.zeros(disparity.shape, np.float32)
    _, nearest = cv2.distanceTransformWithLabels((~measured).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    value = np.zeros(int(nearest.max()) + 1, np.float32)
    value[nearest[measured]] = disparity[measured]
    filled: Disparity = value[nearest]
    return filled


def decode(shots: tuple[Rectified, ...], lights: tuple[Light, ...]) -> tuple[Disparity, Disparity]:
    """Disparity of the window's pixels (absolute, px, NaN: not measured) and its sigma, from a complete sequence.

    Reads the code of OpenCV's GrayCodePattern, but does not use its decoder, which takes 15 s for 1400x1000 px, is seven times
    less exact, since it knows pixels and not what lies between them, and writes 0 for "nothing". A code edge is where an image
    equals its inverse: the zero crossing of their difference. Pixels between two edges get what lies between the disparities.
    """
    by_pattern = {light.pattern: shot for shot, light in zip(shots, lights, strict=True) if light.projector}
    sequence = [by_pattern[pattern] for pattern in range(FIRST_GRAY_PATTERN, BLACK_PATTERN + 1)]
    view = shots[0].window
    left = _edges([shot.left for shot in sequence])
    right = _edges([shot.right for shot in sequence])
    partner = _partners(left, right, view.num_disparities)
    left, partner = left.take(partner >= 0), partner[partner >= 0]
    disparity = left.x - right.x[partner] + np.float32(view.min_disparity)
    kept = direct.seen(np.stack([left.x, left.y, disparity], axis=-1).astype(float),
                       np.stack([left.key % GRAY_CODE_SIZE_PX[0], left.row], axis=-1).astype(float))
    sigma = np.sqrt(left.sigma**2 + right.sigma[partner] ** 2 + np.float32(FLOOR_PX**2))
    dense, noise = _between(left.y[kept], left.x[kept], disparity[kept], sigma[kept], shots[0].left.shape)
    margin = shots[0].margin
    return frozen(np.ascontiguousarray(dense[:, margin:])), frozen(np.ascontiguousarray(noise[:, margin:]))


def _edges(images: list[Image]) -> _Edges:
    """The code edges of one camera; `images` from the first of the code to white and black."""
    width, height = GRAY_CODE_SIZE_PX
    column_bits, row_bits = (width - 1).bit_length(), (height - 1).bit_length()
    steps = np.stack([images[2 * bit].astype(np.int16) - images[2 * bit + 1] for bit in range(column_bits + row_bits)])
    column, column_sure = _read(steps[:column_bits])
    row, row_sure = _read(steps[column_bits:])
    white, black = images[-2], images[-1]
    legible = column_sure & row_sure & (cv2.subtract(white, black) >= LEAST_CONTRAST)
    legible &= (column < width) & (row < height)
    edge = (np.abs(np.diff(column, axis=1)) == 1) & legible[:, 1:] & legible[:, :-1]
    y, x = np.nonzero(edge)
    below = np.minimum(column[y, x], column[y, x + 1])
    # of two neighbouring codes one bit differs: the one that the sum with 1 sets in the plain number
    changed = column_bits - 1 - np.log2((below + 1) & -(below + 1)).astype(np.intp)
    before, after = (steps[changed, y, x + side].astype(np.float32) for side in (0, 1))
    slope = before - after
    return _Edges(key=y * width + below, y=y, x=x.astype(np.float32) + before / slope, row=row[y, x],
                  sigma=np.float32(NOISE) / np.abs(slope))


def _read(steps: Steps) -> tuple[Codes, Mask]:
    """The numbers of a Gray code, and where at most one bit is uncertain: then an error moves the edge, not the number."""
    number = np.zeros(steps.shape[1:], np.int32)
    bit = np.zeros(steps.shape[1:], bool)
    unsure = np.zeros(steps.shape[1:], np.uint8)
    for step in steps:
        bit ^= step > 0
        number = 2 * number + bit
        unsure += np.abs(step) < CLEAR
    return number, unsure <= 1


def _partners(left: _Edges, right: _Edges, num_disparities: int) -> Int[np.ndarray, "n"]:
    """For each left edge the right one of the same columns, in the same row of the image and of the projector; -1: not one.

    A column may come twice in a row of the image, where a near thing hides the far one's neighbourhood: the rows decide.
    """
    if not len(right.key):
        return np.full(len(left.key), -1)
    order = np.argsort(right.key, kind="stable")
    keys = right.key[order]
    first = np.searchsorted(keys, left.key)
    partner = np.full(len(left.key), -1)
    found = np.zeros(len(left.key), np.uint8)
    for place in (first, first + 1, first + 2):
        candidate = order[np.minimum(place, len(keys) - 1)]
        apart = left.x - right.x[candidate]
        fits = ((place < len(keys)) & (right.key[candidate] == left.key) & (apart >= 0) & (apart < num_disparities)
                & (np.abs(right.row[candidate] - left.row) <= ROW_TOLERANCE))
        partner = np.where(fits, candidate, partner)
        found += fits
    taken = np.bincount(partner[found == 1], minlength=len(keys))
    return np.where((found == 1) & (taken[partner] == 1), partner, -1)


def _between(y: Int[np.ndarray, "n"], x: Float32[np.ndarray, "n"], disparity: Float32[np.ndarray, "n"],
             sigma: Float32[np.ndarray, "n"], shape: tuple[int, int]) -> tuple[Disparity, Disparity]:
    """Fields over the image: each pixel between two edges near it gets what lies between their values."""
    rows, cols = shape
    if len(x) < 2:
        return np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32)
    passed = np.bincount(y * cols + np.ceil(x).astype(np.intp), minlength=rows * cols)[:rows * cols].cumsum()
    after = passed.clip(1, len(x) - 1)
    before = after - 1
    at = np.tile(np.arange(cols, dtype=np.float32), rows)
    gap = x[after] - x[before]
    sound = (y[before] == y[after]) & (gap > 0) & (gap <= LONGEST_GAP_PX) & (at >= x[before]) & (at <= x[after])
    sound &= np.abs(disparity[after] - disparity[before]) <= LARGEST_STEP_PX
    sound &= y[before] == np.repeat(np.arange(rows), cols)
    share = (at - x[before]) / np.where(sound, gap, 1)
    nan = np.float32(np.nan)
    between, noise = (np.where(sound, field[before] + share * (field[after] - field[before]), nan).reshape(shape)
                      for field in (disparity, sigma))
    return between, noise
