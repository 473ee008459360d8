"""The last gate: looks at each pose as it will leave the house, and trusts nothing that was computed before."""

import numpy as np

from binpick import geometry
from binpick.data import Grasp
from binpick.geometry import Transform
from binpick.result import GraspMessage
from binpick.settings import Bin, Limits, Tool

UNIT = 1e-6
"""A quaternion's length may differ from 1 by this: what is left of float64 after a round trip through the wire."""
OUTSIDE_M = 0.01
"""A TCP may lie this far outside the bin's box: calibration and bin pose are not exact."""
TILT_RAD = 0.02
"""Tilt may exceed the tool's limit by this: rounding, and the bin's own tilt in the base frame."""
SAME = 1e-6
"""The pre-grasp is where the grasp says it is to this, in metres and in a rotation's entries."""


def malformed(grasp: Grasp) -> str:
    """Why a candidate cannot be written as a pose at all, or "": a quaternion would hide a rotation that is none."""
    numbers = np.array([grasp.quality, grasp.open_m, grasp.close_m, grasp.clearance_m, grasp.sigma_xy_m, grasp.sigma_z_m,
                        grasp.sigma_tilt_rad])
    if not (np.isfinite(numbers).all() and np.isfinite(grasp.T_bin_tcp).all()):
        return "not_finite"
    return "" if geometry.is_rigid(grasp.T_bin_tcp) else "quaternion"


def objection(grasp: GraspMessage, T_bin_frame: Transform, T_reach_frame: Transform, model: Bin, tool: Tool,
              limits: Limits) -> str:
    """Why a pose must not leave, or "".

    `T_bin_frame` and `T_reach_frame` map the grasp's frame to the bin's and to the reach box's. The pre-grasp is sent too, so
    it must lie straight behind the pose and within reach.
    """
    before = grasp.T_frame_pregrasp
    numbers = np.array([*grasp.position_m, *grasp.quaternion_xyzw, *before.position_m, *before.quaternion_xyzw,
                        grasp.approach_m, grasp.lift_m, grasp.quality])
    if not np.isfinite(numbers).all():
        return "not_finite"
    if any(abs(np.linalg.norm(turn) - 1) > UNIT for turn in (grasp.quaternion_xyzw, before.quaternion_xyzw)):
        return "quaternion"
    T_frame_tcp = geometry.from_quaternion(np.array(grasp.position_m), np.array(grasp.quaternion_xyzw))
    T_frame_pregrasp = geometry.from_quaternion(np.array(before.position_m), np.array(before.quaternion_xyzw))
    if not np.allclose(T_frame_pregrasp, T_frame_tcp @ geometry.translation(0.0, 0.0, -grasp.approach_m), rtol=0, atol=SAME):
        return "pregrasp"
    T_bin_tcp = T_bin_frame @ T_frame_tcp
    reach = np.stack([(T_reach_frame @ T)[:3, 3] for T in (T_frame_tcp, T_frame_pregrasp)])
    length, width, height = model.inner_size_m
    low = np.array([-length / 2, -width / 2, 0]) - OUTSIDE_M
    high = np.array([length / 2, width / 2, height + limits.above_rim_m]) + OUTSIDE_M
    if (T_bin_tcp[:3, 3] < low).any() or (T_bin_tcp[:3, 3] > high).any():
        return "outside_bin"
    if (reach < limits.reach.min_m).any() or (reach > limits.reach.max_m).any():
        return "out_of_reach"
    aslant = limits.tilt.angle(T_bin_tcp[:3, 2]) > limits.tilt.max_rad + TILT_RAD
    if aslant or np.arccos(np.clip(-T_bin_tcp[2, 2], -1, 1)) > tool.max_tilt_rad + TILT_RAD:
        return "tilt"
    return ""
