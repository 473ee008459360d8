"""Round bars: a slice whose points lie on a circle is cut from a cylinder, whose widest line is seldom seen."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from binpick.geometry import Vector

EVEN_M = 0.0006
"""So far, root mean square, the points may lie off the circle: two sigma of depth at 1 m."""
SEEN = 0.6
"""Of a bar's diameter at least this share must be seen, else its circle is a guess."""
BULGE_M = 0.001
"""What bulges less is flat."""
HIDDEN_M = 0.001
"""So far what is seen may reach beyond the circle."""

UPRIGHT = 0.5
"""Sine of the angle to the vertical below which a bar stands: its side is not seen."""
ALMOST = 0.98
"""Share of a part's points that tell how wide it is seen."""
ROUNDS, ASTRAY_M, MOSTLY = 3, 0.0015, 0.9
"""A whole part's points further off its circle than this are ends and edges; most must be nearer."""

Values = Float64[np.ndarray, "n"]


@dataclass(frozen=True, slots=True, eq=False)
class Circles:
    """Middle across and along the approach, and radius, of the slices that are `round`; of the `cap`s only the top is seen."""

    x_m: Values
    z_m: Values
    radius_m: Values
    round: Bool[np.ndarray, "n"]
    cap: Bool[np.ndarray, "n"]


def moments(x: Values, z: Values) -> Float64[np.ndarray, "9 n"]:
    """What `circles` needs the sums of: 1, x, z, xx, xz, zz, xq, zq, qq with q = xx + zz."""
    q = x * x + z * z
    return np.stack([np.ones_like(x), x, z, x * x, x * z, z * z, x * q, z * q, q * q])


def circles(sums: Float64[np.ndarray, "9 n"], low_m: Values, high_m: Values) -> Circles:
    """The circle of each slice, by least squares of q = 2 a x + 2 b z + c (Kasa 1976), and whether it is one."""
    n, x, z, xx, xz, zz, xq, zq, qq = sums
    q = xx + zz
    ridge = 1e-12 * n
    normal = np.stack([np.stack([xx + ridge, xz, x]), np.stack([xz, zz + ridge, z]), np.stack([x, z, n])]).transpose(2, 0, 1)
    right = np.stack([xq, zq, q], axis=1)
    a, b, c = np.linalg.solve(normal, right[..., None])[..., 0].T
    radius = np.sqrt(np.maximum(c + (a * a + b * b) / 4, 1e-12))
    off = np.maximum(qq - a * xq - b * zq - c * q, 0) / n
    x_m, z_m, width = a / 2, b / 2, high_m - low_m
    fits = (np.sqrt(off) < 2 * radius * EVEN_M) & (low_m > x_m - radius - HIDDEN_M) & (high_m < x_m + radius + HIDDEN_M)
    # seen from above, the surface bulges towards the eye
    fits &= (radius - np.sqrt(np.maximum(radius * radius - width * width / 4, 0)) > BULGE_M) & (z_m > z / n)
    enough = width > SEEN * 2 * radius
    return Circles(x_m, z_m, radius, fits & enough, fits & ~enough)


@dataclass(frozen=True, slots=True, eq=False)
class Bar:
    """A round bar, frame `bin`: a point of its axis, and the axis, a unit vector."""

    middle: Vector
    axis: Vector

    def outwards(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Unit vectors away from the axis, at each point."""
        off = points - self.middle
        off -= (off @ self.axis)[:, None] * self.axis
        outwards: Float64[np.ndarray, "n 3"] = off / np.maximum(np.linalg.norm(off, axis=1, keepdims=True), 1e-9)
        return outwards


def bar(points: Float64[np.ndarray, "k 3"], normals: Float64[np.ndarray, "k 3"]) -> Bar | None:
    """The bar that a part's points and normals (frame `bin`, seen from above) show; None when it is none.

    Its axis is the direction that the normals avoid.
    """
    axis = np.linalg.eigh(normals.T @ normals)[1][:, 0]
    up = np.array([0.0, 0.0, 1.0]) - axis * axis[2]
    height = float(np.linalg.norm(up))
    if height < UPRIGHT:
        return None
    up /= height
    across, middle = np.cross(axis, up), points.mean(axis=0)
    x, z = (points - middle) @ across, (points - middle) @ up
    low, high = (np.quantile(x, share)[None] for share in (1 - ALMOST, ALMOST))
    near = np.ones(len(x), dtype=bool)
    for _ in range(ROUNDS):
        found = circles(moments(x[near], z[near]).sum(axis=1)[:, None], low, high)
        off = np.hypot(x - found.x_m, z - found.z_m) - found.radius_m
        near = np.abs(off) < ASTRAY_M
        if near.sum() < 3:
            return None
    wide = SEEN * 2 * found.radius_m[0] < high[0] - low[0] < 2 * found.radius_m[0] + 2 * HIDDEN_M
    if near.mean() < MOSTLY or not wide:
        return None
    return Bar(middle + found.x_m[0] * across + found.z_m[0] * up, axis)
