"""The bin where the cell file says it stands, and what its height map says of it: covered, empty, filled, overfilled."""

from dataclasses import dataclass

import cv2
import numpy as np

from binpick import geometry
from binpick.data import HeightMap
from binpick.errors import FrameUnavailable
from binpick.geometry import Transform
from binpick.settings import Bin

FLOOR_M = 0.004
"""Nothing lower than this above the floor counts as a part: four sigma of depth at 1 m."""
WALL_M = 0.006
"""Width of the strip along the walls whose heights prove nothing."""
PROOF_COVERAGE = 0.70
"""Share of the floor that must be measured before a bin is called empty."""


@dataclass(frozen=True, slots=True)
class Filling:
    """How full the bin is; `level` is the mean height over the measured cells as a share of the bin's own."""

    level: float
    coverage: float
    occupied: bool
    overfilled: bool

    @property
    def proved_empty(self) -> bool:
        """Enough was seen, and nothing lies there."""
        return not self.occupied and self.coverage >= PROOF_COVERAGE


def place(model: Bin, T_base_camera: Transform | None) -> Transform:
    """T_camera_bin of a configured bin. Raises FrameUnavailable when it is given in `base` and there is no hand-eye."""
    if model.pose.frame == "camera":
        return model.T_parent_bin
    if T_base_camera is None:
        raise FrameUnavailable(f'bin {model.number} is given in frame "base", but the rig has no hand-eye calibration: '
                               'give its pose in frame "camera", or calibrate hand-eye')
    T_camera_bin: Transform = geometry.inverse(T_base_camera) @ model.T_parent_bin
    return T_camera_bin


def search_box(model: Bin, above_rim_m: float) -> tuple[geometry.Vector, geometry.Vector]:
    """The box in the bin's frame in which parts are looked for: the inside, walls included, and the air above the rim."""
    length, width, height = model.inner_size_m
    side = np.array([length / 2 + model.wall_m, width / 2 + model.wall_m, 0.0])
    return np.array([-side[0], -side[1], 0.0]), np.array([side[0], side[1], height + above_rim_m])


def filling(heights: HeightMap, model: Bin) -> Filling:
    """How full the bin is.

    Something counts as there, or as above the rim, when its measured cells together make 1 cm². Cells along the walls and
    single cells do not count: that is where a camera sees past the rim and mismatches.
    """
    border = int(np.ceil(WALL_M / heights.cell_m))
    inner = heights.height[border:-border, border:-border]
    height_m = model.inner_size_m[2]
    known = np.isfinite(inner)

    def rises_above(level_m: float) -> bool:
        above = cv2.morphologyEx((known & (inner > level_m)).astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), dtype=np.uint8))
        return int(above.sum()) * heights.cell_m**2 >= 1e-4

    return Filling(
        level=float(np.clip(inner[known], 0, None).mean() / height_m) if known.any() else 0.0, coverage=heights.coverage,
        occupied=rises_above(FLOOR_M), overfilled=rises_above(height_m + FLOOR_M))
