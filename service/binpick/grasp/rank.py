"""The order of grasps: named terms, quantised and stable, so that the same scene gives the same bytes."""

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from binpick.data import Grasp, Segments
from binpick.settings import SuctionTool, Tool

WEIGHTS = {"height": 0.45, "area": 0.20, "upright": 0.20, "centre": 0.15}
"""Shares of what is wanted; they sum to 1. Height frees the parts below."""
DOUBTS = {"seal": 0.6, "room": 0.6}
"""What a doubt may take away at most. Doubts multiply, as the part's confidence does: a high but doubtful spot must not win.
Room around the lip forgives an edge that is measured a pixel off."""
SAME_SPOT_M = 0.010
SAME_TILT_RAD = np.radians(15)
PER_PART = 2
"""At most this many grasps of one part."""


def rank(grasps: list[Grasp], segments: Segments, *tools: Tool) -> list[Grasp]:
    """Best first, with qualities, without near-duplicates, at most two per part; `tools` are those the grasps are for."""
    kept: list[Grasp] = []
    for grasp in ordered(grasps, segments, *tools):
        if adds(grasp, kept):
            kept.append(grasp)
    return kept


def ordered(grasps: list[Grasp], segments: Segments, *tools: Tool) -> list[Grasp]:
    """Best first, with qualities."""
    if not grasps:
        return []
    by_number = {tool.number: tool for tool in tools}
    T_bin_tcp = np.stack([grasp.T_bin_tcp for grasp in grasps])
    centre = {label: segments.part_points[label].mean(axis=0) for label in {grasp.part_id for grasp in grasps}}
    largest = max(len(points) for points in segments.part_points.values())
    top = max(float(T_bin_tcp[:, 2, 3].max()), 1e-3)
    tilts = np.arccos(np.clip(-T_bin_tcp[:, 2, 2], -1, 1)).tolist()
    offsets = np.linalg.norm(T_bin_tcp[:, :3, 3] - [centre[grasp.part_id] for grasp in grasps], axis=1).tolist()
    scored = []
    for grasp, height, tilt, offset in zip(grasps, T_bin_tcp[:, 2, 3].tolist(), tilts, offsets, strict=True):
        tool = by_number[grasp.tool]
        terms = {
            "height": min(max(height / top, 0.0), 1.0),
            "area": float(np.sqrt(len(segments.part_points[grasp.part_id]) / largest)),
            "upright": 1 - tilt / max(tool.max_tilt_rad, 1e-6) if tool.max_tilt_rad else 1.0,
            "centre": max(1 - offset / 0.03, 0.0),
        }
        quality = segments.part_confidence[grasp.part_id] * sum(WEIGHTS[name] * value for name, value in terms.items())
        scored.append(replace(grasp, quality=round(min(max(quality * _hold(grasp, tool), 0.0), 1.0), 3)))
    keys = _keys(scored, T_bin_tcp)
    return [scored[i] for i in sorted(range(len(scored)), key=keys.__getitem__)]


def _hold(grasp: Grasp, tool: Tool) -> float:
    """What the tool's own doubts leave of a quality."""
    if not isinstance(tool, SuctionTool):
        return 1 - grasp.doubt
    doubts = {"seal": min(1.0, grasp.seal_m / tool.compliance_m), "room": 1 - grasp.room}
    return math.prod(1 - DOUBTS[name] * value for name, value in doubts.items())


def _keys(grasps: list[Grasp], T_bin_tcp: Float64[np.ndarray, "n 4 4"]) -> list[tuple[float, ...]]:
    """Quality to 0.001, then height, x, y to 1 mm: noise in the last bits cannot swap two grasps."""
    at, approach = np.round(T_bin_tcp[:, :3, 3], 3).tolist(), np.round(T_bin_tcp[:, :3, 2], 2).tolist()
    return [(-grasp.quality, -z, x, y, *way) for grasp, (x, y, z), way in zip(grasps, at, approach, strict=True)]


def adds(grasp: Grasp, kept: list[Grasp]) -> bool:
    """Whether a grasp is one more way to pick, beside those kept."""
    mine = [other for other in kept if other.part_id == grasp.part_id]
    return len(mine) < PER_PART and not any(_alike(grasp, other) for other in mine)


def _alike(a: Grasp, b: Grasp) -> bool:
    near = np.linalg.norm(a.T_bin_tcp[:3, 3] - b.T_bin_tcp[:3, 3]) < SAME_SPOT_M
    return bool(near and a.T_bin_tcp[:3, 2] @ b.T_bin_tcp[:3, 2] > np.cos(SAME_TILT_RAD))
