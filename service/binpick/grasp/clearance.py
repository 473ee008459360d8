"""What the tool would hit: its bodies, swept along the approach, against everything measured and everything unseen.

The scene is the watertight height map as a solid: what is not seen is occupied, and so is all that lies below a seen surface
or outside the bin below its rim. Over such a solid a straight lift never collides when the grasp itself is free, so
only the approach is swept.
"""

import functools
from dataclasses import dataclass

import cv2
import numpy as np
import open3d as o3d
from jaxtyping import Bool, Float32, Float64

from binpick import geometry
from binpick.data import Grasp, HeightMap
from binpick.geometry import Transform
from binpick.settings import Bin, Body, Box, Tool

PAD_M = 0.08
"""How far beyond the bin the rim's height is kept: as wide as a tool."""
SIDE_STEP_M = 0.004
"""Vertical distance of the points that stand for the sides of the solid."""
SWEEP_STEP_M = 0.015
"""Distance of the tool's checked positions along the approach: less than any body is long in that direction."""
HORIZON_M = 0.020
"""Clearances above this are reported as this."""
CONTACT_M = 0.003
"""Points this little above the TCP's plane belong to the surface that is gripped."""


@dataclass(frozen=True, slots=True, eq=False)
class Obstacles:
    """The solid: the watertight height map padded with the rim, and how far each cell stands above its lowest neighbour."""

    height: Float64[np.ndarray, "rows cols"]
    side: Float64[np.ndarray, "rows cols"]
    cell_m: float
    origin_x_m: float
    origin_y_m: float


def obstacles(heights: HeightMap, model: Bin) -> Obstacles:
    """The solid of a height map, surrounded by the rim."""
    pad = round(PAD_M / heights.cell_m)
    grid = np.pad(heights.watertight.astype(np.float64), pad, constant_values=model.inner_size_m[2])
    lowest = cv2.erode(grid, cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3)))
    return Obstacles(height=grid, side=grid - lowest, cell_m=heights.cell_m,
                     origin_x_m=heights.origin_x_m - pad * heights.cell_m,
                     origin_y_m=heights.origin_y_m - pad * heights.cell_m)


def clearance(grasp: Grasp, tool: Tool, scene: Obstacles) -> float:
    """Smallest distance between the tool's bodies and the scene along pre-grasp → grasp, metres; negative: inside.

    Points of the gripped surface under the cup do not count: the cup's compliance takes them. At most HORIZON_M is told.
    """
    local = geometry.transform(geometry.inverse(grasp.T_bin_tcp), _beneath(grasp.T_bin_tcp, tool, scene))
    radial = np.hypot(local[:, 0], local[:, 1])
    touched = (local[:, 2] > -CONTACT_M) & (radial < _foot_radius_m(tool) + HORIZON_M / 4)
    local = local[~touched & _near_bodies(local, tool, tool.approach_m)]
    # the tool standing back by s is the scene standing forward by s
    swept = (local[None] - _backs(tool)[:, None]).reshape(-1, 3)
    near = swept[_near_bodies(swept, tool, 0.0)]
    if not len(near):
        return HORIZON_M
    distance = _solid(tool).compute_signed_distance(o3d.core.Tensor.from_numpy(near.astype(np.float32))).numpy()
    return float(min(distance.min(), HORIZON_M))


def _beneath(T_bin_tcp: Transform, tool: Tool, scene: Obstacles) -> Float64[np.ndarray, "n 3"]:
    """The solid's surface as points, tops and sides, in the rectangle of the bin's plane that the swept tool covers."""
    reach = max(radius for radius, _, _ in _extents(tool)) + HORIZON_M
    back = max(-low for _, low, _ in _extents(tool)) + tool.approach_m
    ends = np.stack([T_bin_tcp[:2, 3], T_bin_tcp[:2, 3] - back * T_bin_tcp[:2, 2]])
    origin = np.array([scene.origin_x_m, scene.origin_y_m])
    size = np.array(scene.height.shape[::-1])
    low = np.clip(np.floor((ends.min(axis=0) - reach - origin) / scene.cell_m), 0, size - 1).astype(int)
    high = np.clip(np.ceil((ends.max(axis=0) + reach - origin) / scene.cell_m), 1, size).astype(int)
    cells = slice(low[1], high[1]), slice(low[0], high[0])
    x = origin[0] + (np.arange(low[0], high[0]) + 0.5) * scene.cell_m
    y = origin[1] + (np.arange(low[1], high[1]) + 0.5) * scene.cell_m
    tops = np.stack([*np.meshgrid(x, y), scene.height[cells]], axis=-1).reshape(-1, 3)
    count = np.floor(scene.side[cells].ravel() / SIDE_STEP_M).astype(int)
    sides = np.repeat(tops, count, axis=0)
    sides[:, 2] -= (np.arange(len(sides)) - np.repeat(np.cumsum(count) - count, count) + 1) * SIDE_STEP_M
    return np.concatenate([tops, sides])


def _backs(tool: Tool) -> Float64[np.ndarray, "s 3"]:
    """Where the TCP stands on its way, in the frame of the grasp: from the grasp back to the pre-grasp."""
    steps = np.linspace(0, tool.approach_m, 1 + int(np.ceil(tool.approach_m / SWEEP_STEP_M)))
    return np.stack([np.zeros_like(steps), np.zeros_like(steps), -steps], axis=1)


@functools.lru_cache(maxsize=16)
def _extents(tool: Tool) -> tuple[tuple[float, float, float], ...]:
    """Of every body its `_extent`."""
    return tuple(_extent(body) for body in tool.bodies)


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
    return max([tool.cups[0].radius_m] + [r for r, _, high in _extents(tool) if high > -0.01])


def _near_bodies(points: Float64[np.ndarray, "n 3"], tool: Tool, sweep_m: float) -> Bool[np.ndarray, "n"]:
    """Points within HORIZON_M of some body's bounding cylinder about the TCP's axis, swept back by `sweep_m`."""
    radial = np.hypot(points[:, 0], points[:, 1])
    near = np.zeros(len(points), dtype=bool)
    for radius, low, high in _extents(tool):
        near |= (radial < radius + HORIZON_M) & (points[:, 2] > low - HORIZON_M - sweep_m) & (points[:, 2] < high + HORIZON_M)
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
    local = (_shell(tool)[None] + _backs(tool)[:, None]).reshape(-1, 3)
    T_bin_tcp = np.stack([grasp.T_bin_tcp for grasp in grasps])
    points = np.matmul(local, T_bin_tcp[:, :3, :3].transpose(0, 2, 1)) + T_bin_tcp[:, None, :3, 3]
    height = _height_at(points.reshape(-1, 3), heights).reshape(points.shape[:2])
    hit: Bool[np.ndarray, "n"] = (height > points[..., 2]).any(axis=1)
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
