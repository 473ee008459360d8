"""The measured surface at half resolution: points and edge-preserving normals in the bin's frame.

On a plane 1/z, and so disparity, is affine in the pixel coordinates; a plane fit in disparity is linear and its noise is
even. Each pixel takes the fit of the window around it, of five, that fits best, so a window across an edge never wins.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64

from binpick import geometry
from binpick.data import Cloud, Depth, Mask, Rectified
from binpick.geometry import Transform

RADIUS = 3
"""Half side of a fit window, half-resolution px: 7x7 are about 8 mm at 1 m."""
STRIPS = 6
"""So many strips of rows are fitted one by one."""
SUPPORT = 0.5
"""Least share of measured pixels in a fit window."""
WINDOWS = ((0, 0), (-RADIUS, -RADIUS), (-RADIUS, RADIUS), (RADIUS, -RADIUS), (RADIUS, RADIUS))
"""Where the fit windows around a pixel are centred (row, column): on it, or with it at their corner."""


Box = tuple[geometry.Vector, geometry.Vector]
"""Lowest and highest corner."""
Field = Float32[np.ndarray, "h w"]
Rows = Float32[np.ndarray, "r w"]
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
        return Surface(self.xyz[box], self.normal[box], self.sigma_z_m[box], self.eyes)


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
    weight = cv2.resize(mask.astype(np.float32), (cols, rows), interpolation=cv2.INTER_AREA)
    # 0.49: two of four; NaN marks the rest, and passes through every division
    weight[weight < 0.49] = np.nan
    values = (cv2.copyTo(field[:2 * rows, :2 * cols], mask) for field in (depth.disparity, depth.sigma_px))
    disparity, sigma_px = (cv2.resize(value, (cols, rows), interpolation=cv2.INTER_AREA) / weight for value in values)
    return disparity, sigma_px


def _planes(disparity: Field, wanted: Mask) -> tuple[Int64[np.ndarray, "n"], Values, Values, Values]:
    """Those wanted pixels, in reading order, whose best plane has support: its slopes per half-resolution px and its level."""
    cols = disparity.shape[1]
    box = around(wanted, 2 * RADIUS)
    near = np.ascontiguousarray(disparity[box])
    slope_u, slope_v, level, misfit = (field.ravel() for field in _fits(near, np.isfinite(near)))
    width = near.shape[1]
    row, col = np.nonzero(wanted[box])
    # what the windows reach beyond the window's border has no support
    framed = np.pad(misfit.reshape(near.shape), RADIUS, constant_values=np.inf).ravel()
    at = (row + RADIUS) * (width + 2 * RADIUS) + col + RADIUS
    best, source = framed[at], row * width + col
    centre = source.copy()
    for dv, du in WINDOWS[1:]:
        error = framed[at + dv * (width + 2 * RADIUS) + du]
        better = error < best
        source[better] = centre[better] + dv * width + du
        np.minimum(best, error, out=best)
    found = np.isfinite(best)
    source, row, col = source[found], row[found], col[found]
    a, b = slope_u[source], slope_v[source]
    down, right = source // width - row, source % width - col
    place = (row + box[0].start) * cols + col + box[1].start
    return place, a, b, (level[source] - a * right - b * down).astype(np.float32)


def around(mask: Mask, margin: int = 0) -> tuple[slice, slice]:
    """The smallest box that holds a mask, with a margin as far as there are pixels; the first pixel if it is empty."""
    rows, cols = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return slice(0, 1), slice(0, 1)
    high, wide = (slice(max(0, int(side[0]) - margin), min(count, int(side[-1]) + 1 + margin))
                  for side, count in zip((rows, cols), mask.shape, strict=True))
    return high, wide


def _fits(disparity: Field, known: Mask) -> tuple[Field, Field, Field, Field]:
    """Least-squares planes of the windows centred on every pixel, by box sums; misfit is inf without support.

    float32 suffices around the median disparity: with |d| < 40 px the misfit, a difference of squares, is good to 1e-4 px².
    Strips stay in the processor's cache; they are the same however many threads work on them.
    """
    few = disparity[::4, ::4][known[::4, ::4]]
    mid = np.float32(np.median(few) if few.size else 0)
    d, w = cv2.copyTo(disparity - mid, known.view(np.uint8)), known.astype(np.float32)
    edges = np.linspace(0, len(d), STRIPS + 1).astype(int).tolist()
    with ThreadPoolExecutor(max(1, cv2.getNumThreads()), thread_name_prefix="binpick-fits") as pool:
        strips = list(pool.map(partial(_strip, d, w), edges[:-1], edges[1:]))
    a, b, level, misfit = (np.concatenate(fields) for fields in zip(*strips, strict=True))
    return a, b, level + mid, misfit


def _strip(d: Field, w: Field, begin: int, end: int) -> tuple[Rows, Rows, Rows, Rows]:
    """The planes of some rows' windows; `d` is 0 where its weight `w` is."""
    first = max(0, begin - RADIUS)
    d, w, rows = d[first:end + RADIUS], w[first:end + RADIUS], slice(begin - first, end - first)
    ones = np.ones(2 * RADIUS + 1, dtype=np.float32)
    ramp = np.arange(-RADIUS, RADIUS + 1, dtype=np.float32)

    def window(field: Field, along_u: Float32[np.ndarray, "k"], along_v: Float32[np.ndarray, "k"]) -> Rows:
        summed: Rows = cv2.sepFilter2D(field, cv2.CV_32F, along_u, along_v, borderType=cv2.BORDER_CONSTANT)[rows]
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
    return a, b, mean_d - a * mean_u - b * mean_v, misfit
