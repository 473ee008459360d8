"""Admission: which candidates the recipe's limits let through before anything is asked of their surroundings."""

import numpy as np

from binpick.data import Grasp
from binpick.grasp import wrist
from binpick.settings import Job, Limits


def admitted(found: list[Grasp], job: Job) -> tuple[list[Grasp], dict[str, int]]:
    """Those within the recipe's limits, and how many are not: `uncertain`, `aslant` (the robot's cone), `wrist`."""
    counts = {"uncertain": 0, "aslant": 0, "wrist": 0}
    kept = []
    for grasp in found:
        reason = _objection(grasp, job.recipe.limits)
        tool = job.tool_numbered(grasp.tool)
        if not reason and wrist.limited(tool) and not wrist.equivalents(grasp, tool):
            reason = "wrist"
        if reason:
            counts[reason] += 1
        else:
            kept.append(grasp)
    return kept, counts


def _objection(grasp: Grasp, limits: Limits) -> str:
    most = limits.sigma
    if grasp.sigma_xy_m > most.xy_m or grasp.sigma_z_m > most.z_m or grasp.sigma_tilt_rad > most.tilt_rad:
        return "uncertain"
    # no angle is more than half a turn
    aslant = limits.tilt.max_rad < np.pi and limits.tilt.angle(grasp.T_bin_tcp[:3, 2]) > limits.tilt.max_rad
    return "aslant" if aslant else ""
