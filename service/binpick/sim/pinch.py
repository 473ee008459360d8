"""What two fingers meet when they close in the true world, by rays from the pads' planes towards each other."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from binpick import geometry
from binpick.geometry import Transform
from binpick.settings import Fingers
from binpick.sim.mesh import Caster, Hits

MAX_ANGLE_RAD = np.radians(25.0)
"""Between a contact's normal and the closing axis: what friction of 0.47 holds."""
PITCH_M = 0.001
SAME_M = 0.0003
"""What lies this near behind the first contact is touched with it."""


@dataclass(frozen=True, slots=True)
class Pinch:
    """What both pads touch: the part (0: none, or two), the pads' places along the closing axis, the larger contact angle."""

    part_id: int
    reason: str
    low_m: float
    high_m: float
    angle_rad: float = float("nan")


@dataclass(frozen=True, slots=True)
class _Touch:
    """One finger's first contact: `way_m` from its open place; on the pad or above it."""

    part_id: int
    way_m: float
    angle_rad: float
    on_pad: bool


def close(caster: Caster, T_bin_tcp: Transform, fingers: Fingers, open_m: float) -> Pinch:
    """Both fingers close from `open_m` until each touches something; they do not push."""
    low, high = (_touch(caster, T_bin_tcp, fingers, open_m, side) for side in (-1, 1))
    ends = (low.way_m - open_m / 2, open_m / 2 - high.way_m)
    if not 0 < open_m <= fingers.stroke_max_m + 1e-9:
        return Pinch(0, "the fingers cannot open so far", -open_m / 2, open_m / 2)
    if max(low.way_m, high.way_m) >= open_m:
        return Pinch(0, "there is nothing between the fingers", -open_m / 2, open_m / 2)
    if low.part_id != high.part_id or low.part_id <= 0:
        return Pinch(0, "the fingers do not meet on one part", *ends)
    angle = max(low.angle_rad, high.angle_rad)
    reason = ""
    if not (low.on_pad and high.on_pad):
        reason = "the part touches a finger above its pad"
    elif ends[1] - ends[0] < fingers.stroke_min_m:
        reason = "the fingers cannot close so far"
    elif angle > MAX_ANGLE_RAD:
        reason = "the part slips out of the fingers"
    return Pinch(low.part_id, reason, *ends, angle)


def _touch(caster: Caster, T_bin_tcp: Transform, fingers: Fingers, open_m: float, side: int) -> _Touch:
    rays, z = _rays(T_bin_tcp, fingers, side * open_m / 2)
    hits = caster.cast(rays)
    way = float(hits.distance.min())
    first = np.flatnonzero(hits.distance <= way + SAME_M)
    if not np.isfinite(way):
        return _Touch(0, open_m, float("nan"), on_pad=False)
    part = int(hits.part_id[hits.distance.argmin()])
    first = first[hits.part_id[first] == part]
    return _Touch(part, way, _angle(hits.take(first), T_bin_tcp), on_pad=bool((z[first] >= -fingers.pad_depth_m).any()))


def _rays(T_bin_tcp: Transform, fingers: Fingers, x_m: float) -> tuple[Float32[np.ndarray, "n 6"], Float[np.ndarray, "n"]]:
    """Rays all over one finger's inner face towards the other, frame bin, and their z in the TCP's frame."""
    half, length = fingers.pad_width_m / 2, fingers.length_m
    y, z = (grid.ravel() for grid in np.meshgrid(np.linspace(-half, half, 1 + int(np.ceil(2 * half / PITCH_M))),
                                                 np.linspace(-length, 0, 1 + int(np.ceil(length / PITCH_M)))))
    starts = geometry.transform(T_bin_tcp, np.column_stack([np.full(len(y), x_m), y, z]))
    towards = -np.sign(x_m) * T_bin_tcp[:3, 0]
    return np.column_stack([starts, np.tile(towards, (len(y), 1))]).astype(np.float32), z


def _angle(hits: Hits, T_bin_tcp: Transform) -> float:
    """Between the closing axis and the mean normal of what is touched at once."""
    normal = hits.normal.astype(float).mean(axis=0)
    return float(np.arccos(min(1.0, abs(normal @ T_bin_tcp[:3, 0]) / max(float(np.linalg.norm(normal)), 1e-9))))
