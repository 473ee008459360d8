"""What the tool would hit: its bodies, swept along the approach, against everything measured and everything unseen.

The scene is the watertight height map as a solid: what is not seen is occupied, and so is all that lies below a seen surface
or outside the bin below its rim. Over such a solid a straight lift never collides when the grasp itself is free, so
only the approach is swept. Fingers come open and are boxes like the others; closed they stay within what they swept.
"""

import functools
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from binpick import geometry
from binpick.data import Grasp, HeightMap, Segments
from binpick.geometry import Transform, Vector
from binpick.settings import Bin, Body, Box, Mesh, SuctionTool, Tool
from binpick.settings.base import Placement

PAD_M = 0.08
"""How far beyond the bin the rim's height is kept: as wide as a tool."""
SIDE_STEP_M = 0.004
"""Vertical distance of the points that stand for the sides of the solid."""
SWEEP_STEP_M = 0.015
"""Distance of the tool's checked positions along the approach: less than any body is long in that direction."""
HORIZON_M = 0.020
"""Clearances above this are reported as this."""
BESIDE_M = 0.0045
"""How far beyond a part's outline the next one is looked at: further than depth is missing at a step."""
WALL_M = 0.006
"""Points this near a wall may be the wall."""
ABOVE_M = 0.004
"""What stands this much higher there may lie on the part: four sigma of depth at 1 m."""
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

    @property
    def half_m(self) -> tuple[float, float]:
        """How far the walls are from the bin's middle, along x and y, to a cell."""
        rows, cols = self.height.shape
        x, y = (side * self.cell_m / 2 - round(PAD_M / self.cell_m) * self.cell_m for side in (cols, rows))
        return x, y

    def within(self, points: Float32[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        """Which points lie inside the bin's walls, and not on them; NaN does not."""
        border = round(PAD_M / self.cell_m) * self.cell_m + WALL_M
        rows, cols = self.height.shape
        x, y = points[:, 0] - self.origin_x_m, points[:, 1] - self.origin_y_m
        inside: Bool[np.ndarray, "n"] = (np.minimum(x, cols * self.cell_m - x) > border) & (
            np.minimum(y, rows * self.cell_m - y) > border)
        return inside


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
    T_tcp_bin = geometry.inverse(grasp.T_bin_tcp)
    back = -tool.approach_m * grasp.T_bin_tcp[:3, 2]
    nearest = HORIZON_M
    for body in _bodies(tool, grasp.open_m):
        corners = geometry.transform(grasp.T_bin_tcp, _placed(body)[1])
        low, high = (np.minimum(0, back) + corners.min(axis=0), np.maximum(0, back) + corners.max(axis=0))
        local = geometry.transform(T_tcp_bin, _beneath(low - HORIZON_M, high + HORIZON_M, scene))
        if isinstance(tool, SuctionTool):
            radial = np.hypot(local[:, 0], local[:, 1])
            local = local[~((local[:, 2] > -CONTACT_M) & (radial < _foot_radius_m(tool) + HORIZON_M / 4))]
        nearest = min(nearest, _distance(local, body, tool.approach_m))
    return nearest


def _bodies(tool: Tool, open_m: float) -> tuple[Body, ...]:
    """All of the tool; fingers stand `open_m` apart."""
    if isinstance(tool, SuctionTool):
        return tool.bodies
    f = tool.fingers
    x = (open_m + f.thickness_m) / 2
    return tool.bodies + tuple(
        Box(shape="box", size_m=(f.thickness_m, f.pad_width_m, f.length_m),
            T_tcp_body=Placement(position_m=(side * x, 0.0, -f.length_m / 2))) for side in (-1, 1))


def _beneath(low_m: Vector, high_m: Vector, scene: Obstacles) -> Float64[np.ndarray, "n 3"]:
    """The solid's surface as points, tops and sides, in a box along the bin's axes; above the box' top it goes on."""
    origin = np.array([scene.origin_x_m, scene.origin_y_m])
    size = np.array(scene.height.shape[::-1])
    low = np.clip(np.floor((low_m[:2] - origin) / scene.cell_m), 0, size - 1).astype(int)
    high = np.clip(np.ceil((high_m[:2] - origin) / scene.cell_m), 1, size).astype(int)
    cells = slice(low[1], high[1]), slice(low[0], high[0])
    x = origin[0] + (np.arange(low[0], high[0]) + 0.5) * scene.cell_m
    y = origin[1] + (np.arange(low[1], high[1]) + 0.5) * scene.cell_m
    height = scene.height[cells]
    rises = np.flatnonzero(height > low_m[2])
    row, col = np.divmod(rises, len(x))
    tops = np.stack([x[col], y[row], height.ravel()[rises]], axis=1)
    count = np.floor(np.minimum(scene.side[cells].ravel()[rises], tops[:, 2] - low_m[2]) / SIDE_STEP_M).astype(int)
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
    corners = _placed(body)[1]
    return float(np.hypot(corners[:, 0], corners[:, 1]).max()), float(corners[:, 2].min()), float(corners[:, 2].max())


@functools.lru_cache(maxsize=64)
def _placed(body: Body) -> tuple[Transform, Float64[np.ndarray, "n 3"]]:
    """T_tcp_body, and the body's corners in the TCP's frame."""
    T_tcp_body = body.T_tcp_body.T_parent_this
    return T_tcp_body, geometry.transform(T_tcp_body, _corners(body))


def _corners(body: Body) -> Float64[np.ndarray, "n 3"]:
    if isinstance(body, Box):
        half = np.array(body.size_m) / 2
        return geometry.box_corners(-half, half)
    if isinstance(body, Mesh):
        return body.corners_m
    angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    ring = body.radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    half_length = body.length_m / 2
    return np.concatenate([np.column_stack([ring, np.full(16, z)]) for z in (-half_length, half_length)])


def _foot_radius_m(tool: SuctionTool) -> float:
    """Radius of what comes down right above the lip."""
    lips = [float(np.hypot(cup.x_m, cup.y_m)) + cup.radius_m for cup in tool.cups]
    return max(lips + [r for r, _, high in _extents(tool) if high > -0.01])


def _distance(points: Float64[np.ndarray, "n 3"], body: Body, approach_m: float) -> float:
    """Smallest signed distance of the points to a body and to all places that it passes on the approach; inf without points.

    A body whose own z is the TCP's passes through a longer one of its kind; others are looked at in steps.
    """
    if not len(points):
        return float("inf")
    T_tcp_body, _ = _placed(body)
    if isinstance(body, Mesh):
        planes = _swept_planes(body, approach_m)
        x, y, z = np.ascontiguousarray(points.T)
        # side by side, without BLAS: its products may round otherwise with another number of threads
        away = functools.reduce(np.maximum, (x * a + y * b + z * c - h for a, b, c, h in planes.tolist()))
        return float(away.min())
    upright = abs(T_tcp_body[2, 2]) > 1 - 1e-9
    longer_m = approach_m if upright else 0.0
    steps = [approach_m / 2] if upright else np.linspace(0, approach_m, 1 + int(np.ceil(approach_m / SWEEP_STEP_M))).tolist()
    nearest = []
    for step in steps:
        local = np.abs(geometry.transform(geometry.inverse(geometry.translation(0.0, 0.0, -step) @ T_tcp_body), points))
        if isinstance(body, Box):
            half = np.array(body.size_m) / 2
            beyond = [local[:, 0] - half[0], local[:, 1] - half[1], local[:, 2] - half[2] - longer_m / 2]
        else:
            beyond = [np.hypot(local[:, 0], local[:, 1]) - body.radius_m, local[:, 2] - (body.length_m + longer_m) / 2]
        most = functools.reduce(np.maximum, beyond)
        if (inside := float(most.min())) <= 0:
            nearest.append(inside)
            continue
        near = most <= HORIZON_M
        outside = [np.maximum(away[near], 0) for away in beyond]
        nearest.append(float(np.sqrt(sum(away * away for away in outside).min(initial=np.inf))))
    return float(np.min(nearest))


@functools.lru_cache(maxsize=64)
def _swept_planes(body: Mesh, approach_m: float) -> Float64[np.ndarray, "k 4"]:
    """Planes around a mesh' hull and all places that it passes on the approach, in the TCP's frame.

    The largest distance from a plane is exact inside and never more than the true distance outside.
    """
    planes: Float64[np.ndarray, "k 4"] = geometry.hull_planes(_placed(body)[1])
    planes[:, 3] += np.maximum(0, -planes[:, 2] * approach_m)
    return planes


def covered(segments: Segments, scene: Obstacles) -> dict[int, float]:
    """The share of each part's outline, as seen, beside which something stands higher: there it may go on underneath.

    A part under another takes it along, or loses its hold, on the way up; no height map shows that. Walls do not count.
    """
    parts, xyz, cols = segments.parts.ravel(), segments.xyz.reshape(-1, 3), segments.parts.shape[1]
    pixels = np.flatnonzero(parts)
    spacing_m = np.linalg.norm(np.take(xyz, pixels[::8] + 1, axis=0, mode="clip") - xyz[pixels[::8]], axis=1)
    beyond = max(2, round(BESIDE_M / max(float(np.nanmedian(spacing_m)), 1e-4))) if len(pixels) else 2
    border = np.zeros(int(parts.max(initial=0)) + 1, dtype=np.int64)
    under = np.zeros_like(border)
    for step in (1, -1, cols, -cols):
        edge = pixels[np.take(parts, pixels + step, mode="clip") != parts[pixels]]
        there = np.clip(edge + beyond * step, 0, len(parts) - 1)
        higher = (parts[there] != parts[edge]) & (xyz[there, 2] - xyz[edge, 2] > ABOVE_M) & scene.within(xyz[there])
        border += np.bincount(parts[edge], minlength=len(border))
        under += np.bincount(parts[edge[higher]], minlength=len(border))
    return {label: float(under[label] / max(border[label], 1)) for label in segments.part_points}


def blocked(grasps: list[Grasp], tool: Tool, heights: HeightMap) -> Bool[np.ndarray, "n"]:
    """Which grasps plainly collide: some point of the tool's surface lies inside the solid at some step of the approach.

    A cheap sieve for hundreds of candidates before the exact distance of the best; it lets through what it is unsure of.
    """
    if not grasps:
        return np.zeros(0, dtype=bool)
    local = (_shell(tool)[None] + _backs(tool)[:, None]).reshape(-1, 3)
    T_bin_tcp = np.stack([grasp.T_bin_tcp for grasp in grasps])
    x, y, z = np.moveaxis(np.matmul(T_bin_tcp[:, :3, :3], local.T) + T_bin_tcp[:, :3, 3:], 1, 0)
    # nothing stands outside the map: the exact check knows the rim
    framed = np.pad(heights.watertight, 1, constant_values=-np.inf)
    rows, cols = framed.shape
    j = np.clip(np.floor((x - heights.origin_x_m) / heights.cell_m) + 1, 0, cols - 1).astype(np.int32)
    i = np.clip(np.floor((y - heights.origin_y_m) / heights.cell_m) + 1, 0, rows - 1).astype(np.int32)
    hit: Bool[np.ndarray, "n"] = (framed.ravel()[i * cols + j] > z).any(axis=1)
    return hit


@functools.lru_cache(maxsize=16)
def _shell(tool: Tool) -> Float64[np.ndarray, "n 3"]:
    """Corner points of the tool's bodies, cut at several heights, without the foot that touches the part."""
    rings = []
    for body in tool.bodies:
        corners = _corners(body)
        if isinstance(body, Mesh):
            rings.append(_placed(body)[1])
            continue
        low, high = corners[:, 2].min(), corners[:, 2].max()
        for share in np.linspace(0, 1, 1 + int(np.ceil((high - low) / 0.03))):
            ring = corners[corners[:, 2] == high].copy()
            ring[:, 2] = low + share * (high - low)
            rings.append(geometry.transform(body.T_tcp_body.T_parent_this, ring))
    points = np.concatenate(rings)
    shell: Float64[np.ndarray, "n 3"] = points[points[:, 2] < -0.006]
    return shell
