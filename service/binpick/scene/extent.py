"""How far segments reach, and how far a part of this bin does: what is much longer is several parts grown together.

The length that most of the measured surface belongs to is that of a part lying in plain view, whatever the kinds in the bin:
merged segments and fragments are each a small share.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64
from scipy import ndimage

from binpick.data import Labels, Mask
from binpick.scene.surface import Surface

DIRECTIONS = 32
"""A length is measured along the one of these that it is closest to: 12° off at most, 2 % too short."""
LONGER = 1.2
"""Parts are at most this many times as long as most of the surface's segments."""
LEAST_SEGMENTS = 8
"""From fewer segments nothing is learnt of their parts' length."""
SEGMENT_M2 = 150e-6
"""Smaller ones are fragments, that say nothing about it, and no pieces worth a cut."""
NECK_M = 0.008
"""Segments that are too long are cut where they are narrower than twice this."""

CORE_M2 = 60e-6
"""What is left of a piece when its neighbours fall off."""

Pairs = Int64[np.ndarray, "m"]
Groups = Int64[np.ndarray, "n"]
Values = Float64[np.ndarray, "n"]


def _directions() -> Float32[np.ndarray, "d 3"]:
    """Evenly over half a sphere: a golden spiral."""
    step = (np.arange(DIRECTIONS) + 0.5) / DIRECTIONS
    turn, out = np.pi * (1 + 5**0.5) * np.arange(DIRECTIONS), np.sqrt(1 - step**2)
    return np.stack([out * np.cos(turn), out * np.sin(turn), step], axis=1).astype(np.float32)


_ALONG = _directions()


@dataclass(frozen=True, slots=True, eq=False)
class Extents:
    """Where labelled segments end, both ways along every direction; -inf for what is nowhere. Metres."""

    ends: Float32[np.ndarray, "n d2"]

    @classmethod
    def of(cls, labels: Labels, surface: Surface) -> "Extents":
        """Of every label of a map, 0 among them; every second row and column is looked at."""
        ends = np.full((int(labels.max(initial=0)) + 1, 2 * DIRECTIONS), -np.inf, dtype=np.float32)
        few = labels[::2, ::2]
        place = np.flatnonzero(few)
        if len(place):
            place = place[np.argsort(few.ravel()[place], kind="stable")]
            label = few.ravel()[place]
            starts = np.flatnonzero(np.diff(label, prepend=0))
            at = cv2.transform(surface.xyz[::2, ::2].reshape(-1, 1, 3)[place], _ALONG)[:, 0]
            ends[label[starts], :DIRECTIONS] = np.maximum.reduceat(at, starts, axis=0)
            ends[label[starts], DIRECTIONS:] = -np.minimum.reduceat(at, starts, axis=0)
        return cls(ends)

    def merged(self, group: Groups) -> "Extents":
        """Of the groups that the segments fall into."""
        ends = np.full((int(group.max(initial=0)) + 1, 2 * DIRECTIONS), -np.inf, dtype=np.float32)
        np.maximum.at(ends, group, self.ends)
        return Extents(ends)

    @property
    def lengths_m(self) -> Values:
        """Each one's longest extent; 0 for what is nowhere."""
        longest: Values = np.maximum((self.ends[:, :DIRECTIONS] + self.ends[:, DIRECTIONS:]).max(axis=1), 0).astype(np.float64)
        return longest


def longest_part(lengths_m: Values, area_m2: Values) -> float:
    """How long a part of this bin can be; inf when too little is seen to tell. `area_m2` weighs the segments."""
    large = np.flatnonzero((area_m2 >= SEGMENT_M2) & (lengths_m > 0))
    if len(large) < LEAST_SEGMENTS:
        return float("inf")
    order = large[np.argsort(lengths_m[large], kind="stable")]
    share = np.cumsum(area_m2[order])
    return LONGER * float(lengths_m[order[np.searchsorted(share, share[-1] / 2)]])


def groups(extents: Extents, first: Pairs, second: Pairs, longest_m: float) -> Int64[np.ndarray, "c"]:
    """The group of each segment when pairs of them are made one, earlier pairs first, and no group gets longer than that.

    Segment 0, which no pair may hold, stays 0; the others' groups count in the order of their first members.
    """
    pairs = list(zip(first.tolist(), second.tolist(), strict=True))
    owner = list(range(len(extents.ends)))
    for pair in pairs:
        _unite(owner, *pair)
    whole = _numbered(owner)
    if not np.isfinite(longest_m) or not (long := extents.merged(whole).lengths_m > longest_m).any():
        return whole
    owner, ends = list(range(len(owner))), extents.ends.copy()
    for pair in pairs:
        one, other = (_root(owner, segment) for segment in pair)
        both = np.maximum(ends[one], ends[other])
        if not long[whole[one]] or float((both[:DIRECTIONS] + both[DIRECTIONS:]).max()) <= longest_m:
            ends[_unite(owner, one, other)] = both
    return _numbered(owner)


def _root(owner: list[int], segment: int) -> int:
    while owner[segment] != segment:
        owner[segment] = segment = owner[owner[segment]]
    return segment


def _unite(owner: list[int], one: int, other: int) -> int:
    """Makes two groups one; the lower root stays the root."""
    first, last = sorted((_root(owner, one), _root(owner, other)))
    owner[last] = first
    return first


def _numbered(owner: list[int]) -> Int64[np.ndarray, "c"]:
    roots = [_root(owner, segment) for segment in range(len(owner))]
    return np.unique(np.array(roots, dtype=np.int64), return_inverse=True)[1].astype(np.int64)


def cut(labels: Labels, extents: Extents, longest_m: float, spacing_m: float) -> Labels:
    """The labels with those that are too long cut at their necks, if they have any; new ones count on."""
    found, last = labels.copy(), int(labels.max(initial=0))
    boxes = ndimage.find_objects(labels)
    for label in np.flatnonzero(extents.lengths_m > longest_m).tolist():
        mask = labels[boxes[label - 1]] == label
        pieces = _pieces(mask, spacing_m)
        place = mask & (pieces > 1)
        found[boxes[label - 1]][place] = pieces[place] - 1 + last
        last = max(last, int(found.max()))
    return found


def _pieces(mask: Mask, spacing_m: float) -> Labels:
    """Where a mask falls apart first as it is eaten from its outline: its pieces from 1; 1 only if it does not."""
    framed = cv2.copyMakeBorder(mask.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT)
    # holes of a pixel are noise, not necks
    closed = cv2.morphologyEx(framed, cv2.MORPH_CLOSE, np.ones((3, 3), dtype=np.uint8))
    depth = cv2.distanceTransform(closed, cv2.DIST_L2, 5)[1:-1, 1:-1]
    for radius in range(1, round(NECK_M / spacing_m) + 1):
        _, cores, stats, _ = cv2.connectedComponentsWithStats((depth > radius).astype(np.uint8), connectivity=4)
        large = np.flatnonzero(stats[1:, cv2.CC_STAT_AREA] * spacing_m**2 > CORE_M2) + 1
        if len(large) > 1:
            number = np.zeros(len(stats), dtype=np.int32)
            number[large] = np.arange(1, len(large) + 1)
            return _nearest(number[cores])
    return np.ones(mask.shape, dtype=np.int32)


def _nearest(cores: Labels) -> Labels:
    """Every pixel to the core it is closest to."""
    _, closest = cv2.distanceTransformWithLabels((cores == 0).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    owner = np.zeros(int(closest.max()) + 1, dtype=np.int32)
    owner[closest[cores > 0]] = cores[cores > 0]
    found: Labels = owner[closest]
    return found
