"""Triangles of parts and bin, and the scene that rays are cast into, in frame `bin`."""

import functools
from dataclasses import dataclass

import numpy as np
import open3d as o3d
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt32

from binpick import geometry
from binpick.sim import exam
from binpick.sim.world import WorldScene

Rays = Float32[np.ndarray, "n 6"]
BIN_ID, TABLE_ID = 0, -1
# facets of 3.75°: a Ø24 cylinder then stays within 0.01 mm of round
CYLINDER_SIDES = 96
TABLE_M = 4.0
# a hit this near a cylinder's side is on it: more than its facets' error, less than what stands out of it
ROUND_WITHIN_M = 2e-4


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Closed pieces (which may overlap), metres, in the frame of the part or the bin."""

    vertices: Float[np.ndarray, "v 3"]
    triangles: UInt32[np.ndarray, "t 3"]


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """Where rays end. `distance` in ray lengths (inf: nowhere); `part_id` also BIN_ID, TABLE_ID; `normal` as modelled."""

    distance: Float32[np.ndarray, "n"]
    part_id: Int32[np.ndarray, "n"]
    normal: Float32[np.ndarray, "n 3"]

    def take(self, index: Int[np.ndarray, "m"]) -> "Hits":
        """Some of the hits."""
        return Hits(self.distance[index], self.part_id[index], self.normal[index])


class Caster:
    """Casts rays at a frozen world: parts, bin and the table it stands on."""

    def __init__(self, scene: WorldScene) -> None:
        self._scene = o3d.t.geometry.RaycastingScene()
        setup = exam.setup(scene.world)
        ids = [self._add(bin_mesh(scene.world), BIN_ID), self._add(_table(setup.bin_wall_m), TABLE_ID)]
        for part in scene.parts:
            mesh = part_mesh(part.kind)
            ids.append(self._add(Mesh(geometry.transform(part.T_bin_part, mesh.vertices), mesh.triangles), part.part_id))
        # the last entry serves the rays that hit nothing
        self._part_ids = np.array([part_id for _, part_id in sorted(ids)] + [TABLE_ID], dtype=np.int32)

    def _add(self, mesh: Mesh, part_id: int) -> tuple[int, int]:
        geometry_id = self._scene.add_triangles(_tensor(mesh.vertices.astype(np.float32)), _tensor(mesh.triangles))
        return int(geometry_id), part_id

    def cast(self, rays: Rays) -> Hits:
        """The first hit of each ray (origin, direction)."""
        answer = self._scene.cast_rays(_tensor(rays))
        index = np.minimum(answer["geometry_ids"].numpy(), len(self._part_ids) - 1)
        return Hits(answer["t_hit"].numpy(), self._part_ids[index], answer["primitive_normals"].numpy())

    def blocked(self, rays: Rays, start: float, end: float) -> Bool[np.ndarray, "n"]:
        """Whether something stands on each ray between `start` and `end` ray lengths."""
        answer: Bool[np.ndarray, "n"] = self._scene.test_occlusions(_tensor(rays), tnear=start, tfar=end).numpy()
        return answer


def rounded(scene: WorldScene, points: Float32[np.ndarray, "n 3"], hits: Hits) -> Float32[np.ndarray, "n 3"]:
    """The normals that hit points of parts have on a true cylinder, where a facet of one was hit: what a mirror needs."""
    normals = hits.normal.copy()
    for part in scene.parts:
        for piece in (p for p in exam.KINDS[part.kind].pieces if p.shape == "cylinder"):
            mine = np.flatnonzero(hits.part_id == part.part_id)
            T_part_bin = geometry.inverse(part.T_bin_part)
            radial = geometry.transform(T_part_bin, points[mine]) - np.array(piece.at_mm, np.float32) / 1000
            length, radial[:, 2] = np.abs(radial[:, 2]), 0
            radius = np.linalg.norm(radial, axis=1)
            along = np.abs(geometry.rotate(T_part_bin, hits.normal[mine])[:, 2])
            on_side = ((np.abs(radius - piece.size_mm[0] / 2000) < ROUND_WITHIN_M) & (along < 0.5)
                       & (length < piece.size_mm[2] / 2000 + ROUND_WITHIN_M))
            normals[mine[on_side]] = geometry.rotate(part.T_bin_part, radial[on_side] / radius[on_side, None])
    return normals


@functools.cache
def part_mesh(kind: str) -> Mesh:
    """A part in its own frame."""
    return _joined([_piece(piece) for piece in exam.KINDS[kind].pieces])


@functools.cache
def bin_mesh(world: str) -> Mesh:
    """Floor and four walls, inner faces at the nominal size."""
    setup = exam.setup(world)
    (length, width, height), wall = setup.bin_size_m, setup.bin_wall_m
    boxes = [((length + 2 * wall, width + 2 * wall, wall), (0.0, 0.0, -wall / 2))]
    for sign in (-1, 1):
        boxes.append(((wall, width + 2 * wall, height), (sign * (length + wall) / 2, 0.0, height / 2)))
        boxes.append(((length, wall, height), (0.0, sign * (width + wall) / 2, height / 2)))
    return _joined([_placed(o3d.geometry.TriangleMesh.create_box(*size), -np.array(size) / 2 + at) for size, at in boxes])


def _tensor(array: np.ndarray) -> o3d.core.Tensor:
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(array))


def _piece(piece: exam.Primitive) -> Mesh:
    size, at = np.array(piece.size_mm) / 1000, np.array(piece.at_mm) / 1000
    create = o3d.geometry.TriangleMesh
    if piece.shape == "box":
        return _placed(create.create_box(*size), at - size / 2)
    sides, radius = (CYLINDER_SIDES, size[0] / 2) if piece.shape == "cylinder" else (6, size[0] / np.sqrt(3))
    return _placed(create.create_cylinder(radius, size[2], resolution=sides, split=1), at)


def _table(wall_m: float) -> Mesh:
    half = TABLE_M / 2
    corners = np.array([[-half, -half, -wall_m], [half, -half, -wall_m], [half, half, -wall_m], [-half, half, -wall_m]])
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint32))


def _placed(mesh: o3d.geometry.TriangleMesh, at: Float[np.ndarray, "3"]) -> Mesh:
    return Mesh(np.asarray(mesh.vertices) + at, np.asarray(mesh.triangles).astype(np.uint32))


def _joined(meshes: list[Mesh]) -> Mesh:
    offsets = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    triangles = [m.triangles + np.uint32(o) for m, o in zip(meshes, offsets, strict=False)]
    return Mesh(np.vstack([m.vertices for m in meshes]), np.vstack(triangles).astype(np.uint32))
