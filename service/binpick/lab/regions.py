"""Where a depth map is judged apart: planes, curved surfaces and edges of the parts, told from the truth alone."""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32

from binpick.data import Mask
from binpick.sim import exam
from binpick.sim.truth import Truth

JUMP_PX = 2.0
"""A true disparity step between neighbours above this is a depth edge."""
NEAR_PX = 5.0
"""Pixels this close to a depth edge count as the edge's: matched windows reach across it."""
STEP_PX = 3
BEND_PX = 0.02
"""A plane's disparity is linear in the image: its second difference over ±3 px is below this, the truth's own noise and more; a
Ø24 cylinder's is .06 px in world A."""


@dataclass(frozen=True, slots=True, eq=False)
class Regions:
    """Pixels of parts that both the truth and the judge know; creases between planes are in none of the three.

    `edges` are within 5 px of a depth edge, the others further off.
    """

    parts: Mask
    planes: Mask
    curved: Mask
    edges: Mask


def regions(truth: Truth, kinds: Mapping[int, str]) -> Regions:
    """The regions of a window; `kinds` names every part's kind."""
    parts = (truth.part_id > 0) & np.isfinite(truth.disparity)
    edges = near_jump(truth.disparity)
    bent = _bend(truth.disparity) > BEND_PX
    round_parts = [i for i, kind in kinds.items() if any(p.shape == "cylinder" for p in exam.KINDS[kind].pieces)]
    away = parts & ~edges
    return Regions(parts, away & ~bent, away & bent & np.isin(truth.part_id, round_parts), parts & edges)


def near_jump(disparity: Float32[np.ndarray, "h w"]) -> Mask:
    """Pixels at most NEAR_PX from a depth edge; both sides of a step are the edge."""
    across, down = (np.abs(np.diff(disparity, axis=axis)) > JUMP_PX for axis in (1, 0))
    firm = np.ones(disparity.shape, dtype=np.uint8)
    firm[:, 1:][across], firm[:, :-1][across], firm[1:][down], firm[:-1][down] = 0, 0, 0, 0
    if firm.all():
        return np.zeros(disparity.shape, dtype=bool)
    return np.asarray(cv2.distanceTransform(firm, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) <= NEAR_PX)


def _bend(disparity: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """The largest second difference along rows, columns and both diagonals."""
    s = STEP_PX
    known = cv2.copyMakeBorder(np.nan_to_num(disparity), s, s, s, s, cv2.BORDER_REPLICATE)
    rows, cols = disparity.shape
    bend = np.zeros(disparity.shape, dtype=np.float32)
    for dx, dy in ((s, 0), (0, s), (s, s), (s, -s)):
        one, other = (known[s + k * dy : s + k * dy + rows, s + k * dx : s + k * dx + cols] for k in (1, -1))
        np.maximum(bend, np.abs(one + other - 2 * np.nan_to_num(disparity)), out=bend)
    return bend
