"""Slices across parts and faces: strips as wide as a gripper's pad, and where along a closing axis each of them ends.

All slices of a scene are cut at once: every measured point falls into a strip of every axis that its patch is looked at along,
one sort orders them, and a slice is a window over neighbouring strips.
"""

from dataclasses import dataclass, fields, replace
from functools import partial
from typing import TypeAlias

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64

from binpick import threads
from binpick.data import Labels, Segments
from binpick.grasp.bars import Circles, circles, moments

STRIPS = 5
"""A slice is cut into this many strips, each with its own two ends."""
LEAST_STRIPS = 3
"""Of these so many must show the part."""
STEP = 2
"""Slices begin at every second strip."""
WHOLE = 0.85
"""A face with more than this share of its part is the part."""
SAME_RAD = np.radians(6.0)
"""Axes and approaches this near each other are one."""
TOUCH_M = 0.0005
"""Strips that end this near the outermost end are touched with it."""
NEAR_M = 0.08
"""Parts this near a wall are also looked at from further inside: there a gripper's body finds no room beside the wall."""
LEANS = (0.5, 0.95)
"""So far, in shares of the tool's limit."""
HIGHER = 0.25
"""Ends of a round bar count this share of its radius above its widest line."""
THIN = 2
"""Inside a patch every second point of every second row is enough; its border counts in full."""

Values = Float64[np.ndarray, "n"]
Windows = Float64[np.ndarray, "n strips"]
Patch: TypeAlias = tuple[int, Float64[np.ndarray, "_ 3"], Float64[np.ndarray, "_ 3"]]


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A patch of one part as an approach sees it: points and normals in `R_bin_view`, whose z is the approach."""

    part: int
    R_bin_view: Float64[np.ndarray, "3 3"]
    points: Float64[np.ndarray, "n 3"]
    normals: Float64[np.ndarray, "n 3"]


@dataclass(frozen=True, slots=True, eq=False)
class Slices:
    """n slices, each in a frame turned by `R_bin_tcp` about the bin's origin: x closes, z approaches.

    `axis` numbers the patches' closing axes. `low_m`, `high_m`: ends along x; `across_m`: middle along y; `deep_m`: the deeper
    end along z, `touch_m`: the higher of the places where a closing pad meets the ends first. `slope`: angles of the lines
    through its strips' ends to y; `residual_m`: how far an end leaves its line; `lean`: of the mean normal to z in the closing
    plane; `chord`: of the line from end to end to x. Angles in radians.
    """

    part: Int64[np.ndarray, "n"]
    axis: Int64[np.ndarray, "n"]
    R_bin_tcp: Float64[np.ndarray, "n 3 3"]
    low_m: Values
    high_m: Values
    across_m: Values
    deep_m: Values
    touch_m: Values
    slope: Float64[np.ndarray, "n 2"]
    residual_m: Values
    lean: Values
    chord: Values

    @property
    def width_m(self) -> Values:
        """From end to end."""
        width: Values = self.high_m - self.low_m
        return width

    def take(self, index: Int64[np.ndarray, "m"]) -> "Slices":
        """Some of the slices."""
        return Slices(**{field.name: getattr(self, field.name)[index] for field in fields(self)})


def cut(segments: Segments, width_m: float, max_tilt_rad: float, half_m: tuple[float, float]) -> Slices:
    """All slices of all parts and faces, good or not, `width_m` wide; none is looked at more than `max_tilt_rad` aslant.

    `half_m`: how far the walls are from the bin's middle, along x and y.
    """
    views = _views(_patches(segments), max_tilt_rad, half_m)
    turned = [(view, angle) for view in views for angle in _axes(view)]
    # in two halves, however many threads there are, so that nothing depends on their number
    halves = turned[:len(turned) // 2], turned[len(turned) // 2:]
    with threads.pool("slices") as pool:
        one, other = pool.map(partial(_along, width_m=width_m), halves)
    other = replace(other, axis=other.axis + len(halves[0]))
    return Slices(*(np.concatenate([getattr(one, field.name), getattr(other, field.name)]) for field in fields(Slices)))


def _along(turned: list[tuple[View, float]], width_m: float) -> Slices:
    """All slices along some axes."""
    if not turned:
        whole, real = np.zeros(0, dtype=np.int64), np.zeros(0)
        return Slices(whole, whole, np.zeros((0, 3, 3)), real, real, real, real, real, np.zeros((0, 2)), real, real, real)
    pitch = width_m / STRIPS
    strips = _strips(turned, pitch)
    which, window = np.nonzero(np.isfinite(strips.low).sum(axis=2) >= LEAST_STRIPS)
    low, high, low_z, high_z = (values[which, window] for values in (strips.low, strips.high, strips.low_z, strips.high_z))
    n_x, n_z, *sums = np.nansum(strips.sums[:, which, window], axis=2)
    x_m, z_m = strips.middle[which].T
    at = (np.arange(STRIPS) - (STRIPS - 1) / 2) * pitch
    (low_slope, low_off), (high_slope, high_off) = (_lines(at, ends) for ends in (low, high))
    ends_z = np.stack([_mean(low_z), _mean(high_z)])
    left, right = np.nanmin(low, axis=1), np.nanmax(high, axis=1)
    touch = [np.where(outwards <= TOUCH_M, z, np.inf).min(axis=1)
             for outwards, z in ((low - left[:, None], low_z), (right[:, None] - high, high_z))]
    frames = np.stack([_frame(view, angle) for view, angle in turned])
    seen = Slices(
        part=np.array([view.part for view, _ in turned])[which], axis=which, R_bin_tcp=frames[which], low_m=left, high_m=right,
        across_m=(strips.first[which] + STEP * window - (STRIPS - LEAST_STRIPS) + STRIPS / 2) * pitch,
        deep_m=ends_z.max(axis=0), touch_m=np.minimum(*touch),
        slope=np.arctan(np.stack([low_slope, high_slope], axis=1)), residual_m=np.maximum(low_off, high_off),
        lean=np.arctan2(n_x, -n_z), chord=np.arctan2(ends_z[1] - ends_z[0], np.maximum(right - left, 1e-6)))
    return _rounded(seen, circles(np.stack(sums), left - x_m, right - x_m), x_m, z_m)


def _rounded(seen: Slices, circle: Circles, x_m: Values, z_m: Values) -> Slices:
    """The slices, those across round bars with their true ends, which face each other from wherever they are looked at.

    Circles are told from the place x_m, z_m. Of a cap the ends are on top, where fingers slip off: no hold, its chord says.
    """
    def either(bar: Values, other: Values) -> Values:
        chosen: Values = np.where(circle.round, bar, other)
        return chosen

    level, widest, middle = np.zeros(len(seen.part)), z_m + circle.z_m, x_m + circle.x_m
    # a little beyond its widest line a bar is held: one on the floor leaves fingertips no more
    deep = widest - HIGHER * circle.radius_m
    return replace(seen, low_m=either(middle - circle.radius_m, seen.low_m),
                   high_m=either(middle + circle.radius_m, seen.high_m), deep_m=either(deep, seen.deep_m),
                   touch_m=either(widest, seen.touch_m), lean=either(level, seen.lean),
                   chord=np.where(circle.cap, np.pi / 2, either(level, seen.chord)))


def _patches(segments: Segments) -> list[Patch]:
    """Part label, points and normals of every part, and of every face that is not nearly a whole part."""
    parts, xyz, normal = segments.parts.ravel(), segments.xyz.reshape(-1, 3), segments.normal.reshape(-1, 3)
    on_part = np.flatnonzero(parts)
    found = []
    for labels in (segments.parts, segments.faces):
        flat = labels.ravel()
        sizes = np.bincount(flat[on_part])
        kept = on_part[_telling(labels, on_part)]
        # 16 bits are sorted in one pass
        order = kept[np.argsort(flat[kept].astype(np.uint16), kind="stable")]
        for pixels in np.split(order, np.flatnonzero(np.diff(flat[order])) + 1):
            if not len(pixels):
                continue
            part, label = int(parts[pixels[0]]), int(flat[pixels[0]])
            if labels is segments.faces and sizes[label] > WHOLE * len(segments.part_points[part]):
                continue
            found.append((part, xyz[pixels].astype(np.float64), normal[pixels].astype(np.float64)))
    return found


def _telling(labels: Labels, pixels: Int64[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Which of the pixels are labelled and at the border of their patch, or on a thin grid inside."""
    flat, cols = labels.ravel(), labels.shape[1]
    telling = (pixels // cols % THIN == 0) & (pixels % cols % THIN == 0)
    for step in (-cols, -1, 1, cols):
        telling |= flat[pixels] != np.take(flat, pixels + step, mode="clip")
    found: Bool[np.ndarray, "n"] = telling & (flat[pixels] > 0)
    return found


def _views(patches: list[Patch], max_tilt_rad: float, half_m: tuple[float, float]) -> list[View]:
    """Every patch along its mean normal, as far as the tool may tilt, straight down, and at a wall from further inside."""
    seen = []
    for patch in patches:
        mean = patch[2].mean(axis=0)
        mean /= max(float(np.sqrt(mean @ mean)), 1e-9)
        tilt = float(np.arccos(np.clip(mean[2], -1, 1)))
        if tilt <= max_tilt_rad:
            seen.append((patch, -mean))
        if tilt > SAME_RAD:
            seen.append((patch, np.array([0.0, 0.0, -1.0])))
        seen += [(patch, approach) for approach in _from_inside(patch[1].mean(axis=0), max_tilt_rad, half_m)]
    frames = _frames(np.array([approach for _, approach in seen]).reshape(-1, 3))
    return [View(part, R, points @ R, normals @ R) for ((part, points, normals), _), R in zip(seen, frames, strict=True)]


def _from_inside(at_m: Float64[np.ndarray, "3"], max_tilt_rad: float, half_m: tuple[float, float],
                 ) -> list[Float64[np.ndarray, "3"]]:
    """Approaches that keep a gripper's body away from the walls that are near: towards each, leaning by shares of the limit."""
    found = []
    for axis in (0, 1):
        if abs(at_m[axis]) > half_m[axis] - NEAR_M:
            for lean in (share * max_tilt_rad for share in LEANS):
                approach = np.array([0.0, 0.0, -np.cos(lean)])
                approach[axis] = np.copysign(np.sin(lean), at_m[axis])
                found.append(approach)
    return found


def _frames(z: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3 3"]:
    """Rotations whose z is given and whose x lies in the plane of it and the bin's x; a tool's approach is never along x."""
    x = np.array([1.0, 0.0, 0.0]) - z[:, :1] * z
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=2)


def _axes(view: View) -> list[float]:
    """Closing directions as angles in the view: sides of the smallest rectangle around the patch, and its principal axes."""
    flat = view.points[:, :2]
    if len(flat) < LEAST_STRIPS:
        return []
    rectangle = float(np.radians(cv2.minAreaRect(flat.astype(np.float32))[2]))
    u, v = (flat - flat.mean(axis=0)).T
    principal = float(np.arctan2(2 * (u @ v), u @ u - v @ v) / 2)
    found: list[float] = []
    for angle in (rectangle, rectangle + np.pi / 2, principal, principal + np.pi / 2):
        if all(abs((angle - other + np.pi / 2) % np.pi - np.pi / 2) > SAME_RAD for other in found):
            found.append(angle)
    return found


def _frame(view: View, angle: float) -> Float64[np.ndarray, "3 3"]:
    c, s = np.cos(angle), np.sin(angle)
    R_bin_tcp: Float64[np.ndarray, "3 3"] = view.R_bin_view @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return R_bin_tcp


@dataclass(frozen=True, slots=True, eq=False)
class Strips:
    """Windows over the strips of every view and axis, NaN where a strip has no point: both ends, their z, sums over points.

    `first`: the number of each axis' first strip, counted from the bin's origin. `sums`: of n_x, n_z, and of
    `bars.moments`, for which x and z count from each axis' `middle`.
    """

    first: Int64[np.ndarray, "axes"]
    low: Float64[np.ndarray, "axes windows strips"]
    high: Float64[np.ndarray, "axes windows strips"]
    low_z: Float64[np.ndarray, "axes windows strips"]
    high_z: Float64[np.ndarray, "axes windows strips"]
    sums: Float64[np.ndarray, "eleven axes windows strips"]
    middle: Float64[np.ndarray, "axes 2"]


def _strips(turned: list[tuple[View, float]], pitch_m: float) -> Strips:
    """Orders all points by axis, strip and x; the first and the last of each strip are its ends."""
    axis = np.repeat(np.arange(len(turned)), [len(view.points) for view, _ in turned])
    cos, sin = (np.array([turn(angle) for _, angle in turned])[axis] for turn in (np.cos, np.sin))
    u, v, z = np.concatenate([view.points for view, _ in turned]).T
    n_u, n_v, n_z = np.concatenate([view.normals for view, _ in turned]).T
    x, y = cos * u + sin * v, cos * v - sin * u
    strip = np.floor(y / pitch_m).astype(np.int64)
    begins = np.searchsorted(axis, np.arange(len(turned)))
    first = np.minimum.reduceat(strip, begins)
    strip -= first[axis]
    count = int(strip.max()) + 1
    cell = axis * count + strip
    middle = np.stack([np.add.reduceat(side, begins) for side in (x, z)], axis=1) / np.diff(begins, append=len(x))[:, None]
    # one integer orders by cell, then by x to a micrometre
    order = np.argsort((cell << 23) + np.round((x + 4) * 1e6).astype(np.int64))
    cell, axis, x, z, n_x, n_z = cell[order], axis[order], x[order], z[order], (cos * n_u + sin * n_v)[order], n_z[order]
    low = np.flatnonzero(np.diff(cell, prepend=-1))
    high = np.append(low[1:], len(cell)) - 1

    def windows(values: Values) -> Float64[np.ndarray, "axes windows strips"]:
        beside = STRIPS - LEAST_STRIPS
        grid = np.full((len(turned), count + 2 * beside), np.nan)
        grid[cell[low] // count, cell[low] % count + beside] = values
        return np.lib.stride_tricks.sliding_window_view(grid, STRIPS, axis=1)[:, ::STEP]

    from_middle = (side - middle[axis, i] for i, side in enumerate((x, z)))
    summed = np.concatenate([[n_x, n_z], moments(*from_middle)])
    return Strips(first=first, low=windows(x[low]), high=windows(x[high]), low_z=windows(z[low]), high_z=windows(z[high]),
                  sums=np.stack([windows(np.add.reduceat(values, low)) for values in summed]), middle=middle)


def _mean(values: Windows) -> Values:
    known = np.isfinite(values)
    mean: Values = np.where(known, values, 0.0).sum(axis=1) / known.sum(axis=1)
    return mean


def _lines(at: Float64[np.ndarray, "strips"], ends: Windows) -> tuple[Values, Values]:
    """Slope of the least-squares line through each row's known ends, and the largest distance from it."""
    known = np.isfinite(ends)
    value = np.where(known, ends, 0.0)
    count = known.sum(axis=1)
    t = (at - (known * at).sum(axis=1, keepdims=True) / count[:, None]) * known
    slope = (t * value).sum(axis=1) / (t * t).sum(axis=1)
    off = np.abs(value - (value.sum(axis=1) / count)[:, None] - slope[:, None] * t) * known
    return slope, off.max(axis=1)
