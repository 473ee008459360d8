"""What the tool would hit: its bodies, swept along the approach, against everything measured and everything unseen.

The scene is the watertight height map as a solid: what is not seen is occupied, and so is all that lies below a seen surface
or outside the bin below its rim. Over such a solid a straight lift never collides when the grasp itself is free, so
only the approach is swept.
"""

import functools
from dataclasses import dataclass

import numpy as np
import open3d as o3d
from jaxtyping import Bool, Float32, Float64
from scipy.spatial import cKDTree

from binpick import geometry
from binpick.data import Grasp, HeightMap
from binpick.geometry import Transform
from binpick.settings import Bin, Body, Box, Tool

PAD_M = 0.08
"""How far beyond the bin the rim's height is kept: as wide as a tool."""
SIDE_STEP_M = 0.004
"""Vertical distance of the points that stand for the sides of the solid."""
SWEEP_STEP_M = 0.010
"""Distance of the tool's checked positions along the approach; the bodies are long in that direction."""
HORIZON_M = 0.020
"""Clearances above this are reported as this."""
CONTACT_M = 0.003
"""Points this little above the TCP's plane belong to the surface that is gripped."""


@dataclass(frozen=True, slots=True, eq=False)
class Obstacles:
    """The solid's surface as points in the bin's frame, with a search tree over their x and y."""

    points: Float64[np.ndarray, "n 3"]
    tree: cKDTree


def obstacles(heights: HeightMap, model: Bin) -> Obstacles:
    """Tops and sides of the watertight height map, surrounded by the rim."""
    pad = round(PAD_M / heights.cell_m)
    grid = np.pad(heights.watertight.astype(np.float64), pad, constant_values=model.inner_size_m[2])
    rows, cols = grid.shape
    x = heights.origin_x_m + (np.arange(cols) - pad + 0.5) * heights.cell_m
    y = heights.origin_y_m + (np.arange(rows) - pad + 0.5) * heights.cell_m
    tops = np.stack([*np.meshgrid(x, y), grid], axis=-1)
    framed = np.pad(grid, 1, mode="edge")
    lowest = np.min([framed[1:-1, :-2], framed[1:-1, 2:], framed[:-2, 1:-1], framed[2:, 1:-1]], axis=0)
    count = np.floor(np.maximum(grid - lowest, 0) / SIDE_STEP_M).astype(int)
    owner = np.repeat(np.arange(grid.size), count.ravel())
    below = np.arange(len(owner)) - np.repeat(np.cumsum(count.ravel()) - count.ravel(), count.ravel()) + 1
    sides = tops.reshape(-1, 3)[owner]
    sides[:, 2] -= below * SIDE_STEP_M
    points = np.concatenate([tops.reshape(-1, 3), sides])
    return Obstacles(points=points, tree=cKDTree(points[:, :2]))


def clearance(grasp: Grasp, tool: Tool, scene: Obstacles) -> float:
    """Smallest distance between the tool's bodies and the scene along pre-grasp → grasp, metres; negative: inside.

    Points of the gripped surface under the cup do not count: the cup's compliance takes them. At most HORIZON_M is told.
    """
    T_tcp_bin = geometry.inverse(grasp.T_bin_tcp)
    local = geometry.transform(T_tcp_bin, scene.points[_within(grasp.T_bin_tcp, tool, scene)])
    radial = np.hypot(local[:, 0], local[:, 1])
    touched = (local[:, 2] > -CONTACT_M) & (radial < _foot_radius_m(tool) + HORIZON_M / 4)
    local = local[~touched]
    steps = np.linspace(0, tool.approach_m, 1 + int(np.ceil(tool.approach_m / SWEEP_STEP_M)))
    # the tool standing back by s is the scene standing forward by s
    swept = (local[None] + np.stack([np.zeros_like(steps), np.zeros_like(steps), steps], axis=1)[:, None]).reshape(-1, 3)
    near = swept[_near_bodies(swept, tool)]
    if not len(near):
        return HORIZON_M
    distance = _solid(tool).compute_signed_distance(o3d.core.Tensor.from_numpy(near.astype(np.float32))).numpy()
    return float(min(distance.min(), HORIZON_M))


def _within(T_bin_tcp: Transform, tool: Tool, scene: Obstacles) -> list[int]:
    """Points beneath the swept tool: a circle over its foot and its head."""
    reach = max(_extent(body)[0] for body in tool.bodies) + HORIZON_M
    length = max(-_extent(body)[1] for body in tool.bodies) + tool.approach_m
    foot, back = T_bin_tcp[:2, 3], -T_bin_tcp[:2, 2]
    middle = foot + back * length / 2
    found: list[int] = scene.tree.query_ball_point(middle, reach + float(np.linalg.norm(back)) * length / 2, return_sorted=True)
    return found


def _extent(body: Body) -> tuple[float, float, float]:
    """Largest distance from the TCP's z axis, and lowest and highest z of its corners."""
    corners = geometry.transform(body.T_tcp_body.T_parent_this, _corners(body))
    return float(np.hypot(corners[:, 0], corners[:, 1]).max()), float(corners[:, 2].min()), float(corners[:, 2].max())


def _corners(body: Body) -> Float64[np.ndarray, "n 3"]:
    if isinstance(body, Box):
        half = np.array(body.size_m) / 2
        return geometry.box_corners(-half, half)
    angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    ring = body.radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    half_length = body.length_m / 2
    return np.concatenate([np.column_stack([ring, np.full(16, z)]) for z in (-half_length, half_length)])


def _foot_radius_m(tool: Tool) -> float:
    """Radius of what comes down right above the lip."""
    return max([tool.cups[0].radius_m] + [r for r, _, high in map(_extent, tool.bodies) if high > -0.01])


def _near_bodies(points: Float64[np.ndarray, "n 3"], tool: Tool) -> Bool[np.ndarray, "n"]:
    """Points within HORIZON_M of some body's bounding cylinder about the TCP's axis."""
    radial = np.hypot(points[:, 0], points[:, 1])
    near = np.zeros(len(points), dtype=bool)
    for radius, low, high in map(_extent, tool.bodies):
        near |= (radial < radius + HORIZON_M) & (points[:, 2] > low - HORIZON_M) & (points[:, 2] < high + HORIZON_M)
    return near


@functools.lru_cache(maxsize=16)
def _solid(tool: Tool) -> o3d.t.geometry.RaycastingScene:
    """The tool's bodies as one Open3D scene for signed distances, frame TCP."""
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    for body in tool.bodies:
        if isinstance(body, Box):
            mesh = o3d.geometry.TriangleMesh.create_box(*body.size_m)
            mesh.translate(-np.array(body.size_m) / 2)
        else:
            mesh = o3d.geometry.TriangleMesh.create_cylinder(body.radius_m, body.length_m, 32, 1)
        mesh.transform(body.T_tcp_body.T_parent_this)
        scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    return scene


def blocked(grasps: list[Grasp], tool: Tool, heights: HeightMap) -> Bool[np.ndarray, "n"]:
    """Which grasps plainly collide: some point of the tool's surface lies inside the solid at some step of the approach.

    A cheap sieve for hundreds of candidates before the exact distance of the best; it lets through what it is unsure of.
    """
    if not grasps:
        return np.zeros(0, dtype=bool)
    shell = _shell(tool)
    steps = np.linspace(0, tool.approach_m, 1 + int(np.ceil(tool.approach_m / SWEEP_STEP_M)))
    backs = np.stack([np.zeros_like(steps), np.zeros_like(steps), -steps], axis=1)
    local = (shell[None] + backs[:, None]).reshape(-1, 3)
    hit = np.zeros(len(grasps), dtype=bool)
    for k, grasp in enumerate(grasps):
        p = geometry.transform(grasp.T_bin_tcp, local)
        hit[k] = bool((_height_at(p, heights) > p[:, 2]).any())
    return hit


def _height_at(points: Float64[np.ndarray, "n 3"], heights: HeightMap) -> Float32[np.ndarray, "n"]:
    """The solid's height under each point; nothing outside the map (the exact check knows the rim)."""
    rows, cols = heights.watertight.shape
    j = np.floor((points[:, 0] - heights.origin_x_m) / heights.cell_m).astype(int)
    i = np.floor((points[:, 1] - heights.origin_y_m) / heights.cell_m).astype(int)
    inside = (i >= 0) & (i < rows) & (j >= 0) & (j < cols)
    height = np.full(len(points), -np.inf, dtype=np.float32)
    height[inside] = heights.watertight[i[inside], j[inside]]
    return height


@functools.lru_cache(maxsize=16)
def _shell(tool: Tool) -> Float64[np.ndarray, "n 3"]:
    """Corner points of the tool's bodies, cut at several heights, without the foot that touches the part."""
    rings = []
    for body in tool.bodies:
        corners = _corners(body)
        low, high = corners[:, 2].min(), corners[:, 2].max()
        for share in np.linspace(0, 1, 1 + int(np.ceil((high - low) / 0.03))):
            ring = corners[corners[:, 2] == high].copy()
            ring[:, 2] = low + share * (high - low)
            rings.append(geometry.transform(body.T_tcp_body.T_parent_this, ring))
    points = np.concatenate(rings)
    shell: Float64[np.ndarray, "n 3"] = points[points[:, 2] < -0.006]
    return shell
