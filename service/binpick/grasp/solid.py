"""A closed mesh: read from a file, refused when it cannot be a part, and asked by rays and distances."""

from pathlib import Path

import numpy as np
import open3d as o3d
from jaxtyping import Float32, Float64, Int64

from binpick.errors import InputError
from binpick.geometry import Vector

SIDES_M = (0.004, 1.0)
"""Largest sides of parts that stereo can see and a tool can lift; a mesh beyond them has the wrong unit."""
UNITS = {"m": 1.0, "mm": 0.001}
LEAST_VOLUME = 1e-5
"""Of a part's, in cubes of its largest side: less is a sheet with two sides."""
SKEW = np.array([0.5391, 0.3517, 0.7652])
"""A direction along no edge of anything that people design."""

Vertices = Float64[np.ndarray, "v 3"]
Triangles = Int64[np.ndarray, "t 3"]


def read(file: Path, unit: str) -> "Solid":
    """The solid of a file. Raises InputError, which says why it is none, or which unit would fit."""
    vertices, triangles = _triangles(file)
    _plausible(file, vertices, unit)
    return Solid(vertices * UNITS[unit], _closed(file, vertices, triangles))


def _triangles(file: Path) -> tuple[Vertices, Triangles]:
    """Vertices and triangles, equal corners joined: an STL file has each triangle for itself."""
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh = o3d.io.read_triangle_mesh(file)
    vertices, triangles = np.asarray(mesh.vertices), np.asarray(mesh.triangles).astype(np.int64)
    if not len(triangles) or not np.isfinite(vertices).all():
        raise InputError(f"{file}: holds no triangles: it must be STL, OBJ, PLY, OFF or GLTF")
    size = float(np.ptp(vertices, axis=0).max())
    places = np.round((vertices - vertices.min(axis=0)) / max(size * 1e-6, 1e-12)).astype(np.int64)
    _, first, joined = np.unique(places, axis=0, return_index=True, return_inverse=True)
    triangles = joined.reshape(-1)[triangles]
    flat = (triangles == np.roll(triangles, 1, axis=1)).any(axis=1)
    return vertices[first], triangles[~flat]


def _plausible(file: Path, vertices: Vertices, unit: str) -> None:
    """Refuses a size that no part has, and says which unit would give one."""
    size = float(np.ptp(vertices, axis=0).max())
    low, high = SIDES_M
    if low <= size * UNITS[unit] <= high:
        return
    fits = [f"unit: {other} would make it {1000 * size * factor:.4g} mm" for other, factor in UNITS.items()
            if low <= size * factor <= high]
    raise InputError(f"{file}: with unit: {unit} its largest side is {1000 * size * UNITS[unit]:.4g} mm, and parts have "
                     f"{1000 * low:.0f} to {1000 * high:.0f} mm" + (f"; {fits[0]}" if fits else ""))


def _closed(file: Path, vertices: Vertices, triangles: Triangles) -> Triangles:
    """The triangles, all turned outwards; an open mesh has no inside and is refused."""
    if _open_edges(triangles):
        mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(triangles))
        mesh.orient_triangles()
        triangles = np.asarray(mesh.triangles).astype(np.int64)
    if count := _open_edges(triangles):
        raise InputError(f"{file}: the mesh is not closed: {count} of its edges border one triangle only (or two that face "
                         "opposite ways). Export the part as a solid, or close its holes")
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    volume = float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum())
    if abs(volume) < 6 * LEAST_VOLUME * float(np.ptp(vertices, axis=0).max()) ** 3:
        raise InputError(f"{file}: the mesh has no volume: it is a surface, not a solid")
    return triangles if volume > 0 else triangles[:, ::-1]


def _open_edges(triangles: Triangles) -> int:
    """Edges that are not run through as often one way as the other; pieces that touch may share theirs."""
    start, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    way = np.where(start < end, 1, -1)
    pairs, which = np.unique(np.stack([np.minimum(start, end), np.maximum(start, end)], axis=1), axis=0, return_inverse=True)
    return int(np.count_nonzero(np.bincount(which.reshape(-1), weights=way, minlength=len(pairs))))


class Solid:
    """Rays and distances to a closed mesh, whose pieces may overlap."""

    def __init__(self, vertices: Vertices, triangles: Triangles) -> None:
        self.size_m = float(np.ptp(vertices, axis=0).max())
        self.low, self.high = vertices.min(axis=0), vertices.max(axis=0)
        self._corners = vertices[triangles]
        normals = np.cross(self._corners[:, 1] - self._corners[:, 0], self._corners[:, 2] - self._corners[:, 0])
        self._area = np.linalg.norm(normals, axis=1)
        self._normals = normals / np.maximum(self._area, 1e-30)[:, None]
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(_tensor(vertices.astype(np.float32)), _tensor(triangles.astype(np.uint32)))

    @property
    def centre(self) -> Vector:
        """Of its volume (of pieces, each for itself): symmetries turn about it."""
        a, b, c = (self._corners[:, k] for k in range(3))
        volume = np.einsum("ij,ij->i", a, np.cross(b, c))
        return np.asarray(volume @ (a + b + c) / (4 * volume.sum()))

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Whether a ray leaves more often than it enters: overlapping pieces do not cancel as they do by parity."""
        rays = np.concatenate([points, np.broadcast_to(SKEW, points.shape)], axis=1).astype(np.float32)
        hits = self._scene.list_intersections(_tensor(rays))
        ways = np.sign(self._normals[hits["primitive_ids"].numpy()] @ SKEW)
        return np.asarray(np.bincount(hits["ray_ids"].numpy(), weights=ways, minlength=len(points)) > 0.5)

    def distance(self, points: np.ndarray) -> Float32[np.ndarray, "n"]:
        """To the nearest triangle."""
        found: Float32[np.ndarray, "n"] = self._scene.compute_distance(_tensor(points.astype(np.float32))).numpy()
        return found

    def seen(self, points: np.ndarray, normals: np.ndarray, towards: np.ndarray) -> np.ndarray:
        """Which of the points an eye far away in a direction sees."""
        start = points + normals * (1e-3 * self.size_m)
        rays = np.concatenate([start, np.broadcast_to(towards, points.shape)], axis=1).astype(np.float32)
        hidden = self._scene.test_occlusions(_tensor(rays)).numpy()
        return np.asarray(~hidden & (normals @ towards > 0.1))

    def surface(self, count: int) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
        """Points spread evenly over what can be touched, always the same ones, and the normals there."""
        i = np.arange(count) + 0.5
        total = np.cumsum(self._area)
        which = np.minimum(np.searchsorted(total, i / count * total[-1]), len(total) - 1)
        # low-discrepancy barycentric coordinates: the plastic number's powers
        u, v = (i * 0.7548776662) % 1, (i * 0.5698402910) % 1
        over = u + v > 1
        u[over], v[over] = 1 - u[over], 1 - v[over]
        a, b, c = (self._corners[which, k] for k in range(3))
        points, normals = a + u[:, None] * (b - a) + v[:, None] * (c - a), self._normals[which]
        outside = ~self.inside(points + normals * 1e-5)
        return points[outside], normals[outside]


def _tensor(array: np.ndarray) -> o3d.core.Tensor:
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(array))
