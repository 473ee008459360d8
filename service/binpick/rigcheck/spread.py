"""The spread of the robot's poses: what cannot be known from them, and which to add."""

from collections.abc import Sequence

import numpy as np

from binpick import geometry
from binpick.geometry import Transform
from binpick.rigcheck import loop

LEAST_RAD = np.radians(6.0)
"""Rms turn between two samples about the second axis. Robot errors of 0.1 mm come out eight times as large at less."""
LEAST_M = 0.02
"""Of a robot that turns about one axis its ways tell how the rig is turned about it: rms across the axis."""
UPRIGHT = np.cos(np.radians(20.0))


def fault(T_base_flange: Sequence[Transform], upright: bool) -> str | None:
    """Why the poses do not tell the hand-eye transform, as a sentence; None when they do.

    `upright`: the robot turns about one axis only, and the height is given.
    """
    if any(not geometry.is_rigid(T, 1e-3) for T in T_base_flange):
        return "a robot pose is not a rigid transform"
    (first, second, _), axes = loop.spread_rad(T_base_flange)
    most, others = _name(axes[0]), " and ".join(name for name in "xyz" if name != _name(axes[0]))
    turned = f"the flange turned by {np.degrees(first):.0f} degrees about its {most} (rms between two samples)"
    if first < LEAST_RAD:
        return (f"the flange hardly turned ({np.degrees(first):.1f} degrees, rms between two samples): add samples turned by "
                "20 to 40 degrees, " + ("about its z" if upright else "about x, y and z of the flange"))
    if upright:
        return _upright_fault(T_base_flange, float(second), f"{turned} and {np.degrees(second):.0f} about others")
    if second < LEAST_RAD:
        return (f"{turned}, but only by {np.degrees(second):.1f} about other axes: add samples tilted by 20 to 40 degrees "
                f"about its {others}; of a robot with four axes, which cannot, give the height z")
    return None


def _upright_fault(T_base_flange: Sequence[Transform], second: float, turned: str) -> str | None:
    if second > LEAST_RAD:
        return f"{turned}: such poses tell the height; leave z out"
    axis = loop.spread_rad([geometry.inverse(T) for T in T_base_flange])[1][0]     # in the base
    if abs(axis[2]) < UPRIGHT:
        return "the flange turns about one axis that does not stand upright in the base: a given height z does not help there"
    ways = np.array([T[:3, 3] for T in T_base_flange])
    across_m = float(np.sqrt(np.var(ways - np.outer(ways @ axis, axis), axis=0).sum()))
    if across_m < LEAST_M:
        return (f"the flange moved sideways by {1000 * across_m:.0f} mm (rms) only: add samples 50 to 200 mm apart in x and y, "
                "which show how the rig is turned about z")
    return None


def _name(axis: np.ndarray) -> str:
    return "xyz"[int(np.argmax(np.abs(axis)))]
