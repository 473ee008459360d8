"""How many sigmas published grasps are off by the truth: along the approach, across it, and in tilt."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float32
from rich.table import Table

from binpick import geometry
from binpick.geometry import Transform, Vector
from binpick.lab import grasps
from binpick.lab.exam import Paper
from binpick.result import CycleResult, GraspMessage
from binpick.settings import SuctionTool
from binpick.sim import pinch
from binpick.sim.mesh import Caster
from binpick.sim.score import Verdict

NAMES = ("z", "xy", "tilt")
START_M = 0.1
"""Rays along the approach start this far before the TCP."""
NEAR_M = 0.003
"""What was measured within this distance of the fingers' axis tells the height of the part between them."""
SKIRT, FACE_M = 1.5, 0.0015
"""A lip is centred on what lies within this many radii, and this little beside its plane."""
ACROSS = 31
"""Rays on a diameter of the skirt."""


def in_sigmas(paper: Paper, outcome: CycleResult, grasp: GraspMessage, verdict: Verdict) -> tuple[float, ...]:
    """The true errors in the order of NAMES, each over the sigma that was published with it; NaN where there is no truth."""
    taken, tool = grasps.taken(grasp), paper.inputs.job.tool_numbered(grasp.tool.number)
    caster = Caster(paper.scene)
    if isinstance(tool, SuctionTool):
        eye = geometry.inverse(paper.inputs.job.bin.T_parent_bin)[:3, 3]
        along = verdict.distance_m
        across = _beside(caster, taken.T_bin_tcp, eye, max(np.hypot(c.x_m, c.y_m) + c.radius_m for c in tool.cups))
    else:
        met = pinch.close(caster, taken.T_bin_tcp, tool.fingers, taken.open_m)
        seen = outcome.segments.part_points[grasp.part_id] if outcome.segments is not None else np.zeros((0, 3), np.float32)
        along, across = _higher(caster, taken.T_bin_tcp, seen, met.part_id), abs(met.low_m + met.high_m) / 2
    return abs(along) / grasp.sigma.z_m, across / grasp.sigma.xy_m, verdict.angle_rad / grasp.sigma.tilt_rad


def _beside(caster: Caster, T_bin_tcp: Transform, eye: Vector, radius_m: float) -> float:
    """Distance across the approach from the lip's middle to where it would lie, had everything been seen as it is.

    Two ways to be off: the surface seen at the TCP truly lies nearer or further along the camera's ray, and the middle of what
    the part truly shows around the lip lies elsewhere.
    """
    at = T_bin_tcp[:3, 3]
    ray = (at - eye) / np.linalg.norm(at - eye)
    seen = caster.cast(np.concatenate([eye, ray])[None].astype(np.float32))
    depth = float(seen.distance[0]) - float(np.linalg.norm(at - eye))
    side = SKIRT * radius_m * np.linspace(-1, 1, ACROSS)
    x, y = (grid.ravel() for grid in np.meshgrid(side, side))
    # a hair more, so that rounding leaves the disc symmetric
    disc = np.hypot(x, y) <= SKIRT * radius_m * (1 + 1e-9)
    x, y = x[disc], y[disc]
    starts = geometry.transform(T_bin_tcp, np.column_stack([x, y, np.full(len(x), -START_M)]))
    hits = caster.cast(np.column_stack([starts, np.tile(T_bin_tcp[:3, 2], (len(x), 1))]).astype(np.float32))
    middle = int(np.hypot(x, y).argmin())
    level = hits.distance - hits.distance[middle]
    face = (hits.part_id == hits.part_id[middle]) & (np.abs(level) < FACE_M)
    off = (T_bin_tcp[:3, :3].T @ ray)[:2] * depth + [x[face].mean(), y[face].mean()]
    return float(np.hypot(*off))


def _higher(caster: Caster, T_bin_tcp: Transform, seen: Float32[np.ndarray, "n 3"], part_id: int) -> float:
    """How much deeper the part between two fingers truly lies than was measured; NaN where it was not, or is another's."""
    local = geometry.transform(geometry.inverse(T_bin_tcp), seen.astype(float))
    near = local[np.hypot(local[:, 0], local[:, 1]) < NEAR_M, 2]
    start = T_bin_tcp[:3, 3] - START_M * T_bin_tcp[:3, 2]
    hit = caster.cast(np.concatenate([start, T_bin_tcp[:3, 2]])[None].astype(np.float32))
    if len(near) < 3 or hit.part_id[0] != part_id:
        return float("nan")
    return float(hit.distance[0]) - START_M - float(np.median(near))


def within(held: Sequence[tuple[float, ...]]) -> dict[str, Any]:
    """Of grasps that hold: per name, how many of its errors are known, and which shares lie within 1 and 2 sigma."""
    told = {}
    for name, values in zip(NAMES, np.array(held, dtype=float).reshape(-1, len(NAMES)).T, strict=True):
        known = values[np.isfinite(values)]
        shares = [round(float((known <= limit).mean()), 3) if known.size else None for limit in (1, 2)]
        told[name] = {"of": known.size, "within_1": shares[0], "within_2": shares[1]}
    return told


def table(tools: dict[str, dict[str, Any]]) -> Table:
    """The shares of a run, per tool and kind; `tools` as `tally.figures` has them."""
    rows = Table("errors within 1σ, 2σ", "parts", *NAMES)
    for tool, kinds in tools.items():
        for mix, each in kinds.items():
            rows.add_row(tool, mix, *(_shares(each["sigmas"][name]) for name in NAMES), end_section=mix == "all")
    return rows


def _shares(told: dict[str, Any]) -> str:
    return f"{told['within_1']:.0%} {told['within_2']:.0%} of {told['of']}" if told["of"] else "-"
