"""Two-finger grasps: slices of a part as wide as a pad, whose two ends are parallel, seen, and free for a finger beside them.

A slice is cut from a part or a face in a frame of its own: z the approach (along the mean normal, or straight down), x one of
its principal axes. What is measured of it gives the width; the watertight height map says where the fingertips find room.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from binpick import geometry, threads
from binpick.data import Grasp, Segments
from binpick.grasp import clearance, sigma, slices
from binpick.grasp.clearance import Obstacles
from binpick.grasp.sigma import Sigmas
from binpick.grasp.slices import Slices
from binpick.settings import Fingers, TwoFingerTool

GRIPS = (0.22, 0.33, 0.5, 0.75)
"""How far the fingertips reach below the ends of a slice, in pad depths; the deepest free one is taken."""
GAPS_M = (0.008, 0.005, 0.003)
"""Room left on either side of the part on the way in; the widest free one is taken."""
MAX_ANGLE_RAD = np.radians(15.0)
"""Between either end and the closing axis, across and along the approach, and between both ends: friction of 0.47 holds 25°."""
MAX_RESIDUAL_M = 0.0015
"""How far the ends of the strips may leave the straight line through them."""
MAX_COVERED = 0.05
"""Of a part's outline, beside which others stand higher: of parts with more, every second dragged a neighbour along."""
DOUBTS = {"angle": 0.4, "wedge": 0.3, "uneven": 0.3, "shallow": 0.3, "tight": 0.2, "covered": 0.5}
"""What each doubt may take away of a grasp's quality at most."""
PITCH_M = 0.003
"""Distance of the points that stand for a fingertip: about a cell of the height map."""
LEVEL_M = 0.012
"""Steps of the fingertips on their way down to the ends of a slice."""
PER_AXIS = 3
"""Grasps kept of the slices along one axis of one patch."""


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
    cut = slices.cut(segments, tool.fingers.pad_width_m, tool.max_tilt_rad, scene.half_m)
    reasons = {"slices": len(cut.part)}
    fits = cut.width_m + 2 * GAPS_M[-1] <= tool.fingers.stroke_max_m
    fits &= cut.width_m > tool.fingers.stroke_min_m
    held = np.maximum(_angle(cut), _wedge(cut)) <= MAX_ANGLE_RAD
    held &= cut.residual_m <= MAX_RESIDUAL_M
    reasons |= {"outside_stroke": int((~fits).sum()), "not_parallel": int((fits & ~held).sum())}
    cut = cut.take(np.flatnonzero(fits & held))
    under = clearance.covered(segments, scene)
    covered = np.array([under[part] for part in cut.part.tolist()])
    uncovered = np.flatnonzero(covered <= MAX_COVERED)
    reasons |= {"covered": len(covered) - len(uncovered)}
    cut = cut.take(uncovered)
    room = _room(cut, tool.fingers, scene, margin_m)
    free = np.flatnonzero(room.grip > 0)
    reasons |= {"no_room": len(uncovered) - len(free), "pinched": len(free)}
    doubt = _doubt(cut, room, covered[uncovered])
    best = _best(cut, doubt, free)
    parts = segments.parts.ravel()
    sigma_m = np.bincount(parts, np.where(parts > 0, sigma_z_m.ravel(), 0)) / np.maximum(np.bincount(parts), 1)
    off = sigma.of_fingers(sigma_m[cut.part], _angle(cut))
    return [_grasp(i, cut, room, float(doubt[i]), tool, off) for i in best.tolist()], reasons


def _angle(cut: Slices) -> Float64[np.ndarray, "n"]:
    """The largest angle of either end to the closing axis: the ends' lines, and the lean of the surface between them."""
    angle: Float64[np.ndarray, "n"] = np.max(np.abs([cut.slope[:, 0], cut.slope[:, 1], cut.lean, cut.chord]), axis=0)
    return angle


def _wedge(cut: Slices) -> Float64[np.ndarray, "n"]:
    angle: Float64[np.ndarray, "n"] = np.abs(cut.slope[:, 0] - cut.slope[:, 1])
    return angle


def _room(cut: Slices, fingers: Fingers, scene: Obstacles, margin_m: float) -> Room:
    """The deepest and then widest place that is free of everything, unseen space included.

    Fingers are as wide at their tips as further up: where tips passed with the same gap, the rest of the finger passes too.
    """
    room = Room(grip=np.zeros(len(cut.part)), gap_m=np.zeros(len(cut.part)))
    with threads.pool("room") as pool:
        depths = list(pool.map(partial(_deepest, cut, fingers, scene, margin_m), GAPS_M))
    for gap_m, grip in zip(GAPS_M, depths, strict=True):
        deeper = np.flatnonzero(grip > room.grip)
        room.grip[deeper], room.gap_m[deeper] = grip[deeper], gap_m
    return room


def _deepest(cut: Slices, fingers: Fingers, scene: Obstacles, margin_m: float, gap_m: float) -> Float64[np.ndarray, "n"]:
    """How deep the fingers of each slice come with one gap, in pad depths; 0 where they do not."""
    deepest = np.zeros(len(cut.part))
    way = np.arange(GRIPS[0] * fingers.pad_depth_m - LEVEL_M, -fingers.length_m, -LEVEL_M)[::-1] / fingers.pad_depth_m
    free = np.flatnonzero(cut.width_m + 2 * gap_m <= fingers.stroke_max_m)
    tips = _tips(cut.take(free), fingers, gap_m, margin_m)
    for grip in (*way.tolist(), *GRIPS):
        # deeper, the part would meet the finger above its pad
        on_pad = cut.deep_m[free] + grip * fingers.pad_depth_m - cut.touch_m[free] <= fingers.pad_depth_m
        free, tips = free[on_pad], tips[:, on_pad]
        down = (grip * fingers.pad_depth_m * cut.R_bin_tcp[free, :, 2].T)[..., None].astype(np.float32)
        clear = ~_inside(tips + down, scene)
        free, tips = free[clear], tips[:, clear]
        deepest[free] = np.maximum(deepest[free], grip)
    return deepest


def _tips(cut: Slices, fingers: Fingers, gap_m: float, margin_m: float) -> Float32[np.ndarray, "3 n k"]:
    """Points all over both open fingers' tips, with the margin around them, where they are level with the deeper end."""
    across = fingers.pad_width_m / 2 + margin_m
    outwards = _spread(gap_m, gap_m + fingers.thickness_m + margin_m)
    x, y = (grid.ravel() for grid in np.meshgrid(outwards, _spread(-across, across)))
    ends = np.concatenate([cut.low_m[:, None] - x, cut.high_m[:, None] + x], axis=1)
    beside = cut.across_m[:, None] + np.tile(y, 2)
    deep = (cut.deep_m + margin_m)[:, None]
    R = cut.R_bin_tcp
    return np.stack([R[:, c, :1] * ends + R[:, c, 1:2] * beside + R[:, c, 2:] * deep for c in range(3)]).astype(np.float32)


def _spread(low: float, high: float) -> Float64[np.ndarray, "k"]:
    return np.linspace(low, high, 1 + int(np.ceil((high - low) / PITCH_M)))


def _inside(points: Float32[np.ndarray, "3 n k"], scene: Obstacles) -> Bool[np.ndarray, "n"]:
    """Whether some point of each set lies below the scene's surface; beyond the map that goes on as at its border."""
    rows, cols = scene.height.shape
    j = ((points[0] - scene.origin_x_m) / scene.cell_m).astype(np.int32)
    i = ((points[1] - scene.origin_y_m) / scene.cell_m).astype(np.int32)
    index = np.clip(i, 0, rows - 1) * cols + np.clip(j, 0, cols - 1)
    below: Bool[np.ndarray, "n"] = (scene.height.ravel()[index] > points[2]).any(axis=1)
    return below


def _best(cut: Slices, doubt: Float64[np.ndarray, "n"], free: Int64[np.ndarray, "m"]) -> Int64[np.ndarray, "k"]:
    """The least doubtful slices of each axis, in their own order."""
    order = free[np.lexsort((doubt[free], cut.axis[free]))]
    place = np.arange(len(order)) - np.searchsorted(cut.axis[order], cut.axis[order])
    best: Int64[np.ndarray, "k"] = np.sort(order[place < PER_AXIS])
    return best


def _doubt(cut: Slices, room: Room, covered: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n"]:
    """What speaks against each slice, 0 to 1."""
    terms = {
        "angle": _angle(cut) / MAX_ANGLE_RAD, "wedge": _wedge(cut) / MAX_ANGLE_RAD, "uneven": cut.residual_m / MAX_RESIDUAL_M,
        "shallow": 1 - room.grip / GRIPS[-1], "tight": 1 - room.gap_m / GAPS_M[0],
        "covered": covered / MAX_COVERED}
    doubt: Float64[np.ndarray, "n"] = 1 - np.prod([1 - DOUBTS[name] * values for name, values in terms.items()], axis=0)
    return doubt


def _grasp(i: int, cut: Slices, room: Room, doubt: float, tool: TwoFingerTool, off: Sigmas) -> Grasp:
    R = cut.R_bin_tcp[i]
    local = np.array([(cut.low_m[i] + cut.high_m[i]) / 2, cut.across_m[i],
                      cut.deep_m[i] + room.grip[i] * tool.fingers.pad_depth_m])
    if R[0, 0] < 0:  # the same grip turned by half a turn; always the one whose x points along the bin's
        turn = np.array([-1.0, -1.0, 1.0])
        R, local = R * turn, local * turn
    width = float(cut.width_m[i])
    return Grasp(T_bin_tcp=geometry.make(R, R @ local), tool=tool.number, part_id=int(cut.part[i]), quality=0.0,
                 open_m=width + 2 * float(room.gap_m[i]), close_m=width, seal_m=0.0, room=1.0, doubt=doubt,
                 sigma_xy_m=float(off.xy_m[i]), sigma_z_m=float(off.z_m[i]), sigma_tilt_rad=float(off.tilt_rad[i]))
