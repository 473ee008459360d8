"""The wrist: the ways to turn a tool about its approach that grip the same, as far as the robot can turn."""

import functools
from dataclasses import replace

import numpy as np

from binpick import geometry
from binpick.data import Grasp
from binpick.geometry import Transform
from binpick.settings import Body, Cylinder, Mesh, Tool


def equivalents(grasp: Grasp, tool: Tool) -> list[Grasp]:
    """The grasp as it is, then turned further and further, within the wrist's limits; none where all of them are outside.

    Of turns after which every body of the tool stands where it stood, the first is enough.
    """
    found, stances = [], set()
    for T_turn, stance in _turns(tool):
        T_bin_tcp = grasp.T_bin_tcp if T_turn is None else grasp.T_bin_tcp @ T_turn
        if stance not in stances and _within(T_bin_tcp, tool.wrist.limits_rad):
            stances.add(stance)
            found.append(grasp if T_turn is None else replace(grasp, T_bin_tcp=T_bin_tcp))
    return found


def limited(tool: Tool) -> bool:
    """Whether there are headings to which the robot cannot turn the tool."""
    low, high = tool.wrist.limits_rad
    return high - low < 2 * np.pi


def _within(T_bin_tcp: Transform, limits_rad: tuple[float, float]) -> bool:
    low, high = limits_rad
    heading = float(np.arctan2(T_bin_tcp[1, 0], T_bin_tcp[0, 0]))
    # an angle is within when it is, once wrapped to the first turn above the lower limit
    return low + (heading - low) % (2 * np.pi) <= high + 1e-9


@functools.lru_cache(maxsize=16)
def _turns(tool: Tool) -> tuple[tuple[Transform | None, int], ...]:
    """The turns of a symmetric tool, smallest first (None: as it is), each with a number that equal stances share."""
    count = tool.wrist.symmetry
    steps = sorted(range(count), key=lambda step: (min(step, count - step), step))
    seen: dict[object, int] = {}
    turns = [2 * np.pi * step / count for step in steps]
    return tuple((_about_z(turn) if turn else None, seen.setdefault(_stance(tool, turn), len(seen))) for turn in turns)


def _stance(tool: Tool, turn: float) -> object:
    return tuple(_standing(body, _about_z(turn) @ body.T_tcp_body.T_parent_this) for body in tool.bodies)


def _standing(body: Body, T: Transform) -> object:
    """Where a body stands to a micrometre: equal for a cylinder turned about its own axis, and a box by half a turn."""
    if isinstance(body, Cylinder):
        points = np.stack([T[:3, 3] + side * body.length_m / 2 * T[:3, 2] for side in (-1, 1)])
    elif isinstance(body, Mesh):
        points = geometry.transform(T, body.corners_m)
    else:
        half = np.array(body.size_m) / 2
        points = geometry.transform(T, geometry.box_corners(-half, half))
    return frozenset(map(tuple, (np.round(points, 6) + 0.0).tolist()))


def _about_z(angle: float) -> Transform:
    c, s = np.cos(angle), np.sin(angle)
    return geometry.make(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
