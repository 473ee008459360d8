"""Tags that lie on the table around the bin, printed without gloss: what they do to the table's reflectance."""

import functools
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32

from binpick import geometry
from binpick.geometry import Transform
from binpick.sim import exam
from binpick.sim.projector import sample

FAMILY = "apriltag_36h11"
WHITE, BLACK = np.float32(0.75), np.float32(0.05)
"""Reflectance of paper and of toner."""
QUIET = 0.2
"""White around a tag, as a share of its side."""
CELLS = 20
"""Of the raster, per module; a tag of 36 bits and its border have 8 modules each way."""
MODULES = 8
PLACES = {"A": (0.044, ((-0.43, 0.06), (-0.43, -0.10), (0.432, 0.10), (0.432, -0.10), (-0.10, 0.275), (0.16, 0.275),
                        (-0.10, -0.31), (0.16, -0.31))),
          "B": (0.024, ((-0.11, 0.142), (0.0, 0.142), (0.10, 0.142), (-0.11, -0.142), (0.0, -0.142), (0.10, -0.142)))}
"""Per world the tags' side, and where they lie in the bin's frame, metres: on the table, in both views, beside the bin."""


@dataclass(frozen=True, slots=True, eq=False)
class Mark:
    """A tag: x to its right, y up its picture, z towards the viewer."""

    number: int
    side_m: float
    T_bin_mark: Transform


def layout(world: str) -> tuple[Mark, ...]:
    """The tags of an exam world, each turned a little differently."""
    side_m, places = PLACES[world]
    z = -exam.setup(world).bin_wall_m
    return tuple(Mark(number, side_m, _lying(x, y, z, 0.1 * (number - 3))) for number, (x, y) in enumerate(places))


def _lying(x: float, y: float, z: float, yaw: float) -> Transform:
    return geometry.frame_of_axes(np.array([0.0, 0.0, 1.0]), np.array([np.cos(yaw), np.sin(yaw), 0.0]), np.array([x, y, z]))


def painted(marks: tuple[Mark, ...], points: Float32[np.ndarray, "n 3"], reflectance: Float32[np.ndarray, "n"],
            pixel_m: float) -> Float32[np.ndarray, "n"]:
    """The reflectance of points of the table (frame `bin`) with the tags on it; a pixel sees `pixel_m` of it as one."""
    painted = reflectance.copy()
    for mark in marks:
        half = mark.side_m * (0.5 + QUIET)
        near = np.flatnonzero((np.abs(points[:, :2] - mark.T_bin_mark[:2, 3]) < 1.5 * half).all(axis=1))
        local = geometry.transform(geometry.inverse(mark.T_bin_mark), points[near])
        on = (np.abs(local[:, :2]) < half).all(axis=1)
        cell_m = np.float32(mark.side_m / (MODULES * CELLS))
        # the middle of raster cell 0 lies half a cell inside its edge
        column, row = ((np.float32(half) + upright) / cell_m - np.float32(0.5) for upright in (local[on, 0], -local[on, 1]))
        painted[near[on]] = sample(_raster(mark.number, float(pixel_m / cell_m)), column, row, cv2.BORDER_REPLICATE)
    return painted


@functools.cache
def _raster(number: int, pixel_cells: float) -> Float32[np.ndarray, "h w"]:
    """A tag with its white border; a pixel's square is taken as a Gaussian of its spread."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{FAMILY.upper()}"))
    tag = cv2.aruco.generateImageMarker(dictionary, number, MODULES * CELLS)
    quiet = round(QUIET * MODULES * CELLS)
    page = cv2.copyMakeBorder(tag, quiet, quiet, quiet, quiet, cv2.BORDER_CONSTANT, value=255).astype(np.float32) / 255
    soft: Float32[np.ndarray, "h w"] = cv2.GaussianBlur(page, (0, 0), pixel_cells / np.sqrt(12))
    return BLACK + (WHITE - BLACK) * soft
