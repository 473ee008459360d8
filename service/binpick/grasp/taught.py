"""Grasps taught in the part's frame, offered to every part whose pose is known, and to every way it looks alike."""

from collections.abc import Sequence

import numpy as np

from binpick import geometry
from binpick.data import Grasp, PartPose, Segments
from binpick.geometry import Transform
from binpick.grasp import clearance, fingers, shape
from binpick.grasp.clearance import Obstacles
from binpick.grasp.shape import Shape
from binpick.settings import Tool, TwoFingerTool
from binpick.settings.mesh import Mesh, TaughtGrasp

SIGMA_XY_M, SIGMA_Z_M, SIGMA_TILT_RAD = 0.00045, 0.00025, 0.022
"""How far poses are off: 68 % of 668 on the exam's tuning seeds, along one axis; the angle is that of flat parts."""


def candidates(parts: Sequence[PartPose], mesh: Mesh, tools: Sequence[Tool], segments: Segments, scene: Obstacles,
               ) -> tuple[list[Grasp], dict[str, int]]:
    """Every taught grasp on every posed part that the tool may come to from above; qualities are 0 until ranked.

    Two fingers leave parts under others alone, as they do without a mesh.
    """
    motions = alike(shape.load(mesh))
    under = clearance.covered(segments, scene)
    by_number = {tool.number: tool for tool in tools}
    grasps: list[Grasp] = []
    counts = {"taught": 0, "tilt": 0, "covered": 0}
    for part, grasp in ((part, grasp) for part in parts for grasp in mesh.grasps):
        if part.T_bin_part is None or grasp.tool not in by_number:
            continue
        tool, label = by_number[grasp.tool], part.part_ids[0]
        poses = [part.T_bin_part @ T @ grasp.T_part_tcp.T_parent_this for T in motions]
        upright = [T for T in poses if np.arccos(np.clip(-T[2, 2], -1, 1)) <= tool.max_tilt_rad]
        counts["tilt"] += len(poses) - len(upright)
        if isinstance(tool, TwoFingerTool) and under[label] > fingers.MAX_COVERED:
            counts["covered"] += len(upright)
            continue
        grasps += [_grasp(T, grasp, label) for T in upright]
    counts["taught"] = len(grasps)
    return grasps, counts


def alike(model: Shape) -> list[Transform]:
    """The motions in the mesh's frame that leave the part as it was, identity first."""
    there, back = geometry.translation(*model.centre), geometry.translation(*-model.centre)
    return [there @ geometry.make(turn, np.zeros(3)) @ back for turn in model.symmetry.sampled]


def _grasp(T_bin_tcp: Transform, grasp: TaughtGrasp, label: int) -> Grasp:
    return Grasp(T_bin_tcp=T_bin_tcp, tool=grasp.tool, part_id=label, open_m=grasp.open_m, close_m=grasp.close_m, quality=0.0,
                 seal_m=0.0, room=1.0, sigma_xy_m=SIGMA_XY_M, sigma_z_m=SIGMA_Z_M, sigma_tilt_rad=SIGMA_TILT_RAD)
