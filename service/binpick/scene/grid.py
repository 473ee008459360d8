"""Parts on the pixel grid: regions between steps and creases, joined where along their whole border one surface goes on.

The idea is that of locally convex connected patches (Stein et al., LCCP, 2014) on the organised grid: a concave crease
separates two parts, a convex one two faces of one part. A single link decides nothing, as one leak would merge two parts:
regions are what hangs together even when its border is taken off, and whether two belong together is asked of all ways across
their border.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64

from binpick.data import Labels, Mask
from binpick.scene import prism
from binpick.scene.contact import Contacts, Ways, contacts, ways
from binpick.scene.extent import Extents, cut, groups, longest_part
from binpick.scene.surface import Surface
from binpick.settings import SegmentSettings

HALF_WAY_M = 0.0025
"""Half the length of the ways on which steps and bends are looked for."""
SIGMAS = 3.0
"""A step is larger than this many sigma of depth."""
SPECK_M = 0.0015
"""Cuts and holes smaller than a square of this side cut nothing."""
CORE_M = 0.0006
"""What hangs together by less than twice this is two regions."""
GROWTH_M = 0.010
"""Regions take back their border this far at most."""
OFF_M = 0.003
"""What a region takes back lies at most this far off its tangent plane there."""
BIG_M2 = 150e-6
"""Two regions that are both larger are joined on better proof: fragments are, in doubt, of their neighbour."""
STEP_M, BIG_STEP_M = 0.0014, 0.0005
"""Largest mean step along a border within a part."""
BEND_M, BIG_BEND_M = 0.0004, 0.0003
"""Largest mean concave bend along a border within a part."""
BORDER_M, BIG_BORDER_M = 0.003, 0.008
"""Least length of a border within a part."""
FRAGMENT_M2 = 300e-6
FRAGMENT_STEP_M, FRAGMENT_BEND_M = 0.0035, 0.0015
"""At last a smaller region joins the neighbour it shares most border with, when the border's step and bend stay below these."""


def segment(surface: Surface, of_interest: Mask, settings: SegmentSettings) -> tuple[Labels, Labels]:
    """Faces and parts among the pixels of interest; label 0 is nobody, no minimum size yet. Faces end a bit before creases."""
    spacing_m = spacing(surface, of_interest)
    if not spacing_m:
        return np.zeros(of_interest.shape, dtype=np.int32), np.zeros(of_interest.shape, dtype=np.int32)
    along = ways(surface, of_interest, max(1, round(HALF_WAY_M / spacing_m)))
    concave, convex = _cuts(along, of_interest, settings)
    speck = max(2, int((SPECK_M / spacing_m) ** 2))
    borders = _without_specks(concave & of_interest, speck) | _without_specks(~of_interest, speck)
    regions = _grown(_cores(of_interest, borders, CORE_M / spacing_m), surface, of_interest, GROWTH_M / spacing_m)
    parts, extents, longest_m = _parts(regions, along, surface, spacing_m)
    faces = _faces(parts, concave | convex)
    whole = groups(extents, *prism.pairs(faces, parts, surface, spacing_m), longest_m)
    return faces, whole.astype(np.int32)[parts]


def spacing(surface: Surface, of_interest: Mask) -> float:
    """Median distance of neighbouring points of every eighth row, metres; 0 when there are none."""
    both = of_interest[::8, 1:] & of_interest[::8, :-1]
    step = surface.xyz[::8, 1:][both] - surface.xyz[::8, :-1][both]
    return float(np.sqrt(np.median(np.einsum("ij,ij->i", step, step)))) if len(step) else 0.0


def _cuts(along: list[Ways], of_interest: Mask, settings: SegmentSettings) -> tuple[Mask, Mask]:
    """Pixels at steps and concave folds, and those at convex folds: the middles of ways that cross one."""
    concave, convex = np.zeros(of_interest.size, dtype=bool), np.zeros(of_interest.size, dtype=bool)
    fold = np.float32(HALF_WAY_M * np.sin(settings.crease_rad))
    for way in along:
        noise = np.float32(SIGMAS) * way.sigma_m
        stepped = np.abs(way.step_m) > np.maximum(np.float32(settings.jump_m), noise)
        least = np.maximum(fold, np.float32(0.7) * noise)
        concave[way.middle[stepped | (way.bend_m > least)]] = True
        convex[way.middle[way.bend_m < -least]] = True
    return concave.reshape(of_interest.shape), convex.reshape(of_interest.shape)


def _without_specks(mask: Mask, least: int) -> Mask:
    """Without components of fewer pixels."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8, ltype=cv2.CV_32S)
    keep = stats[:, cv2.CC_STAT_AREA] >= least
    keep[0] = False
    kept: Mask = keep[labels]
    return kept


def _cores(of_interest: Mask, borders: Mask, radius_px: float) -> Labels:
    """Components of what is further than the radius, but at least a pixel, from any border."""
    distance = cv2.distanceTransform((~borders).astype(np.uint8), cv2.DIST_C, 3)
    core = of_interest & (distance > max(1, round(radius_px)))
    _, labels = cv2.connectedComponents(core.astype(np.uint8), connectivity=4, ltype=cv2.CV_32S)
    return np.asarray(labels, dtype=np.int32)


def _grown(cores: Labels, surface: Surface, of_interest: Mask, reach_px: float) -> Labels:
    """Pixels around the cores go to the nearest one, if they lie near its surface there; what is left is regions of its own."""
    _, nearest = cv2.distanceTransformWithLabels((cores == 0).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    regions = cores.copy()
    if cores.any():
        source = np.zeros(int(nearest.max()) + 1, dtype=np.int64)
        inside = np.flatnonzero(cores)
        source[nearest.ravel()[inside]] = inside
        place = np.flatnonzero(of_interest & (cores == 0))
        origin = source[nearest.ravel()[place]]
        xyz, normal = surface.xyz.reshape(-1, 3), surface.normal.reshape(-1, 3)
        off = np.abs(np.einsum("ij,ij->i", normal[origin], xyz[place] - xyz[origin]))
        row, col = np.divmod(place, cores.shape[1])
        row_of, col_of = np.divmod(origin, cores.shape[1])
        near = (off < OFF_M) & (np.hypot(row - row_of, col - col_of) <= reach_px)
        regions.ravel()[place[near]] = cores.ravel()[origin[near]]
    _, rest = cv2.connectedComponents((of_interest & (regions == 0)).astype(np.uint8), connectivity=4, ltype=cv2.CV_32S)
    return np.where(rest > 0, rest + regions.max(), regions).astype(np.int32)


def _parts(regions: Labels, along: list[Ways], surface: Surface, spacing_m: float) -> tuple[Labels, Extents, float]:
    """Regions joined to parts; their extents; and how long parts are, which none exceeds that could be cut."""
    touching, extents, area = contacts(regions, along), Extents.of(regions, surface), _areas(regions, spacing_m)
    group = _joined(touching, area, extents, np.inf, spacing_m)
    whole = extents.merged(group)
    longest_m = longest_part(whole.lengths_m, np.bincount(group, area).astype(np.float64))
    if (whole.lengths_m > longest_m).any():
        if (extents.lengths_m > longest_m).any():
            regions = cut(regions, extents, longest_m, spacing_m)
            touching, extents, area = contacts(regions, along), Extents.of(regions, surface), _areas(regions, spacing_m)
        group = _joined(touching, area, extents, longest_m, spacing_m)
        whole = extents.merged(group)
    return group.astype(np.int32)[regions], whole, longest_m


def _areas(labels: Labels, spacing_m: float) -> Float64[np.ndarray, "p"]:
    """The area that every label covers, seen from the camera."""
    return np.asarray(np.bincount(labels.ravel()) * spacing_m**2)


def _joined(touching: Contacts, area: Float64[np.ndarray, "p"], extents: Extents, longest_m: float,
            spacing_m: float) -> Int64[np.ndarray, "p"]:
    """The part of each region, none longer than that by joining; 0 stays nobody."""
    big = np.minimum(area[touching.first], area[touching.second]) > BIG_M2
    same = np.abs(touching.step_m) < np.where(big, BIG_STEP_M, STEP_M)
    same &= touching.bend_m < np.where(big, BIG_BEND_M, BEND_M)
    # each pixel along a border is crossed by about four ways
    same &= touching.count * spacing_m / 4 >= np.where(big, BIG_BORDER_M, BORDER_M)
    kept = np.flatnonzero(same)
    kept = kept[np.argsort(-touching.count[kept], kind="stable")]
    group = groups(extents, touching.first[kept], touching.second[kept], longest_m)
    touching, area, extents = touching.merged(group), np.bincount(group, weights=area).astype(np.float64), extents.merged(group)
    likely = np.minimum(area[touching.first], area[touching.second]) < FRAGMENT_M2
    likely &= (np.abs(touching.step_m) < FRAGMENT_STEP_M) & (touching.bend_m < FRAGMENT_BEND_M)
    parts: Int64[np.ndarray, "p"] = groups(extents, *_best(area, touching, likely), longest_m)[group]
    return parts


def _best(area: Float64[np.ndarray, "p"], touching: Contacts, likely: Bool[np.ndarray, "n"],
          ) -> tuple[Int64[np.ndarray, "m"], Int64[np.ndarray, "m"]]:
    """For the smaller region of every likely contact the one it shares most border with."""
    first, second, count = touching.first[likely], touching.second[likely], touching.count[likely]
    swap = area[second] < area[first]
    small, large = np.where(swap, second, first), np.where(swap, first, second)
    order = np.lexsort((large, -count, small))
    _, best = np.unique(small[order], return_index=True)
    return small[order][best], large[order][best]


def _faces(parts: Labels, creases: Mask) -> Labels:
    """Components of the parts' pixels off all creases."""
    inner = (parts > 0) & ~creases
    inner[:, 1:] &= (parts[:, 1:] == parts[:, :-1]) | (parts[:, :-1] == 0)
    inner[1:] &= (parts[1:] == parts[:-1]) | (parts[:-1] == 0)
    _, faces = cv2.connectedComponents(inner.astype(np.uint8), connectivity=4, ltype=cv2.CV_32S)
    return np.asarray(faces, dtype=np.int32)
