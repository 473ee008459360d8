"""Tells parts apart by the recipe's method, and keeps what has the size of a part."""

import cv2
import numpy as np
from jaxtyping import Float32, Float64
from scipy import ndimage

from binpick import geometry
from binpick.data import Labels, Mask, Segments, frozen
from binpick.scene import euclid, grid
from binpick.scene.bin import FLOOR_M
from binpick.scene.surface import Surface, around
from binpick.settings import Bin, PartSize, SegmentSettings

WALL_M = 0.003
"""Points this near a wall may be the wall."""
BESIDE_M, HIGHER_M = 0.004, 0.004
"""What stands this much higher this near to a part's outline covers it."""
COVERED_DOUBT = 0.4
"""What being covered all around takes from a part's confidence."""
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
    small_faces, small_parts = (_drop_small(labels, least) for labels in found)
    masks = {label: (place, small_parts[place] == label) for label, place in enumerate(ndimage.find_objects(small_parts), 1)}
    points = {label: near.xyz[place][mask] for label, (place, mask) in masks.items()}
    covered = _covered(small_parts, near, spacing_m).tolist() if masks else []
    faces, parts = (np.zeros(of_interest.shape, dtype=np.int32) for _ in found)
    faces[inner], parts[inner] = small_faces, small_parts
    return Segments(
        xyz=frozen(surface.xyz), normal=frozen(surface.normal), faces=frozen(faces), parts=frozen(parts), part_points=points,
        part_confidence={label: _confidence(points[label], mask, covered[label], part, spacing_m)
                         for label, (_, mask) in masks.items()})


def box(model: Bin, above_rim_m: float) -> tuple[geometry.Vector, geometry.Vector]:
    """The box in the bin's frame in which points can be of interest."""
    length, width, height = model.inner_size_m
    side = np.array([length / 2 - WALL_M, width / 2 - WALL_M])
    return np.array([*-side, LEAST_M]), np.array([*side, height + above_rim_m])


def _inside(surface: Surface, model: Bin) -> Mask:
    """Measured points with a normal, above the floor and not of a wall."""
    length, width, _ = model.inner_size_m
    side = length / 2 - WALL_M, width / 2 - WALL_M
    inside = np.asarray(cv2.inRange(surface.xyz, (-side[0], -side[1], LEAST_M), (*side, np.inf)) > 0)
    place = np.flatnonzero(inside)
    z, across = surface.xyz.reshape(-1, 3)[place, 2], surface.normal.reshape(-1, 3)[place, 0]
    with np.errstate(invalid="ignore"):
        inside.ravel()[place] = (z > 3 * surface.sigma_z_m.ravel()[place]) & np.isfinite(across)
    return inside


def _drop_small(labels: Labels, least: int) -> Labels:
    """Only segments of at least `least` pixels, counted anew from 1 in reading order."""
    place = np.flatnonzero(labels)
    label = labels.ravel()[place]
    sizes = np.bincount(label, minlength=1)
    # the first pixel of each: written backwards, the first one is written last
    first = np.zeros(len(sizes), dtype=np.int64)
    first[label[::-1]] = place[::-1]
    keep = np.flatnonzero(sizes >= least)
    renumbered = np.zeros(len(sizes), dtype=np.int32)
    renumbered[keep[np.argsort(first[keep])]] = np.arange(1, len(keep) + 1, dtype=np.int32)
    kept: Labels = np.zeros(labels.shape, dtype=np.int32)
    kept.ravel()[place] = renumbered[label]
    return kept


def _confidence(points: Float32[np.ndarray, "n 3"], mask: Mask, covered: float, part: PartSize, spacing_m: float) -> float:
    """How sure a segment is one part: its extent against the largest part's, how well it fills its outline's hull, how large it
    is against the smallest part's, and which share of its outline is covered by what stands higher.

    A segment grown over two parts is long or ragged, a fragment is small, and what lies below others is not seen whole. Its
    height must not win by itself, so this multiplies the quality.
    """
    outlines = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    outline = np.concatenate(outlines)
    number = np.cumsum(mask.ravel()) - 1
    around_it = points[number[outline[:, 0, 1] * mask.shape[1] + outline[:, 0, 0]], :2]
    (_, (a, b), _) = cv2.minAreaRect(np.ascontiguousarray(around_it))
    solidity = len(points) / max(float(cv2.contourArea(cv2.convexHull(outline))), float(len(points)))
    support = min(1.0, len(points) * spacing_m**2 / (2 * part.min_size_m) ** 2)
    extent = min(max(2 - max(a, b) / part.max_size_m, 0.1), 1.0)
    return round(float(extent * (0.4 + 0.6 * solidity) * (1 - COVERED_DOUBT * covered) * support**0.25), 4)


def _covered(parts: Labels, surface: Surface, spacing_m: float) -> Float64[np.ndarray, "n"]:
    """Of every label the share of its outline beside which something stands higher."""
    outline = np.zeros(parts.shape, dtype=bool)
    for one, other in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        border = parts[one] != parts[other]
        outline[one] |= border
        outline[other] |= border
    reach = 2 * max(1, round(BESIDE_M / spacing_m)) + 1
    z = np.where(np.isfinite(surface.xyz[..., 2]), surface.xyz[..., 2], np.float32(-1))
    place = np.flatnonzero(outline & (parts > 0))
    higher = cv2.dilate(z, np.ones((reach, reach), dtype=np.uint8)).ravel()[place] > z.ravel()[place] + HIGHER_M
    labels, count = parts.ravel()[place], int(parts.max(initial=0)) + 1
    return np.bincount(labels, weights=higher, minlength=count) / np.maximum(np.bincount(labels, minlength=count), 1)
