"""The part as designed: a mesh file becomes points that can be seen, a distance field, and the ways it looks alike."""

import functools
import itertools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.spatial.transform import Rotation

from binpick.errors import InputError
from binpick.geometry import Vector
from binpick.grasp import align
from binpick.grasp.field import Field, Grid
from binpick.grasp.solid import Solid, read
from binpick.grasp.turns import Symmetry, Turns, even, thinned
from binpick.settings.mesh import Axis, Mesh

SAMPLES = 600
"""Points of the surface that stand for it."""
DIRECTIONS = 200
"""Directions from which it is known which of them are seen."""
STARTS, APART_RAD = 2500, float(np.radians(24))
"""Of so many even rotations those this far apart, symmetric ones counted once, are where a search begins."""
ALIKE = 0.006
"""A rotation leaves the part as it was when 98 % of its surface stays within this share of its largest side."""

Points = Float32[np.ndarray, "n 3"]


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """A part about `centre`, the middle of its surface in the mesh's frame, metres; all else is relative to it.

    `seen` says which of `points` are seen from each of `directions`, unit vectors from the part to an eye far away, and
    `middles` is the middle of that picture.
    """

    centre: Vector
    points: Points
    normals: Points
    field: Field
    directions: Float32[np.ndarray, "v 3"]
    seen: Bool[np.ndarray, "v n"]
    middles: Float32[np.ndarray, "v 3"]
    symmetry: Symmetry
    starts: Float64[np.ndarray, "s 3 3"]
    size_m: float


def load(mesh: Mesh) -> Shape:
    """The shape of a file, made once until the file or what the recipe says of it changes. Raises InputError."""
    try:
        stat = mesh.file.stat()
    except OSError as error:
        raise InputError(f"{mesh.file}: the mesh cannot be read: {error.strerror}") from error
    return _load(mesh.file, (stat.st_mtime_ns, stat.st_size), mesh.unit, mesh.symmetry)


@functools.lru_cache(maxsize=8)
def _load(file: Path, _version: tuple[int, int], unit: str, symmetry: tuple[Axis, ...] | None) -> Shape:
    return of(read(file, unit), symmetry)


def of(solid: Solid, symmetry: tuple[Axis, ...] | None = None) -> Shape:
    """The shape of a solid, with its own symmetry or the given one."""
    points, normals = solid.surface(SAMPLES)
    grid = Grid.around(solid.low - solid.centre, solid.high - solid.centre)
    middles = (grid.points + solid.centre.astype(np.float32)).reshape(-1, 3)
    field = Field.of(grid, solid.distance(middles).reshape(grid.shape), solid.inside(middles).reshape(grid.shape))
    towards = even_directions(DIRECTIONS)
    seen = np.stack([solid.seen(points, normals, direction) for direction in towards])
    here = (points - solid.centre).astype(np.float32)
    weight = seen * np.maximum(towards @ normals.T, 0)
    middle = ((weight @ here) / np.maximum(weight.sum(axis=1, keepdims=True), 1e-9)).astype(np.float32)
    alike = _found(here, field, solid) if symmetry is None else _given(symmetry)
    return Shape(centre=solid.centre, points=here, normals=normals.astype(np.float32), field=field, directions=towards,
                 seen=seen, middles=middle, symmetry=alike, starts=thinned(even(STARTS), APART_RAD, alike), size_m=solid.size_m)


def even_directions(count: int) -> Points:
    """Unit vectors spread evenly: a Fibonacci spiral."""
    i = np.arange(count)
    z, turn = 1 - (2 * i + 1) / count, i * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z * z)
    return np.asarray(np.column_stack([r * np.cos(turn), r * np.sin(turn), z]), dtype=np.float32)


def _found(points: Points, field: Field, solid: Solid) -> Symmetry:
    """The rotations that leave the part as it was: from everywhere the nearest such one is looked for."""
    nobody, limit_m = Symmetry(np.eye(3)[None]), ALIKE * solid.size_m

    def off(turns: Turns) -> Float64[np.ndarray, "n"]:
        turned = points @ turns.transpose(0, 2, 1).astype(np.float32) + solid.centre.astype(np.float32)
        away = solid.distance(turned.reshape(-1, 3)).reshape(len(turns), -1)
        return np.asarray(np.quantile(away, 0.98, axis=1), dtype=np.float64)

    turns = align.rotations(points[::4], field, even(250), rounds=10)
    rough, _ = field.at(points[::4] @ turns.transpose(0, 2, 1).astype(np.float32))
    turns = np.concatenate([nobody.turns, turns[np.quantile(np.abs(rough), 0.9, axis=1) < 3 * limit_m]])
    turns = align.rotations(points, field, thinned(turns, float(np.radians(3)), nobody), rounds=10)
    misfit = off(turns)
    turns = turns[np.argsort(np.round(misfit, 5), kind="stable")][:int((misfit < limit_m).sum())]
    for vector in Rotation.from_matrix(turns).as_rotvec():
        angle = float(np.linalg.norm(vector))
        about = Rotation.from_rotvec(np.outer([0.37, 1.01, 1.71, 2.63], vector / max(angle, 1e-9))).as_matrix()
        if angle > np.radians(8) and (off(about) < limit_m).all():
            nobody = replace(nobody, axis=vector / angle)
            break
    return replace(nobody, turns=thinned(np.concatenate([np.eye(3)[None], turns]), float(np.radians(8)), nobody))


def _given(axes: tuple[Axis, ...]) -> Symmetry:
    """The rotations that axes of symmetry make, and all that follow from them."""
    round_ = [np.array(each.axis) / np.linalg.norm(each.axis) for each in axes if each.fold == 0]
    axis = round_[0] if round_ else None
    about = [np.array(each.axis) / np.linalg.norm(each.axis) * (2 * np.pi / each.fold) for each in axes if each.fold > 1]
    turns = np.eye(3)[None]
    for _, vector in itertools.product(range(24), about):
        more = np.concatenate([turns, turns @ Rotation.from_rotvec(vector).as_matrix()])
        turns, before = thinned(more, 1e-3, Symmetry(np.eye(3)[None], axis)), turns
        if len(turns) == len(before) and len(about) == 1:
            break
    return Symmetry(turns, axis)

