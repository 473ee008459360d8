"""Least-squares planes of the windows centred on every cell, and how much each has to say."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from binpick.stereo import sums
from binpick.stereo.compiled import compiled

Cells = Float32[np.ndarray, "rows cols"]
Padded = Float32[np.ndarray, "more_rows more_cols"]
LEAST_COST = np.float32(1e-5)
"""Squared px: no plane fits better than this, and no window outvotes all others by more."""
SLOPE_PRIOR = np.float32(0.05)
"""Cells² added to the windows' moments: keeps planes with little support level."""
LEAST_SUPPORT, FAINT = np.float32(1e-6), np.float32(1e-3)
"""Of a window's summed weight; and of the mean support below which a plane's cost grows."""
OF_WEIGHT, OF_DISPARITY = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)), ((0, 0), (1, 0), (0, 1))
"""Powers along u and v of the moments that a plane needs; then the square of the disparity."""


@dataclass(frozen=True, slots=True, eq=False)
class Planes:
    """`say` is the inverse cube of a plane's cost, px^-6; level at the centre (px, less the middle) and slopes per cell are
    multiplied by it. These four have as many zeros around as windows have cells to a side. `support`: mean weight."""

    say: Padded
    level: Padded
    slope_u: Padded
    slope_v: Padded
    support: Cells


def planes(disparity: Cells, weight: Cells, radius: int, middle: float) -> Planes:
    """The planes. float32 suffices around the middle: |d| < 64 px, misfits good to 1e-3 px²."""
    size = 2 * radius + 1
    length = -(-size // sums.AT_ONCE) * sums.AT_ONCE
    taps = np.zeros((3, length), np.float32)
    taps[:, :size] = np.arange(-radius, radius + 1) ** np.arange(3)[:, None]
    centred = disparity - np.float32(middle)
    weighted = weight * centred
    beyond = length - 1 - radius
    padded, inside = np.zeros((3, *(side + length - 1 for side in weight.shape)), np.float32), slice(radius, -beyond)
    padded[:, inside, inside] = weight, weighted, weighted * centred     # zeros around: windows end nowhere
    return Planes(*_planes(padded[0], padded[1], padded[2], taps, radius))


@compiled
def _planes(weight: Padded, weighted: Padded, squared: Padded, taps: Float32[np.ndarray, "3 taps"], radius: int,
            ) -> tuple[Padded, Padded, Padded, Padded, Cells]:
    rows, cols = weight.shape[0] - taps.shape[1] + 1, weight.shape[1] - taps.shape[1] + 1
    support, moments = np.empty((rows, cols), np.float32), np.empty((10, cols), np.float32)
    out = np.zeros((4, rows + 2 * radius, cols + 2 * radius), np.float32)
    column = np.empty(weight.shape[1], np.float32)
    for v in range(rows):
        for power in range(3):
            sums.down(weight, v, taps[power], column)
            for k, (along_u, along_v) in enumerate(OF_WEIGHT):
                if along_v == power:
                    sums.across(column, taps[along_u], moments[k])
        for power in range(2):
            sums.down(weighted, v, taps[power], column)
            for k, (along_u, along_v) in enumerate(OF_DISPARITY):
                if along_v == power:
                    sums.across(column, taps[along_u], moments[6 + k])
        sums.down(squared, v, taps[0], column)
        sums.across(column, taps[0], moments[9])
        at, share = v + radius, np.float32(1 / (2 * radius + 1)**2)
        _row(moments, share, out[0, at, radius:], out[1, at, radius:], out[2, at, radius:], out[3, at, radius:], support[v])
    return out[0], out[1], out[2], out[3], support


@compiled
def _row(moments: Float32[np.ndarray, "10 w"], share: np.float32, says: sums.Longer, levels: sums.Longer,
         slopes_u: sums.Longer, slopes_v: sums.Longer, supports: sums.Line) -> None:
    """The planes of a row: say; level and slopes times that; support."""
    for i in range(len(supports)):
        n = max(moments[0, i], LEAST_SUPPORT)
        scale = 1 / n
        mean_u, mean_v, mean_d = moments[1, i] * scale, moments[2, i] * scale, moments[6, i] * scale
        uu = moments[3, i] * scale - mean_u * mean_u + SLOPE_PRIOR
        uv = moments[4, i] * scale - mean_u * mean_v
        vv = moments[5, i] * scale - mean_v * mean_v + SLOPE_PRIOR
        ud, vd = moments[7, i] * scale - mean_u * mean_d, moments[8, i] * scale - mean_v * mean_d
        dd = moments[9, i] * scale - mean_d * mean_d
        per_det = 1 / (uu * vv - uv * uv)
        slope_u, slope_v = (ud * vv - vd * uv) * per_det, (vd * uu - ud * uv) * per_det
        misfit, support = max(dd - slope_u * ud - slope_v * vd, np.float32(0)), n * share
        cost = max(misfit + FAINT / (support + FAINT), LEAST_COST)
        say = 1 / (cost * cost * cost)
        says[i], levels[i] = say, say * (mean_d - slope_u * mean_u - slope_v * mean_v)
        slopes_u[i], slopes_v[i], supports[i] = say * slope_u, say * slope_v, support
