"""Weighted sums of rows, four at a time: loops that the compiler turns into vectors, and the total is written once for four."""

import numpy as np
from jaxtyping import Float32

from binpick.stereo.compiled import compiled

Line = Float32[np.ndarray, "w"]
Longer = Float32[np.ndarray, "longer"]
"""At least as long as the total."""
Taps = Float32[np.ndarray, "taps"]
"""Weights, a multiple of four of them."""
AT_ONCE = 4


@compiled
def add(total: Line, values: Line, weight: np.float32) -> None:
    """A row with one weight more."""
    if weight != 0:
        for i in range(len(total)):
            total[i] += values[i] * weight


@compiled
def add_four(total: Line, a: Longer, b: Longer, c: Longer, d: Longer, weights: Float32[np.ndarray, "4"]) -> None:
    """Four rows more."""
    of_a, of_b, of_c, of_d = weights[0], weights[1], weights[2], weights[3]
    for i in range(len(total)):
        total[i] += (a[i] * of_a + b[i] * of_b) + (c[i] * of_c + d[i] * of_d)


@compiled
def down(field: Float32[np.ndarray, "h longer"], row: int, taps: Taps, total: Line) -> None:
    """The weighted sum of a field's rows from this one on."""
    total[:] = 0
    for k in range(0, len(taps), AT_ONCE):
        add_four(total, field[row + k], field[row + k + 1], field[row + k + 2], field[row + k + 3], taps[k:k + AT_ONCE])


@compiled
def across(line: Longer, taps: Taps, total: Line) -> None:
    """The weighted sum of what lies in a row from each place on."""
    total[:] = 0
    for k in range(0, len(taps), AT_ONCE):
        add_four(total, line[k:], line[k + 1:], line[k + 2:], line[k + 3:], taps[k:k + AT_ONCE])
