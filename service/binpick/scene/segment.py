"""Tells parts apart by the recipe's method, and keeps what has the size of a part."""

import cv2
import numpy as np
from jaxtyping import Float32
from scipy import ndimage

from binpick import geometry
from binpick.data import Labels, Mask, Segments, frozen
from binpick.scene import euclid, grid
from binpick.scene.bin import FLOOR_M
from binpick.scene.surface import Surface, around
from binpick.settings import Bin, PartSize, SegmentSettings

WALL_M = 0.003
"""Points this near a wall may be the wall."""
LEAST_M = FLOOR_M / 2
"""Nothing lower than this above the floor is of interest; nearer to it sigma decides."""
METHODS = {"grid": grid.segment, "open3d": euclid.segment}


def segment(surface: Surface, model: Bin, part: PartSize, settings: SegmentSettings) -> Segments:
    """Faces and parts inside the bin and above its floor."""
    of_interest = _inside(surface, model)
    inner = around(of_interest)
    near, asked = surface.cut(inner), np.ascontiguousarray(of_interest[inner])
    found = METHODS[settings.method](near, asked, settings)
    spacing_m = grid.spacing(near, asked)
    least = max(12, int(0.5 * (part.min_size_m / spacing_m) ** 2)) if spacing_m else 12
    faces, parts = (np.zeros(of_interest.shape, dtype=np.int32) for _ in found)
    faces[inner], parts[inner] = (_drop_small(labels, least) for labels in found)
    masks = {label: (box, parts[box] == label) for label, box in enumerate(ndimage.find_objects(parts), 1)}
    points = {label: surface.xyz[box][mask] for label, (box, mask) in masks.items()}
    return Segments(xyz=frozen(surface.xyz), normal=frozen(surface.normal), faces=frozen(faces), parts=frozen(parts),
                    part_points=points,
                    part_confidence={label: _confidence(points[label], mask, part) for label, (_, mask) in masks.items()})


def box(model: Bin, above_rim_m: float) -> tuple[geometry.Vector, geometry.Vector]:
    """The box in the bin's frame in which points can be of interest."""
    length, width, height = model.inner_size_m
    side = np.array([length / 2 - WALL_M, width / 2 - WALL_M])
    return np.array([*-side, LEAST_M]), np.array([*side, height + above_rim_m])


def _inside(surface: Surface, model: Bin) -> Mask:
    """Measured points with a normal, above the floor and not of a wall."""
    length, width, _ = model.inner_size_m
    x, y, z = surface.xyz[..., 0], surface.xyz[..., 1], surface.xyz[..., 2]
    with np.errstate(invalid="ignore"):
        above = z > np.maximum(np.float32(LEAST_M), 3 * surface.sigma_z_m)
        inside = (np.abs(x) < length / 2 - WALL_M) & (np.abs(y) < width / 2 - WALL_M)
    return np.asarray(above & inside & np.isfinite(surface.normal[..., 0]))


def _drop_small(labels: Labels, least: int) -> Labels:
    """Only segments of at least `least` pixels, counted anew from 1 in reading order."""
    sizes = np.bincount(labels.ravel(), minlength=1)
    # the first pixel of each: written backwards, the first one is written last
    first = np.zeros(len(sizes), dtype=np.int64)
    first[labels.ravel()[::-1]] = np.arange(labels.size)[::-1]
    keep = np.flatnonzero(sizes >= least)
    keep = keep[keep > 0]
    renumbered = np.zeros(len(sizes), dtype=np.int32)
    renumbered[keep[np.argsort(first[keep])]] = np.arange(1, len(keep) + 1, dtype=np.int32)
    kept: Labels = renumbered[labels]
    return kept


def _confidence(points: Float32[np.ndarray, "n 3"], mask: Mask, part: PartSize) -> float:
    """How sure a segment is one part: its extent against the largest part's, and how well it fills its outline's hull.

    A segment grown over two parts is long or ragged; its height must not win by itself, so this multiplies the quality.
    """
    (_, (a, b), _) = cv2.minAreaRect(np.ascontiguousarray(points[:, :2]))
    outline = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    hull = cv2.convexHull(np.concatenate(outline))
    solidity = float(mask.sum()) / max(float(cv2.contourArea(hull)), float(mask.sum()), 1.0)
    return round(float(np.clip(2 - max(a, b) / part.max_size_m, 0.1, 1)) * (0.4 + 0.6 * solidity), 4)
