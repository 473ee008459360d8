"""Round bars: a slice whose points lie on a circle is cut from a cylinder, whose widest line is seldom seen."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

EVEN_M = 0.0006
"""So far, root mean square, the points may lie off the circle: two sigma of depth at 1 m."""
SEEN = 0.6
"""Of a bar's diameter at least this share must be seen, else its circle is a guess."""
BULGE_M = 0.001
"""What bulges less is flat."""
HIDDEN_M = 0.001
"""So far what is seen may reach beyond the circle."""

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
