"""The bin where the cell file expects it, and what its height map says of it: covered, empty, filled, overfilled."""

from dataclasses import dataclass

import cv2
import numpy as np

from binpick import geometry
from binpick.data import HeightMap, Mask
from binpick.errors import FrameUnavailable
from binpick.geometry import Transform
from binpick.scene import location
from binpick.settings import Bin, PartSize

FLOOR_M = 0.004
"""Nothing lower than this above the floor counts as a part: four sigma of depth at 1 m."""
WALL_M = 0.006
"""Width of the strip along the walls whose heights prove nothing."""
PROOF_COVERAGE = 0.70
"""Share of the floor that must be measured before a bin is called empty."""
FILL_CELL_M = 0.1
"""Fill is told for cells of about this side, at most FILL_CELLS along each side of the bin."""
FILL_CELLS = 10


@dataclass(frozen=True, slots=True)
class FillCell:
    """A rectangle of the bin's floor, its middle and size in the bin's frame; `level` is None where nothing was measured."""

    x_m: float
    y_m: float
    size_m: tuple[float, float]
    level: float | None
    coverage: float


@dataclass(frozen=True, slots=True)
class Filling:
    """How full the bin is; `level` is the mean height over the measured cells as a share of the bin's own.

    `hiding`: somewhere so much in one piece was not measured that a part could lie there.
    """

    level: float
    coverage: float
    occupied: bool
    overfilled: bool
    hiding: bool
    cells: tuple[FillCell, ...]

    @property
    def proved_empty(self) -> bool:
        """Enough was seen, and nothing lies there."""
        return not self.occupied and not self.hiding and self.coverage >= PROOF_COVERAGE


def place(model: Bin, T_base_camera: Transform | None) -> Transform:
    """T_camera_bin as configured: where the bin stands, or is expected.

    Raises FrameUnavailable when it is given in `base` and there is no hand-eye.
    """
    if model.pose.frame == "camera":
        return model.T_parent_bin
    if T_base_camera is None:
        raise FrameUnavailable(f'bin {model.number} is given in frame "base", but the rig has no hand-eye calibration: '
                               'give its pose in frame "camera", or calibrate hand-eye')
    T_camera_bin: Transform = geometry.inverse(T_base_camera) @ model.T_parent_bin
    return T_camera_bin


def search_box(model: Bin, above_rim_m: float) -> tuple[geometry.Vector, geometry.Vector]:
    """The box in the configured bin's frame in which parts are looked for: inside, walls, and the air above the rim.

    A bin that is to be located may stand a little elsewhere, and its box with it.
    """
    length, width, height = model.inner_size_m
    side = np.array([length / 2 + model.wall_m, width / 2 + model.wall_m, 0.0])
    box = np.array([-side[0], -side[1], 0.0]), np.array([side[0], side[1], height + above_rim_m])
    return location.tolerated_box(*box) if model.locate else box


def filling(heights: HeightMap, model: Bin, part: PartSize) -> Filling:
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
        occupied=rises_above(FLOOR_M), overfilled=rises_above(height_m + FLOOR_M),
        hiding=_hiding(~known, round(part.min_size_m / heights.cell_m)), cells=_cells(heights, model))


def _hiding(unseen: Mask, side: int) -> bool:
    """Whether a square of so many cells fits into what was not seen."""
    square = np.ones((max(1, side), max(1, side)), dtype=np.uint8)
    return bool(cv2.erode(unseen.astype(np.uint8), square, borderType=cv2.BORDER_CONSTANT, borderValue=0).any())


def _cells(heights: HeightMap, model: Bin) -> tuple[FillCell, ...]:
    """The fill on a coarse grid, row by row from the corner at −x, −y."""
    length, width, height = model.inner_size_m
    columns, rows = (int(np.clip(round(side / FILL_CELL_M), 1, FILL_CELLS)) for side in (length, width))
    cells = []
    for i, band in enumerate(np.array_split(heights.height, rows, axis=0)):
        for j, cell in enumerate(np.array_split(band, columns, axis=1)):
            known = cell[np.isfinite(cell)]
            cells.append(FillCell(
                x_m=round(((j + 0.5) / columns - 0.5) * length, 6), y_m=round(((i + 0.5) / rows - 0.5) * width, 6),
                size_m=(round(length / columns, 6), round(width / rows, 6)), coverage=float(known.size / cell.size),
                level=float(np.clip(known, 0, None).mean() / height) if known.size else None))
    return tuple(cells)
