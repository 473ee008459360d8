"""Gauges: a sphere of known radius or a flat among points measured by stereo, found and fitted whatever else is there."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares
from scipy.spatial.distance import cdist

from binpick.errors import InputError
from binpick.rigcheck.rows import Rows
from binpick.rigcheck.verdict import UNKNOWN, Verdict

Points = Float[np.ndarray, "n 3"]
MOST = 20_000
"""Points looked at: neighbours share what was matched, so that more say nothing new."""
SEEDS, AROUND = 800, 40
"""Places that are tried, and points about each that a first sphere is laid through."""
CAP = 0.8
"""Of the radius: a cap so wide is a third as high, far above the noise."""
ALIKE = 0.2
"""A first sphere's radius may differ by this share from the one given."""
FACING = 0.6
"""Cosine between a surface and the line of sight below which windows of the matcher reach over the edge."""
FEWEST = 300
THICK = 0.005
"""Of the distance: what lies further from a plane is not part of the flat."""
WINDOW_PX = 20
"""Points closer than that were matched by the same pixels and err alike: only as many count as there are such windows."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """What was fitted; `inside`: which of the points lie on it. `rms_m`: their distance from it, robustly."""

    inside: Bool[np.ndarray, "n"]
    rms_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Sphere(Fit):
    """Centre, radius and the radius' sigma, metres."""

    centre: Float[np.ndarray, "3"]
    radius_m: float
    sigma_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Flat(Fit):
    """Unit normal towards the camera and height of its smooth bend with sigma, metres."""

    normal: Float[np.ndarray, "3"]
    bend_m: float
    sigma_bend_m: float


def sphere(points: Points, radius_m: float) -> Sphere:
    """The sphere of about that radius that most points lie on, fitted with its radius free.

    Points are in a camera's frame, metres. Raises InputError when there is none.
    """
    some = _thinned(points)
    centres, radii = _caps(some[::3], radius_m)
    if not len(centres):
        raise InputError(f"no sphere with a radius of {1000 * radius_m:g} mm is seen")
    near = np.abs(np.linalg.norm(some[None, ::4] - centres[:, None], axis=2) - radii[:, None]) < 0.04 * radius_m
    best = int(np.argmax(near.sum(1)))
    found = np.array([*centres[best], radii[best]])
    band = 0.1 * radius_m
    for _ in range(6):
        found, sigma_m, scatter = _fitted(some[_on(some, found, band)], found, band / 3)
        band = max(4 * scatter, 0.002 * radius_m)
    inside = _on(points, found, band)
    if inside.sum() < FEWEST or abs(found[3] / radius_m - 1) > ALIKE:
        raise InputError(f"no sphere with a radius of {1000 * radius_m:g} mm is seen well enough")
    return Sphere(inside, scatter, found[:3], float(found[3]), sigma_m * _alike(len(points), len(some)))


def _caps(some: Points, radius_m: float) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k"]]:
    """Spheres through the surroundings of places here and there: |p|² = 2 c·p + (r² − |c|²) is linear in both unknowns."""
    some = np.random.default_rng(0).permutation(some)
    near = cdist(some[:SEEDS], some) < CAP * radius_m
    count = near.cumsum(1, dtype=np.int32)
    full = count[:, -1] >= AROUND
    caps = some[np.nonzero(near[full] & (count[full] <= AROUND))[1]].reshape(-1, AROUND, 3)
    middle = caps.mean(1, keepdims=True)
    local = (caps - middle) / radius_m
    terms = np.concatenate([2 * local, np.ones((*local.shape[:2], 1))], axis=2)
    squares = (local**2).sum(2)
    turned = terms.transpose(0, 2, 1)
    solved = np.linalg.solve(turned @ terms + 1e-6 * np.eye(4), turned @ squares[..., None])
    found = solved[..., 0]
    radii = np.sqrt(np.clip(found[:, 3] + (found[:, :3]**2).sum(1), 0, None)) * radius_m
    centres = middle[:, 0] + found[:, :3] * radius_m
    # a hollow's centre lies on the camera's side
    good = (np.abs(radii / radius_m - 1) < ALIKE) & ((centres * middle[:, 0]).sum(1) > (middle[:, 0]**2).sum(1))
    return centres[good][:200], radii[good][:200]


def _on(points: Points, found: Float[np.ndarray, "4"], band: float) -> Bool[np.ndarray, "n"]:
    """Near the surface, and where it faces the camera."""
    out = points - found[:3]
    away = np.linalg.norm(out, axis=1)
    facing = -(out * points).sum(1) > FACING * away * np.linalg.norm(points, axis=1)
    return np.asarray((np.abs(away - found[3]) < band) & facing)


def _fitted(near: Points, start: Float[np.ndarray, "4"], scale: float) -> tuple[Float[np.ndarray, "4"], float, float]:
    """Centre and radius, the radius' sigma, and the points' scatter (of the median, as a Gaussian's)."""
    if len(near) < 20:
        raise InputError("no sphere is seen well enough")

    def off(x: Float[np.ndarray, "4"]) -> Float[np.ndarray, "n"]:
        return np.asarray(np.linalg.norm(near - x[:3], axis=1) - x[3])

    found = least_squares(off, start, loss="soft_l1", f_scale=scale, x_scale=[0.001] * 4)
    scatter = float(1.4826 * np.median(np.abs(off(found.x))))
    return found.x, float(scatter * np.sqrt(np.linalg.pinv(found.jac.T @ found.jac)[3, 3])), scatter


def flat(points: Points) -> Flat:
    """The plane that most points lie on, and how much it bends.

    Points are in a camera's frame, metres. Raises InputError when not even a fifth of them lie on one.
    """
    some = _thinned(points)
    if len(some) < FEWEST:
        raise InputError(f"{len(some)} measured points: too few for a flat")
    draw = np.random.default_rng(0)
    corners = some[draw.integers(0, len(some), (500, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    corners, normals = corners[lengths > 0], normals[lengths > 0] / lengths[lengths > 0, None]
    heights = np.abs(some[::8] @ normals.T - (corners[:, 0] * normals).sum(1))
    widest = band = THICK * float(np.median(np.linalg.norm(some, axis=1)))
    best = int(np.argmax((heights < band).sum(0)))
    normal, at = normals[best], corners[best, 0]
    for _ in range(6):
        inside = np.abs((some - at) @ normal) < band
        at = some[inside].mean(0)
        normal = np.linalg.svd(some[inside] - at, full_matrices=False)[2][2]
        rms_m, bend_m, sigma_bend_m = bend(some[inside])
        band = min(4 * rms_m + bend_m, widest)
    normal = -normal if normal @ at > 0 else normal
    inside = np.abs((points - at) @ normal) < band
    if inside.mean() < 0.2:
        raise InputError("no flat is seen: less than a fifth of what is measured lies on one plane")
    return Flat(inside, rms_m, normal, bend_m, sigma_bend_m * _alike(len(points), len(some)))


def bend(places: Points) -> tuple[float, float, float]:
    """Rms distance from a plane, then height of the smooth part of that (a paraboloid) and its sigma, metres."""
    centred = places - places.mean(0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    x, y, height = (centred @ axes.T).T
    wide = max(np.ptp(x), np.ptp(y))
    x, y = x / wide, y / wide
    terms = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    found, _, rank, _ = np.linalg.lstsq(terms, height, rcond=None)
    if rank < terms.shape[1] or len(x) <= terms.shape[1]:
        return float(np.sqrt(np.mean(height**2))), UNKNOWN, UNKNOWN
    smooth = terms[:, 3:] @ found[3:]
    smooth = smooth - terms[:, :3] @ np.linalg.lstsq(terms[:, :3], smooth, rcond=None)[0]
    variance = np.sum((height - terms @ found)**2) / (len(x) - terms.shape[1])
    spread = np.diag(np.linalg.inv(terms.T @ terms))[3:]
    return float(np.sqrt(np.mean(height**2))), float(np.ptp(smooth)), float(np.sqrt(variance * spread.max()) / 4)


def _thinned(points: Points) -> Float[np.ndarray, "k 3"]:
    return points[::max(1, len(points) // MOST)]


def _alike(points: int, used: int) -> float:
    """By how much a sigma that takes all used points for independent is too small."""
    return max(1.0, WINDOW_PX * float(np.sqrt(used / points)))


def of_sphere(points: Points, radius_m: float, rows: Rows) -> Verdict:
    """What the sphere says, not judged yet; `rows` were looked at in the same images."""
    found = sphere(points, radius_m)
    return Verdict("sphere", int(found.inside.sum()), float(np.linalg.norm(found.centre)), rows, planarity_m=found.rms_m,
                   scale_permille=1000 * (found.radius_m / radius_m - 1), sigma_permille=1000 * found.sigma_m / radius_m)


def of_flat(points: Points, rows: Rows) -> Verdict:
    """What the flat says, not judged yet; `rows` were looked at in the same images."""
    found = flat(points)
    middle = points[found.inside].mean(0)
    return Verdict("flat", int(found.inside.sum()), float(np.linalg.norm(middle)), rows, planarity_m=found.rms_m,
                   bend_m=found.bend_m, sigma_bend_m=found.sigma_bend_m)
