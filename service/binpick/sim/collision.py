"""How deep a tool's bodies go into parts and bin along the only motion that is checked: pre-grasp, grasp, lift."""

import functools
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from binpick import geometry
from binpick.geometry import Transform
from binpick.settings import Fingers, Mesh, SuctionTool, Tool
from binpick.sim import exam
from binpick.sim.hull import Hull
from binpick.sim.world import WorldScene

Points = Float[np.ndarray, "n 3"]
Values = Float[np.ndarray, "n"]
# how densely surfaces are sampled, and the motion
PITCH_M, STEP_M = 0.003, 0.005


@dataclass(frozen=True, slots=True)
class Prism:
    """A convex solid along its own z, centred: an outline box, circle or hexagon (flats across y), metres."""

    shape: str
    size_m: tuple[float, float, float]

    def depth(self, points: Points) -> Values:
        """How far each point lies below the surface; negative outside, there not a distance."""
        x, y, z = np.abs(points).T
        a, b, c = (side / 2 for side in self.size_m)
        if self.shape == "box":
            around = np.minimum(a - x, b - y)
        elif self.shape == "cylinder":
            around = a - np.hypot(x, y)
        else:
            around = a - np.maximum(y, np.cos(np.pi / 6) * x + 0.5 * y)
        depth: Values = np.minimum(around, c - z)
        return depth

    def surface(self) -> Points:
        """Points all over the surface, corners and edges included, no further apart than PITCH_M."""
        outline, height = self._outline(), self.size_m[2]
        reach = np.linalg.norm(outline, axis=1).max()
        sides = [np.column_stack([outline, np.full(len(outline), z)]) for z in _spaced(-height / 2, height / 2)]
        caps = [np.column_stack([outline * scale, np.full(len(outline), z)])
                for z in (-height / 2, height / 2) for scale in _spaced(0.0, reach)[:-1] / reach]
        return np.vstack(sides + caps)

    def _outline(self) -> Float[np.ndarray, "n 2"]:
        a, b, _ = (side / 2 for side in self.size_m)
        if self.shape == "box":
            corners = np.array([[a, b], [-a, b], [-a, -b], [a, -b]])
        else:
            sides = 6 if self.shape == "hexagon" else max(12, int(np.ceil(2 * np.pi * a / PITCH_M)))
            radius = a / np.cos(np.pi / 6) if self.shape == "hexagon" else a
            angles = np.arange(sides) * 2 * np.pi / sides
            corners = radius * np.column_stack([np.cos(angles), np.sin(angles)])
        edges = zip(corners, np.roll(corners, -1, axis=0), strict=True)
        return np.vstack([p + (q - p) * (_spaced(0.0, float(np.linalg.norm(q - p)))[:-1] / np.linalg.norm(q - p))[:, None]
                          for p, q in edges])


Solid: TypeAlias = Prism | Hull


@dataclass(frozen=True, slots=True)
class Grip:
    """Two fingers' work: the opening they come with, where along the closing axis the pads then stand, and what they hold."""

    open_m: float
    low_m: float
    high_m: float
    part_id: int


class Surroundings:
    """All that a tool can run into in one frozen scene."""

    def __init__(self, scene: WorldScene) -> None:
        self._scene, self._parts, self._setup = scene, scene.parts, exam.setup(scene.world)
        self._points = _obstacles(scene)
        self._top = float(self._points[:, 2].max())

    def penetration(self, T_bin_tcp: Transform, tool: Tool, grip: Grip | None = None) -> float:
        """The largest depth in metres of any body of the tool inside a part or the bin, on the way in and out; 0 when clear.

        What lies beside the bin below its rim counts as solid: a body there has gone through a wall. Fingers come open and
        leave closed; the part between them then leaves too. Without a grip they stay as wide as they are.
        """
        way_in, way_out = _way_in(T_bin_tcp, tool), _way_out(T_bin_tcp, tool)
        if isinstance(tool, SuctionTool):
            return self.deepest(_bodies(tool), way_in + way_out)
        grip = grip or Grip(tool.fingers.stroke_max_m, -tool.fingers.stroke_max_m / 2, tool.fingers.stroke_max_m / 2, 0)
        coming = self.deepest(_bodies(tool) + _fingers(tool.fingers, -grip.open_m / 2, grip.open_m / 2), way_in)
        left = replace(self._scene, parts=tuple(part for part in self._parts if part.part_id != grip.part_id))
        leaving = _bodies(tool) + _fingers(tool.fingers, grip.low_m, grip.high_m)
        return max(coming, Surroundings(left).deepest(leaving, way_out))

    def deepest(self, bodies: list[tuple[Solid, Transform]], motion: list[Transform]) -> float:
        """The largest depth of these bodies, given in the TCP's frame, at these places of the TCP; 0 when clear."""
        return max([0.0, *(self._of_body(*body, motion) for body in bodies)])

    def _of_body(self, prism: Solid, T_tcp_body: Transform, motion: list[Transform]) -> float:
        poses = [T_bin_tcp @ T_tcp_body for T_bin_tcp in motion]
        # both ways: corners of the body may lie between points of a part, and corners of a part between those of the body
        skin = _skin_of(prism)
        swept = np.vstack([geometry.transform(T, skin) for T in poses])
        low, high = swept.min(axis=0), swept.max(axis=0)
        if low[2] > self._top:
            return 0.0
        swept = swept[swept[:, 2] < self._top]
        depths = [float(_depth_in_bin(swept, self._setup).max())]
        for part in self._parts:
            at, radius = part.T_bin_part[:3, 3], _radius(part.kind)
            if (at + radius < low).any() or (at - radius > high).any():
                continue
            near = swept[np.abs(swept - at).max(axis=1) < radius]
            if len(near):
                depths.append(_depth_in_part(geometry.transform(geometry.inverse(part.T_bin_part), near), part.kind))
        reached = self._points[((self._points >= low) & (self._points <= high)).all(axis=1)]
        if len(reached):
            depths += [float(prism.depth(geometry.transform(geometry.inverse(T), reached)).max()) for T in poses]
        return max(depths)


def _way_in(T_bin_tcp: Transform, tool: Tool) -> list[Transform]:
    return [T_bin_tcp @ geometry.translation(0.0, 0.0, -s) for s in _spaced(0.0, tool.approach_m, STEP_M)]


def _way_out(T_bin_tcp: Transform, tool: Tool) -> list[Transform]:
    return [geometry.translation(0.0, 0.0, s) @ T_bin_tcp for s in _spaced(0.0, tool.lift_m, STEP_M)[1:]]


def _fingers(fingers: Fingers, low_m: float, high_m: float) -> list[tuple[Solid, Transform]]:
    """Both fingers with their pads' faces at these places along the TCP's x."""
    prism = Prism("box", (fingers.thickness_m, fingers.pad_width_m, fingers.length_m))
    return [(prism, geometry.translation(x, 0.0, -fingers.length_m / 2))
            for x in (low_m - fingers.thickness_m / 2, high_m + fingers.thickness_m / 2)]


def _bodies(tool: Tool) -> list[tuple[Solid, Transform]]:
    bodies: list[tuple[Solid, Transform]] = []
    for body in tool.bodies:
        if isinstance(body, Mesh):
            bodies.append((Hull(body.hull_m), body.T_tcp_body.T_parent_this))
            continue
        size = body.size_m if body.shape == "box" else (2 * body.radius_m, 2 * body.radius_m, body.length_m)
        bodies.append((Prism(body.shape, size), body.T_tcp_body.T_parent_this))
    return bodies


@functools.cache
def _pieces(kind: str) -> tuple[tuple[Prism, Transform], ...]:
    return tuple((Prism(p.shape, (p.size_mm[0] / 1000, p.size_mm[1] / 1000, p.size_mm[2] / 1000)),
                  geometry.translation(p.at_mm[0] / 1000, p.at_mm[1] / 1000, p.at_mm[2] / 1000))
                 for p in exam.KINDS[kind].pieces)


@functools.lru_cache(maxsize=64)
def _skin_of(prism: Solid) -> Points:
    return prism.surface()


@functools.cache
def _skin(kind: str) -> Points:
    """Points on a part's surface (a few inside, where pieces overlap)."""
    return np.vstack([geometry.transform(T_part_piece, prism.surface()) for prism, T_part_piece in _pieces(kind)])


@functools.cache
def _radius(kind: str) -> float:
    return float(np.linalg.norm(_skin(kind), axis=1).max())


def _obstacles(scene: WorldScene) -> Points:
    """Points on all parts and along the bin's inner rim, whose edge is finer than the samples of a body."""
    length, width, height = exam.setup(scene.world).bin_size_m
    rim = [[x, y, height] for x in _spaced(-length / 2, length / 2) for y in (-width / 2, width / 2)]
    rim += [[x, y, height] for x in (-length / 2, length / 2) for y in _spaced(-width / 2, width / 2)]
    return np.vstack([np.array(rim), *(geometry.transform(p.T_bin_part, _skin(p.kind)) for p in scene.parts)])


def _depth_in_bin(points: Points, setup: exam.Setup) -> Values:
    length, width, height = setup.bin_size_m
    x, y = np.abs(points[:, 0]), np.abs(points[:, 1])
    beyond = np.maximum(np.maximum(x - length / 2, y - width / 2), -points[:, 2])
    depth: Values = np.maximum(np.minimum(beyond, height - points[:, 2]), 0)
    return depth


def _depth_in_part(points_part: Points, kind: str) -> float:
    return max(float(prism.depth(geometry.transform(geometry.inverse(T_part_piece), points_part)).max())
               for prism, T_part_piece in _pieces(kind))


def _spaced(start: float, end: float, pitch: float = PITCH_M) -> Float[np.ndarray, "n"]:
    """From start to end, both included, evenly, at most `pitch` apart."""
    return np.linspace(start, end, max(2, int(np.ceil((end - start) / pitch)) + 1))
