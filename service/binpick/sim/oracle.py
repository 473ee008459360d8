"""The oracle: which parts some grasp of a tool could take, tried on the true surfaces; it knows nothing of perception."""

import functools
import itertools
from collections.abc import Iterator, Sequence

import numpy as np
import open3d as o3d
from jaxtyping import Float

from binpick import geometry
from binpick.geometry import Transform
from binpick.settings import SuctionTool, Tool, TwoFingerTool
from binpick.sim import pinch, score
from binpick.sim.collision import Grip, Surroundings
from binpick.sim.mesh import Caster, part_mesh
from binpick.sim.world import ScenePart, WorldScene

PITCH_M = 0.006
"""Distance of the places on a part's surface where a finger is tried."""
BEYOND_M = 0.2
"""Rays to a part's far side start this far out: further than any part is long."""
PLACES = 250
"""About so many of them are kept."""
ONCE = np.array([1.0, 0.03, 0.001])
"""Of two opposite sides the one that looks this way is named first."""
DEPTHS_M = (0.004, 0.008, 0.014)
"""So far the fingertips reach beyond the place that they touch."""
GAPS_M = (0.003, 0.008)
"""Room left on either side of the part on the way in."""
TURNS_RAD = tuple(np.radians((0.0, -20.0, 20.0)))
"""The approach as steep as the closing axis lets it be, and turned about that axis."""
LEVELLED_RAD = np.radians(20.0)
"""A closing axis this far aslant is also tried level: friction holds a little more."""
ASKED, TRIES = 600, 60
"""Of each part so many poses are tried, and so many of those that would hold for collisions."""

Touches = Float[np.ndarray, "n 3"]


def pickable(scene: WorldScene, tools: Sequence[Tool]) -> frozenset[int]:
    """The parts that some grasp of one of these tools could take from the world as it lies. Takes some seconds."""
    found: frozenset[int] = frozenset()
    for tool in tools:
        found |= score.pickable(scene, tool) if isinstance(tool, SuctionTool) else _by_fingers(scene, tool)
    return found


def _by_fingers(scene: WorldScene, tool: TwoFingerTool) -> frozenset[int]:
    """The parts that two fingers could take: antipodal places of each, at several depths, openings and tilts."""
    caster, around = Caster(scene), Surroundings(scene)
    return frozenset(part.part_id for part in scene.parts if _can_be_pinched(part, caster, around, tool))


def _can_be_pinched(part: ScenePart, caster: Caster, around: Surroundings, tool: TwoFingerTool) -> bool:
    tries = 0
    for T_bin_tcp, open_m in itertools.islice(_candidates(part, tool), ASKED):
        met = pinch.close(caster, T_bin_tcp, tool.fingers, open_m)
        if met.reason or met.part_id != part.part_id:
            continue
        grip = Grip(open_m, met.low_m, met.high_m, met.part_id)
        if around.penetration(T_bin_tcp, tool, grip) <= score.MAX_PENETRATION_M:
            return True
        tries += 1
        if tries == TRIES:
            break
    return False


def _candidates(part: ScenePart, tool: TwoFingerTool) -> Iterator[tuple[Transform, float]]:
    """Poses of the TCP and openings, in no particular order, always the same."""
    near, far = (geometry.transform(part.T_bin_part, side) for side in _sides(part.kind))
    ways = list(itertools.product(range(len(near)), TURNS_RAD, DEPTHS_M, GAPS_M))
    for i in np.random.default_rng(0).permutation(len(ways)).tolist():
        place, turn_rad, depth_m, gap_m = ways[i]
        a, b = near[place], far[place]
        open_m = float(np.linalg.norm(b - a)) + 2 * gap_m
        for axis in _axes(a, b, tool.max_tilt_rad) if open_m <= tool.fingers.stroke_max_m else ():
            T_bin_tcp = _pose((a + b) / 2, axis, turn_rad, depth_m)
            if T_bin_tcp[2, 2] <= -np.cos(tool.max_tilt_rad):
                yield T_bin_tcp, open_m


def _axes(a: geometry.Vector, b: geometry.Vector, max_tilt_rad: float) -> list[geometry.Vector]:
    """Closing axes through two places: from one to the other if the tool can tilt so far, and level."""
    axis = (b - a) / np.linalg.norm(b - a)
    slant = abs(float(np.arcsin(np.clip(axis[2], -1, 1))))
    found = [axis] if slant <= max_tilt_rad else []
    if 1e-3 < slant <= LEVELLED_RAD:
        level = axis * [1.0, 1.0, 0.0]
        found.append(level / np.linalg.norm(level))
    return found


def _pose(middle: geometry.Vector, axis: geometry.Vector, turn_rad: float, depth_m: float) -> Transform:
    """The TCP with x along the axis, z as far down as that lets it, turned about x, and beyond the middle by the depth."""
    down = np.array([0.0, 0.0, -1.0])
    steep = down - (down @ axis) * axis
    steep /= np.linalg.norm(steep)
    z = np.cos(turn_rad) * steep + np.sin(turn_rad) * np.cross(axis, steep)
    return geometry.frame_of_axes(z, axis, middle + depth_m * z)


@functools.cache
def _sides(kind: str) -> tuple[Touches, Touches]:
    """Places on a part's outside, and those straight through it: the part's frame, each pair once."""
    mesh = part_mesh(kind)
    corners = mesh.vertices[mesh.triangles.astype(np.int64)]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    starts = [(place, n) for triangle, n in zip(corners, normal, strict=True) for place in _places(triangle)]
    at, out = (np.array(values) for values in zip(*starts, strict=True))
    alone = o3d.t.geometry.RaycastingScene()
    tensor = o3d.core.Tensor.from_numpy
    alone.add_triangles(tensor(mesh.vertices.astype(np.float32)), tensor(np.ascontiguousarray(mesh.triangles)))
    rays = [np.hstack([at + BEYOND_M * side * out, -side * out]).astype(np.float32) for side in (1, -1)]
    distance = [alone.cast_rays(tensor(some))["t_hit"].numpy() for some in rays]
    outside = np.abs(distance[0] - BEYOND_M) < 1e-4
    first = np.flatnonzero(outside & (out @ ONCE > 0))
    some = first[::max(1, len(first) // PLACES)]
    return at[some], (at - (BEYOND_M - distance[1])[:, None] * out)[some]


def _places(triangle: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "n 3"]:
    """Places all over a triangle, its corners and edges not among them."""
    longest = max(float(np.linalg.norm(triangle[i] - triangle[i - 1])) for i in range(3))
    steps = max(1, round(longest / PITCH_M))
    shares = (np.arange(steps) + 1 / 3) / steps
    u, v = (grid.ravel() for grid in np.meshgrid(shares, shares))
    inside = u + v < 1
    u, v = u[inside, None], v[inside, None]
    places: Float[np.ndarray, "n 3"] = triangle[0] + u * (triangle[1] - triangle[0]) + v * (triangle[2] - triangle[0])
    return places
