"""Segmentation against the truth: which of the parts in plain view come out as one segment of their own."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int32

from binpick import geometry
from binpick.data import Labels, Window
from binpick.lab.exam import Paper
from binpick.sim.mesh import part_mesh
from binpick.sim.truth import Truth
from binpick.sim.world import ScenePart

PLAIN_VIEW = 0.85
"""A part of which this share is seen counts as one that must be found."""
HALF, MOST = 0.5, 0.75
"""Intersections over union from which a part counts as found, and as found well."""


@dataclass(frozen=True, slots=True)
class PartScore:
    """One true part: how much of it is seen, the best segment's intersection over union, and that segment's own part share.

    `purity` is the largest true part's share of the best segment, the bin among them; NaN without a segment.
    """

    part_id: int
    kind: str
    visibility: float
    iou: float
    purity: float


def score(paper: Paper, truth: Truth, view: Window, parts: Labels) -> list[PartScore]:
    """Every part of which a pixel is seen against the segments of a half-resolution label map."""
    found = overlaps(parts, truth.part_id)
    kinds = {part.part_id: part.kind for part in paper.scene.parts}
    return [PartScore(i, kinds[i], share, *found[i]) for i, share in visibility(paper, truth, view).items()]


def recall(scores: Iterable[PartScore], iou: float = HALF, least: float = PLAIN_VIEW, most: float = 1.0) -> tuple[int, int]:
    """How many parts seen from `least` to `most` have an intersection over union above `iou`, and of how many."""
    asked = [s for s in scores if least <= s.visibility <= most]
    return sum(s.iou > iou for s in asked), len(asked)


def overlaps(parts: Labels, part_id: Int32[np.ndarray, "h2 w2"]) -> dict[int, tuple[float, float]]:
    """For each true part the best segment's intersection over union, counted in full pixels, and that segment's purity.

    `parts` is the half-resolution label map (0: nobody) of `part_id`'s window; an odd last row or column belongs to nobody.
    """
    labels = np.zeros(part_id.shape, dtype=np.int64)
    rows, cols = (2 * side for side in parts.shape)
    labels[:rows, :cols] = np.repeat(np.repeat(parts, 2, axis=0), 2, axis=1)
    segments, parts_high = int(labels.max()) + 1, int(part_id.max(initial=0)) + 1
    both = np.bincount((labels * parts_high + np.maximum(part_id, 0)).ravel(), minlength=segments * parts_high)
    counts: Float64[np.ndarray, "s p"] = both.reshape(segments, parts_high).astype(np.float64)
    found = {}
    for i in (np.flatnonzero(counts.sum(axis=0)[1:]) + 1).tolist():
        if segments == 1:
            found[i] = (0.0, float("nan"))
            continue
        shared = counts[1:, i]
        iou = shared / (counts[1:].sum(axis=1) + counts[:, i].sum() - shared)
        best = int(iou.argmax())
        found[i] = (float(iou[best]), float(counts[1 + best].max() / counts[1 + best].sum()) if iou[best] else float("nan"))
    return found


def visibility(paper: Paper, truth: Truth, view: Window) -> dict[int, float]:
    """Of each part that is seen: its visible pixels over those it would show alone in the bin."""
    seen = np.bincount(np.maximum(truth.part_id, 0).ravel())
    shares = {}
    for part in paper.scene.parts:
        if part.part_id < len(seen) and seen[part.part_id]:
            alone = _pixels_alone(paper, part, view)
            shares[part.part_id] = float(seen[part.part_id] / max(alone, int(seen[part.part_id])))
    return shares


def _pixels_alone(paper: Paper, part: ScenePart, view: Window) -> int:
    """The pixels of a window on which a part shows when nothing else lies in the bin."""
    rect = paper.rect
    T_rect_bin = geometry.inverse(rect.T_camera_rect) @ paper.inputs.job.bin.T_parent_bin
    corners = geometry.transform(T_rect_bin @ part.T_bin_part, part_mesh(part.kind).vertices)
    centre = np.array([rect.cx_px, rect.cy_px])
    pixels = rect.focal_px * corners[:, :2] / corners[:, 2:] + centre - [view.x, view.y]
    low = np.clip(np.floor(pixels.min(axis=0)).astype(int), 0, [view.width, view.height])
    high = np.clip(np.ceil(pixels.max(axis=0)).astype(int) + 1, 0, [view.width, view.height])
    if (high <= low).any():
        return 0
    around = replace(view, x=view.x + int(low[0]), y=view.y + int(low[1]), width=int(high[0] - low[0]),
                     height=int(high[1] - low[1]))
    alone = replace(paper, scene=replace(paper.scene, parts=(part,)))
    return int((alone.truth(around).part_id == part.part_id).sum())
