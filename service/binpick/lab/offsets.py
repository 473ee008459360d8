"""How many sigmas published grasps are off by the truth: along the approach, across it, and in tilt."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64
from rich.table import Table

from binpick import geometry
from binpick.cycle import CycleResult
from binpick.geometry import Transform, Vector
from binpick.lab import grasps
from binpick.lab.exam import Paper
from binpick.result import GraspMessage
from binpick.settings import Cup, SuctionTool
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
        across = _beside(caster, taken.T_bin_tcp, eye, tool)
    else:
        met = pinch.close(caster, taken.T_bin_tcp, tool.fingers, taken.open_m)
        seen = outcome.segments.part_points[grasp.part_id] if outcome.segments is not None else np.zeros((0, 3), np.float32)
        along, across = _higher(caster, taken.T_bin_tcp, seen, met.part_id), abs(met.low_m + met.high_m) / 2
    return abs(along) / grasp.sigma.z_m, across / grasp.sigma.xy_m, verdict.angle_rad / grasp.sigma.tilt_rad


def _beside(caster: Caster, T_bin_tcp: Transform, eye: Vector, tool: SuctionTool) -> float:
    """Distance across the approach from the TCP to where it would lie, had everything been seen as it is.

    Two ways to be off: the surface seen at the TCP truly lies nearer or further along the camera's ray, and the middle of what
    the part truly shows around the lips lies elsewhere.
    """
    at = T_bin_tcp[:3, 3]
    ray = (at - eye) / np.linalg.norm(at - eye)
    seen = caster.cast(np.concatenate([eye, ray])[None].astype(np.float32))
    depth = float(seen.distance[0]) - float(np.linalg.norm(at - eye))
    middles = [_face(caster, T_bin_tcp, cup) for cup in tool.cups]
    aside = np.concatenate(middles).mean(axis=0)
    off = (T_bin_tcp[:3, :3].T @ ray)[:2] * depth + aside
    return float(np.hypot(*off))


def _face(caster: Caster, T_bin_tcp: Transform, cup: Cup) -> Float64[np.ndarray, "n 2"]:
    """Where around a cup, counted from its middle, the face goes on that its middle stands on."""
    reach = SKIRT * cup.radius_m
    side = reach * np.linspace(-1, 1, ACROSS)
    around = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    # a hair more, so that rounding leaves the disc symmetric
    around = around[np.hypot(*around.T) <= reach * (1 + 1e-9)]
    lip = around + np.array([cup.x_m, cup.y_m])
    starts = geometry.transform(T_bin_tcp, np.column_stack([lip, np.full(len(lip), -START_M)]))
    hits = caster.cast(np.column_stack([starts, np.tile(T_bin_tcp[:3, 2], (len(around), 1))]).astype(np.float32))
    middle = int(np.hypot(*around.T).argmin())
    on_face = (hits.part_id == hits.part_id[middle]) & (np.abs(hits.distance - hits.distance[middle]) < FACE_M)
    face: Float64[np.ndarray, "n 2"] = around[on_face]
    return face


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
