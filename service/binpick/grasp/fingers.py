"""Two-finger grasps: slices of a part as wide as a pad, whose two ends are parallel, seen, and free for a finger beside them.

A slice is cut from a part or a face in a frame of its own: z the approach (along the mean normal, or straight down), x one of
its principal axes. What is measured of it gives the width; the watertight height map says where the fingertips find room.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from binpick import geometry
from binpick.data import Grasp, Segments
from binpick.grasp import slices
from binpick.grasp.clearance import Obstacles
from binpick.grasp.slices import Slices
from binpick.settings import Fingers, TwoFingerTool

GRIPS = (0.75, 0.5, 0.33, 0.22)
"""How far the fingertips reach below the ends of a slice, in pad depths; the deepest free one is taken."""
GAPS_M = (0.008, 0.005, 0.003)
"""Room left on either side of the part on the way in; the widest free one is taken."""
MAX_ANGLE_RAD = np.radians(15.0)
"""Between either end and the closing axis, across and along the approach, and between both ends: friction of 0.47 holds 25°."""
MAX_RESIDUAL_M = 0.0015
"""How far the ends of the strips may leave the straight line through them."""
DOUBTS = {"angle": 0.4, "wedge": 0.3, "uneven": 0.3, "shallow": 0.3, "tight": 0.2}
"""What each doubt may take away of a grasp's quality at most."""
PITCH_M = 0.0025
"""Distance of the points that stand for a fingertip: about a cell of the height map."""
LEVEL_M = 0.012
"""Distance of the fingers' cross-sections that are looked at above their tips."""


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """Where the fingers of each slice find room: grip in pad depths, gap on either side; grip 0 where they find none."""

    grip: Float64[np.ndarray, "n"]
    gap_m: Float64[np.ndarray, "n"]


def candidates(segments: Segments, tool: TwoFingerTool, sigma_z_m: np.ndarray, scene: Obstacles, margin_m: float,
               ) -> tuple[list[Grasp], dict[str, int]]:
    """All grasps whose ends can be held and whose fingertips find room, and how many slices fell out for which reason.

    Qualities are 0 until ranked. The pose's z points into the part, x along the closing direction.
    """
    cut = slices.cut(segments, tool.fingers.pad_width_m, tool.max_tilt_rad)
    reasons = {"slices": len(cut.part)}
    fits = cut.width_m + 2 * GAPS_M[-1] <= tool.fingers.stroke_max_m
    fits &= cut.width_m > tool.fingers.stroke_min_m
    held = np.maximum(_angle(cut), _wedge(cut)) <= MAX_ANGLE_RAD
    held &= cut.residual_m <= MAX_RESIDUAL_M
    reasons |= {"outside_stroke": int((~fits).sum()), "not_parallel": int((fits & ~held).sum())}
    cut = cut.take(np.flatnonzero(fits & held))
    room = _room(cut, tool.fingers, scene, margin_m)
    free = np.flatnonzero(room.grip > 0)
    reasons |= {"no_room": len(cut.part) - len(free), "pinched": len(free)}
    doubt = _doubt(cut, room)
    sigma = float(np.nanmedian(sigma_z_m)) if np.isfinite(sigma_z_m).any() else 0.0
    return [_grasp(i, cut, room, float(doubt[i]), tool, sigma) for i in free.tolist()], reasons


def _angle(cut: Slices) -> Float64[np.ndarray, "n"]:
    """The largest angle of either end to the closing axis: the ends' lines, and the lean of the surface between them."""
    angle: Float64[np.ndarray, "n"] = np.max(np.abs([cut.slope[:, 0], cut.slope[:, 1], cut.lean, cut.chord]), axis=0)
    return angle


def _wedge(cut: Slices) -> Float64[np.ndarray, "n"]:
    angle: Float64[np.ndarray, "n"] = np.abs(cut.slope[:, 0] - cut.slope[:, 1])
    return angle


def _room(cut: Slices, fingers: Fingers, scene: Obstacles, margin_m: float) -> Room:
    """The deepest and then widest place that is free of everything, unseen space included."""
    room = Room(grip=np.zeros(len(cut.part)), gap_m=np.zeros(len(cut.part)))
    for grip in GRIPS:
        for gap in GAPS_M:
            left = np.flatnonzero((room.grip == 0) & (cut.width_m + 2 * gap <= fingers.stroke_max_m))
            free = left[~_hit(cut.take(left), fingers, grip, gap, scene, margin_m, 0.0)]
            room.grip[free], room.gap_m[free] = grip, gap
    for level in np.arange(LEVEL_M, fingers.length_m, LEVEL_M):
        for grip in GRIPS:
            for gap in GAPS_M:
                left = np.flatnonzero((room.grip == grip) & (room.gap_m == gap))
                if len(left):
                    room.grip[left[_hit(cut.take(left), fingers, grip, gap, scene, margin_m, float(level))]] = 0
    return room


def _hit(cut: Slices, fingers: Fingers, grip: float, gap_m: float, scene: Obstacles, margin_m: float, level_m: float,
         ) -> Bool[np.ndarray, "n"]:
    """Whether a cross-section of the open fingers, `level_m` above their tips, is inside the scene."""
    across = fingers.pad_width_m / 2 + margin_m
    beside = _spread(gap_m, gap_m + fingers.thickness_m + margin_m)
    x, y = (grid.ravel() for grid in np.meshgrid(beside, _spread(-across, across)))
    height = margin_m + grip * fingers.pad_depth_m - level_m
    hit = np.zeros(len(cut.part), dtype=bool)
    for side, end in ((-1, cut.low_m), (1, cut.high_m)):
        local = np.stack([end[:, None] + side * x, cut.across_m[:, None] + y,
                          np.broadcast_to((cut.deep_m + height)[:, None], (len(end), len(x)))], axis=-1)
        hit |= _inside(np.matmul(local, cut.R_bin_tcp.transpose(0, 2, 1)), scene).any(axis=1)
    return hit


def _spread(low: float, high: float) -> Float64[np.ndarray, "k"]:
    return np.linspace(low, high, 1 + int(np.ceil((high - low) / PITCH_M)))


def _inside(points: Float64[np.ndarray, "n k 3"], scene: Obstacles) -> Bool[np.ndarray, "n k"]:
    """Which points lie below the scene's surface; beyond the map it goes on as at its border."""
    rows, cols = scene.height.shape
    j = np.clip(((points[..., 0] - scene.origin_x_m) / scene.cell_m).astype(np.int32), 0, cols - 1)
    i = np.clip(((points[..., 1] - scene.origin_y_m) / scene.cell_m).astype(np.int32), 0, rows - 1)
    below: Bool[np.ndarray, "n k"] = scene.height[i, j] > points[..., 2]
    return below


def _doubt(cut: Slices, room: Room) -> Float64[np.ndarray, "n"]:
    """What speaks against each slice, 0 to 1."""
    terms = {
        "angle": _angle(cut) / MAX_ANGLE_RAD, "wedge": _wedge(cut) / MAX_ANGLE_RAD, "uneven": cut.residual_m / MAX_RESIDUAL_M,
        "shallow": 1 - room.grip / GRIPS[0], "tight": 1 - room.gap_m / GAPS_M[0]}
    doubt: Float64[np.ndarray, "n"] = 1 - np.prod([1 - DOUBTS[name] * values for name, values in terms.items()], axis=0)
    return doubt


def _grasp(i: int, cut: Slices, room: Room, doubt: float, tool: TwoFingerTool, sigma_z_m: float) -> Grasp:
    R = cut.R_bin_tcp[i]
    local = np.array([(cut.low_m[i] + cut.high_m[i]) / 2, cut.across_m[i],
                      cut.deep_m[i] + room.grip[i] * tool.fingers.pad_depth_m])
    width = float(cut.width_m[i])
    return Grasp(T_bin_tcp=geometry.make(R, R @ local), tool=tool.number, part_id=int(cut.part[i]), quality=0.0,
                 open_m=width + 2 * float(room.gap_m[i]), close_m=width, seal_m=0.0, room=1.0, doubt=doubt,
                 sigma_xy_m=float(np.hypot(sigma_z_m, cut.residual_m[i]) / 2), sigma_z_m=sigma_z_m,
                 sigma_tilt_rad=float(cut.residual_m[i] / tool.fingers.pad_width_m))
