"""The seal: one plane through what is measured under all lips of a tool, and how far the surface leaves it under each."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int32

from binpick.grasp.spots import SKIRT_RADIUS, Patch

FIT_RADIUS = 1.1
"""The plane is fitted, and the seal judged, within this many lip radii."""
LIP = (0.7, 1.15)
"""The ring, in lip radii, in which the part must prevail all around."""
OUTSIDE = (0.95, 1.25)
"""Under several cups it must show all around this far out too: beside a deep step nothing is measured, so nothing else prevails
there. A single cup stands in the middle of what it sees; of rows one hung over such edges in 11 of 100 grasps (now 7)."""
SECTORS = 16
"""The lip is judged in this many sectors; each must show the part."""

Values = Float64[np.ndarray, "n"]
Points = Float64[np.ndarray, "n k"]
Chosen = Bool[np.ndarray, "n k"]


@dataclass(frozen=True, slots=True, eq=False)
class Seal:
    """The lips' fit on each spot: plane slopes and level in the spot's frame, and how far the surface leaves it.

    `rms_m` is over all points under the lips, `support` their number, `centre_m` their mean in the middle of a single lip;
    `bend_m`, `deviation_m`, `stand_out_m` and `room` are the worst cup's. `under`: which points the plane was fitted to.
    """

    slope: Float64[np.ndarray, "n 2"]
    level_m: Values
    centre_m: Values
    rms_m: Values
    bend_m: Values
    deviation_m: Values
    stand_out_m: Values
    room: Values
    support: Int32[np.ndarray, "n"]
    under: Chosen

    def normal_bin(self, T_bin_spot: Float64[np.ndarray, "n 4 4"]) -> Float64[np.ndarray, "n 3"]:
        """Unit normals of the fitted planes in the bin's frame."""
        local = np.concatenate([-self.slope, np.ones((len(self.slope), 1))], axis=1)
        local /= np.linalg.norm(local, axis=1, keepdims=True)
        normals: Float64[np.ndarray, "n 3"] = np.einsum("nac,nc->na", T_bin_spot[:, :3, :3], local)
        return normals


def on_one_part(patch: Patch) -> Bool[np.ndarray, "n"]:
    """Whether the part goes all around under every lip."""
    rings = [(LIP, 2)] if len(patch.cups) == 1 else [(LIP, 2), (OUTSIDE, 1)]
    whole: Bool[np.ndarray, "n"] = np.all(
        [_sectors(patch.of_cup(number), *ring, least) == SECTORS for number in patch.cups for ring, least in rings], axis=0)
    return whole


def seal(patch: Patch) -> Seal:
    """Least-squares plane of the own points under the lips, and the residuals that matter.

    `deviation_m` is the 90th percentile of a lip zone's residuals: a maximum would be the noise's, not the surface's.
    `bend_m` is how far a lip would have to follow the curvature alone: what a quadratic surface leaves of a plane.
    """
    x, y, z = (patch.local[..., a].astype(np.float64) for a in range(3))
    known, radial, radius_m = np.isfinite(z), patch.radial, patch.lip[:, 2].astype(np.float64)
    x, y, z = (np.where(known, a, 0.0) for a in (x, y, z))
    under = known & patch.own & (radial <= FIT_RADIUS) & (np.abs(z) < radius_m)
    slope, level = _fit_planes(x, y, z, under)
    residual = z - level[:, None] - slope[:, :1] * x - slope[:, 1:] * y
    u, v = (a - patch.lip[:, axis] for axis, a in enumerate((x, y)))
    count = under.sum(axis=1)
    bend, deviation, stand_out, room = [], [], [], []
    for number in patch.cups:
        mine = patch.cup == number
        of, off, away = under[:, mine], residual[:, mine], radial[:, mine]
        bend.append(_bend(u[:, mine] / radius_m[mine], v[:, mine] / radius_m[mine], off, of))
        deviation.append(_quantile(np.abs(off), of & (away >= 0.6), 0.90))
        stand_out.append(_quantile(off, known[:, mine] & (away <= SKIRT_RADIUS), 0.98))
        room.append(_sectors(patch.of_cup(number), LIP[1], SKIRT_RADIUS) / SECTORS)
    middle = under & (radial <= 0.4)
    # between several cups the TCP lies on the plane
    centre = np.where(middle, residual, 0).sum(axis=1) / np.maximum(middle.sum(axis=1), 1) * (len(bend) == 1)
    return Seal(
        slope=slope, level_m=level, support=(count * patch.stride**2).astype(np.int32), under=under, centre_m=centre,
        rms_m=np.sqrt((np.where(under, residual, 0) ** 2).sum(axis=1) / np.maximum(count, 1)), room=np.min(room, axis=0),
        bend_m=np.max(bend, axis=0), deviation_m=np.max(deviation, axis=0), stand_out_m=np.max(stand_out, axis=0))


def _sectors(patch: Patch, inner: float, outer: float, least: int = 2) -> Int32[np.ndarray, "n"]:
    """In how many sectors of a ring around one cup on each spot at least so many own points prevail; radii in lip radii."""
    x, y = (patch.local[..., a] - patch.lip[:, a] for a in range(2))
    radial = patch.radial
    with np.errstate(invalid="ignore"):
        ring = (radial >= inner) & (radial <= outer)
    sector = np.floor((np.arctan2(y[ring], x[ring]) + np.pi) * (SECTORS / (2 * np.pi))).astype(np.int64) % SECTORS
    bins = SECTORS * np.nonzero(ring)[0] + sector
    own = patch.own[ring]
    mine, others = (np.bincount(bins[whose], minlength=SECTORS * len(x)).reshape(-1, SECTORS) for whose in (own, ~own))
    held: Int32[np.ndarray, "n"] = ((mine >= least) & (mine >= 3 * others)).sum(axis=1).astype(np.int32)
    return held


def _fit_planes(x: Points, y: Points, z: Points, under: Chosen) -> tuple[Float64[np.ndarray, "n 2"], Values]:
    """z = level + slope · (x, y) by normal equations; a microscopic ridge (1 µm²) keeps spots without points solvable."""
    solved = _least_squares(np.stack([x, y, np.ones_like(x)], axis=1), z, under, 1e-12)
    return solved[:, :2], solved[:, 2]


def _least_squares(rows: Float64[np.ndarray, "n c k"], z: Points, of: Chosen, ridge: float) -> Float64[np.ndarray, "n c"]:
    """Coefficients of z in c functions over each spot's selected points; the ridge keeps spots with too few solvable."""
    chosen = rows * of[:, None]
    normal = chosen @ rows.transpose(0, 2, 1) + np.eye(rows.shape[1]) * ridge
    solved: Float64[np.ndarray, "n c"] = np.linalg.solve(normal, chosen @ z[..., None])[..., 0]
    return solved


def _bend(x: Points, y: Points, residual: Points, under: Chosen) -> Values:
    """Amplitude on the lip (radius 1) of the best quadratic's saddle a x² + b x y + c y² about the plane; same unit as z.

    A bowl (a = c, b = 0) costs the lip nothing, it only sits deeper; a cylinder of radius R costs r² / 4R.
    """
    rows = np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)], axis=1)
    a, b, c = _least_squares(rows, residual, under, 1e-6)[:, :3].T
    amplitude: Values = np.hypot((a - c) / 2, b / 2)
    return amplitude


def _quantile(values: Points, of: Chosen, share: float) -> Values:
    """The quantile over each row's selected values; inf where a row has none."""
    ordered = np.sort(np.where(of, values, np.inf), axis=1)
    count = of.sum(axis=1)
    index = np.maximum(np.ceil(share * count).astype(int) - 1, 0)
    picked: Values = np.take_along_axis(ordered, index[:, None], axis=1)[:, 0]
    return picked
