"""The measured surface at half resolution: points and edge-preserving normals in the bin's frame.

On a plane 1/z, and so disparity, is affine in the pixel coordinates; a plane fit in disparity is linear and its noise is
even. Each pixel takes the fit of the window around it, of five, that fits best, so a window across an edge never wins.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64

from binpick import geometry
from binpick.data import Cloud, Depth, Mask, Rectified
from binpick.geometry import Transform

RADIUS = 3
"""Half side of a fit window, half-resolution px: 7x7 are about 8 mm at 1 m."""
SUPPORT = 0.5
"""Least share of measured pixels in a fit window."""
WINDOWS = ((0, 0), (-RADIUS, -RADIUS), (-RADIUS, RADIUS), (RADIUS, -RADIUS), (RADIUS, RADIUS))
"""Where the fit windows around a pixel are centred (row, column): on it, or with it at their corner."""
_CENTRES = np.zeros((2 * RADIUS + 1, 2 * RADIUS + 1), dtype=np.uint8)
_CENTRES[tuple(np.array(WINDOWS).T + RADIUS)] = 1
"""The same as a picture, for cv2.dilate."""
_WEIGHTS = np.full(256, np.nan, dtype=np.float32)
"""By the number of measured pixels in a block: their share, or NaN, which passes through every division."""
_WEIGHTS[2:5] = 0.5, 0.75, 1.0

Box = tuple[geometry.Vector, geometry.Vector]
"""Lowest and highest corner."""
Field = Float32[np.ndarray, "h w"]
Values = Float32[np.ndarray, "n"]


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Points and unit normals (towards the camera) in the bin's frame, NaN = not measured; sigma_z_m of one pixel.

    `eyes` is where the two cameras stand: what is measured is seen by both.
    """

    xyz: Cloud
    normal: Cloud
    sigma_z_m: Float32[np.ndarray, "h w"]
    eyes: Float64[np.ndarray, "2 3"]

    def cut(self, box: tuple[slice, slice]) -> "Surface":
        """Its rows and columns in a box."""
        xyz, normal, sigma_z_m = (np.ascontiguousarray(field[box]) for field in (self.xyz, self.normal, self.sigma_z_m))
        return Surface(xyz, normal, sigma_z_m, self.eyes)


def surface(depth: Depth, rectified: Rectified, T_bin_camera: Transform, box_bin: Box | None = None) -> Surface:
    """The surface of the window at half resolution; normals only of what lies in a box of the bin's frame, if one is given."""
    disparity, sigma_px = _half(depth)
    view = rectified.window
    rows, cols = disparity.shape
    # the centre of half-resolution pixel j lies at full-resolution 2 j + 0.5
    u = (2 * np.arange(cols) + 0.5 + view.x - rectified.cx_px).astype(np.float32)
    v = (2 * np.arange(rows) + 0.5 + view.y - rectified.cy_px).astype(np.float32)
    f = np.float32(rectified.focal_px)
    z = np.float32(rectified.focal_px * rectified.baseline_m) / disparity
    T_bin_rect = T_bin_camera @ rectified.T_camera_rect
    xyz = geometry.transform(T_bin_rect, cv2.merge([z * (u / f)[None, :], z * (v / f)[:, None], z]))
    wanted = np.isfinite(disparity) if box_bin is None else _inside(xyz, box_bin)
    place, slope_u, slope_v, level = _planes(disparity, wanted)
    row, col = np.divmod(place, cols)
    # a u + b v + c = f b / z  =>  n ~ (a f, b f, a (u - cx) .. + c) with u, v counted from the principal point
    a, b = slope_u / 2, slope_v / 2
    c = level - a * u[col] - b * v[row]
    a, b = a * f, b * f
    towards = -1 / np.sqrt(a * a + b * b + c * c)
    normal = np.full((rows * cols, 3), np.nan, dtype=np.float32)
    normal[place] = geometry.rotate(T_bin_rect, np.stack([a * towards, b * towards, c * towards], axis=-1))
    sigma = z * z * sigma_px * np.float32(1 / (rectified.focal_px * rectified.baseline_m))
    eyes = geometry.transform(T_bin_rect, np.array([[0.0, 0, 0], [rectified.baseline_m, 0, 0]]))
    return Surface(xyz=xyz, normal=normal.reshape(xyz.shape), sigma_z_m=sigma, eyes=eyes)


def _inside(xyz: Cloud, box: Box) -> Mask:
    """Points in a box, borders included; NaN lies in none."""
    return np.asarray(cv2.inRange(xyz, *(tuple(corner.tolist()) for corner in box)) > 0)


def _half(depth: Depth) -> tuple[Field, Field]:
    """Mean disparity and sigma of each 2x2 block with at least two measured pixels, else NaN."""
    rows, cols = depth.disparity.shape[0] // 2, depth.disparity.shape[1] // 2
    known = depth.measured[:2 * rows, :2 * cols]
    mask = np.ascontiguousarray(known).view(np.uint8)
    # the mean of fours is how many of the four are measured
    weight = cv2.LUT(cv2.resize(mask * np.uint8(4), (cols, rows), interpolation=cv2.INTER_AREA), _WEIGHTS)
    values = (cv2.copyTo(field[:2 * rows, :2 * cols], mask) for field in (depth.disparity, depth.sigma_px))
    disparity, sigma_px = (cv2.resize(value, (cols, rows), interpolation=cv2.INTER_AREA) / weight for value in values)
    return disparity, sigma_px


def _planes(disparity: Field, wanted: Mask) -> tuple[Int64[np.ndarray, "n"], Values, Values, Values]:
    """Those wanted pixels, in reading order, whose best plane has support: its slopes per half-resolution px and its level."""
    cols = disparity.shape[1]
    box = around(wanted, 2 * RADIUS)
    asked = wanted[box]
    centres = np.flatnonzero(cv2.dilate(asked.view(np.uint8), _CENTRES, borderType=cv2.BORDER_CONSTANT, borderValue=0))
    slope_u, slope_v, level, misfit = _fits(np.ascontiguousarray(disparity[box]), centres)
    # which fit is centred where: what the windows reach beyond the border has none, and the last one, added, no support
    width, wide = asked.shape[1], asked.shape[1] + 2 * RADIUS
    fit_at = np.full((len(asked) + 2 * RADIUS) * wide, -1, dtype=np.int32)
    fit_at[_framed(centres, width)] = np.arange(len(centres), dtype=np.int32)
    misfit = np.append(misfit, np.float32(np.inf))
    pixels = np.flatnonzero(asked)
    at = _framed(pixels, width)
    fits = [fit_at[at + dv * wide + du] for dv, du in WINDOWS]
    best = np.stack([misfit[fit] for fit in fits], axis=1).argmin(axis=1)
    fit = np.choose(best, fits)
    found = np.flatnonzero(misfit[fit] < np.inf)
    fit, (row, col) = fit[found], np.divmod(pixels[found], width)
    a, b, (down, right) = slope_u[fit], slope_v[fit], np.array(WINDOWS)[best[found]].T
    place = (row + box[0].start) * cols + col + box[1].start
    return place, a, b, (level[fit] - a * right - b * down).astype(np.float32)


def _framed(pixels: Int64[np.ndarray, "n"], width: int) -> Int64[np.ndarray, "n"]:
    """Pixels of a picture that is this wide in one that has a frame of RADIUS around it."""
    framed: Int64[np.ndarray, "n"] = pixels + pixels // width * (2 * RADIUS) + RADIUS * (width + 2 * RADIUS + 1)
    return framed


def around(mask: Mask, margin: int = 0) -> tuple[slice, slice]:
    """The smallest box that holds a mask, with a margin as far as there are pixels; the first pixel if it is empty."""
    rows, cols = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return slice(0, 1), slice(0, 1)
    high, wide = (slice(max(0, int(side[0]) - margin), min(count, int(side[-1]) + 1 + margin))
                  for side, count in zip((rows, cols), mask.shape, strict=True))
    return high, wide


def _fits(disparity: Field, centres: Int64[np.ndarray, "n"]) -> tuple[Values, Values, Values, Values]:
    """Least-squares planes of the windows centred on some pixels, by box sums; misfit is inf without support.

    float32 suffices around the median disparity: with |d| < 40 px the misfit, a difference of squares, is good to 1e-4 px².
    """
    known = np.isfinite(disparity)
    few = disparity[::4, ::4][known[::4, ::4]]
    mid = np.float32(np.median(few) if few.size else 0)
    d, w = cv2.copyTo(disparity - mid, known.view(np.uint8)), known.astype(np.float32)
    ones = np.ones(2 * RADIUS + 1, dtype=np.float32)
    ramp = np.arange(-RADIUS, RADIUS + 1, dtype=np.float32)

    def window(field: Field, along_u: Float32[np.ndarray, "k"], along_v: Float32[np.ndarray, "k"]) -> Values:
        summed: Values = cv2.sepFilter2D(field, cv2.CV_32F, along_u, along_v, borderType=cv2.BORDER_CONSTANT).ravel()[centres]
        return summed

    n = np.maximum(window(w, ones, ones), 1)
    mean_u, mean_v, mean_d = window(w, ramp, ones) / n, window(w, ones, ramp) / n, window(d, ones, ones) / n
    uu = window(w, ramp**2, ones) / n - mean_u**2
    vv = window(w, ones, ramp**2) / n - mean_v**2
    uv = window(w, ramp, ramp) / n - mean_u * mean_v
    ud = window(d, ramp, ones) / n - mean_u * mean_d
    vd = window(d, ones, ramp) / n - mean_v * mean_d
    dd = window(d * d, ones, ones) / n - mean_d**2
    det = uu * vv - uv * uv
    usable = (n >= SUPPORT * ones.size**2) & (det > 0.5)
    det[~usable] = np.nan
    a, b = (ud * vv - vd * uv) / det, (vd * uu - ud * uv) / det
    misfit = np.maximum(dd - a * ud - b * vd, np.float32(0))
    misfit[~usable] = np.inf
    return a, b, mean_d - a * mean_u - b * mean_v + mid, misfit
