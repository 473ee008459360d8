"""Coverage: where a set of views shows the board (image cells, distances, tilts), what is missing, which view would help."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import cv2
import numpy as np

from binpick.rigcheck import sight
from binpick.rigcheck.detection import Detection, Refusal

COLUMNS, ROWS = 6, 4
"""Cells of each image: two by one are a corner, two by two the middle or the side's edge."""
WANTED = 12
"""Views: with fewer the distortion is left to chance (`solve` asks for five at least)."""
TILTED_RAD = 0.3
"""A board that is less tilted says little about the focal length."""
RANGE = 1.25
"""Times as near as the farthest view the nearest should be: distances separate the focal length from the principal point."""
STILL_PX = 2.0
"""Between two frames a third of a second apart: within an exposure of 10 ms that is less than a tenth of a pixel."""
SOFT_PX, BLURRED, FAINT = 3.0, 1.5, 25.0
"""Blur by itself (sigma, px), blur in terms of the views' median (`solve` refuses a little beyond), contrast in grey levels."""
NEW_MIDDLE, NEW_SCALE, NEW_TILT_RAD, NEW_TURN_RAD = 0.12, 1.12, 0.14, 0.35
"""A view is new when the board's middle moved by this share of the image, its size by this factor, or it turned so far."""


class Tilt(StrEnum):
    """Which side of the board comes nearer to the camera, in the image."""

    LEFT = "left"
    RIGHT = "right"
    UPPER = "upper"
    LOWER = "lower"


@dataclass(frozen=True, slots=True)
class Look:
    """One camera's view of the board.

    `middle`: of the points, as shares of width and height; `scale`: px per metre of board in its middle, before foreshortening
    (focal length over distance); `tilt_rad`: how far it recedes to the right and downwards; `turn_rad`: of its rows in the
    image; `cells`: (column, row) that hold points.
    """

    middle: tuple[float, float]
    scale: float
    tilt_rad: tuple[float, float]
    turn_rad: float
    cells: frozenset[tuple[int, int]]
    blur_px: float

    @property
    def tilt(self) -> Tilt | None:
        """The nearer side; None when the board is seen too squarely to count."""
        right, down = self.tilt_rad
        if np.hypot(right, down) < TILTED_RAD:
            return None
        if abs(right) > abs(down):
            return Tilt.LEFT if right > 0 else Tilt.RIGHT
        return Tilt.UPPER if down > 0 else Tilt.LOWER


Seen = Sequence[Detection | None]
"""One moment: a detection for each camera in the rig's order, None where the board was not found."""


def look(detection: Detection) -> Look:
    """What counts of a detection."""
    size = np.array(detection.image_size_px)
    points = detection.points_m[:, :2].astype(np.float64)
    H, _ = cv2.findHomography(points, detection.corners_px)
    x, y, w = H @ [*points.mean(0), 1.0]
    local = (H[:2, :2] - np.outer([x / w, y / w], H[2, :2])) / w
    axes, (long, short), _ = np.linalg.svd(local)
    # w grows with the distance: it tells which end of the foreshortened direction is the farther one
    away = axes[:, 1] * np.sign(H[2, :2] @ np.linalg.solve(local, axes[:, 1]) / w)
    right, down = float(np.arccos(np.clip(short / long, 0, 1))) * away
    cells = np.clip(detection.corners_px / size * (COLUMNS, ROWS), 0, (COLUMNS - 1, ROWS - 1)).astype(int)
    across, below = detection.corners_px.mean(0) / size
    turn_rad = float(np.arctan2(local[1, 0], local[0, 0]))
    return Look((float(across), float(below)), float(long), (float(right), float(down)), turn_rad,
                frozenset((int(column), int(row)) for column, row in cells), detection.quality.blur_px)


@dataclass(frozen=True, slots=True)
class Coverage:
    """The views so far, of cameras called `cameras`; `wanted`: how many views there should be at least."""

    cameras: tuple[str, ...] = ("left", "right")
    wanted: int = WANTED
    views: tuple[tuple[Look | None, ...], ...] = ()

    def add(self, seen: Seen) -> "Coverage":
        """With one view more."""
        return replace(self, views=(*self.views, tuple(None if found is None else look(found) for found in seen)))

    def cells(self, camera: int) -> np.ndarray:
        """How many views have points of the board in each cell of a camera's image, rows x columns."""
        counts = np.zeros((ROWS, COLUMNS), dtype=int)
        for own in self._looks(camera):
            for column, row in own.cells:
                counts[row, column] += 1
        return counts

    def shared(self, camera: int) -> np.ndarray:
        """Cells of a camera's image that another one sees as well, rows x columns: a pair covers no others.

        Cameras that look side by side each have a border of their own; by how much, the views so far tell.
        """
        if len(self.cameras) < 2:
            return np.ones((ROWS, COLUMNS), dtype=bool)
        others = [c for c in range(len(self.cameras)) if c != camera] if camera == 0 else [0]
        return np.asarray(np.any([self._inside(camera, other) for other in others], axis=0))

    def _inside(self, camera: int, other: int) -> np.ndarray:
        steps = [np.subtract(view[other].middle, view[camera].middle) for view in self.views    # type: ignore[union-attr]
                 if view[camera] is not None and view[other] is not None]
        step = np.median(steps, axis=0) if steps else np.zeros(2)
        across, down = (np.arange(COLUMNS) + 0.5) / COLUMNS + step[0], (np.arange(ROWS) + 0.5) / ROWS + step[1]
        return np.asarray(((down > 0) & (down < 1))[:, None] & ((across > 0) & (across < 1)))

    def _looks(self, camera: int) -> list[Look]:
        return [own for view in self.views if (own := view[camera]) is not None]

    @property
    def tilts(self) -> dict[Tilt, int]:
        """How many views show each side of the board nearer, as the first camera sees it."""
        seen = [own.tilt for own in self._looks(0)]
        return {tilt: seen.count(tilt) for tilt in Tilt}

    @property
    def range(self) -> float:
        """How many times as near as the farthest view the nearest is; 1 without views."""
        scales = [own.scale for own in self._looks(0)]
        return max(scales) / min(scales) if scales else 1.0

    @property
    def missing(self) -> list[str]:
        """What the next views should show, as sentences; the most telling first. Empty: it is enough."""
        lacking = self._unshown
        if self.range < RANGE:
            lacking.append(f"the board nearer or farther: the nearest view is {self.range:.2f} times as near as the farthest, "
                           f"{RANGE:g} are wanted")
        if len(self.views) < self.wanted:
            lacking.append(f"{self.wanted - len(self.views)} more views: there are {len(self.views)} of {self.wanted}")
        return lacking

    @property
    def _unshown(self) -> list[str]:
        """Places in the images, and tilts."""
        lacking = [f"the {place} of the {name} image" for camera, name in enumerate(self.cameras)
                   for place in _regions(self.cells(camera), self.shared(camera))]
        return lacking + [f"the board tilted, its {tilt} side nearer" for tilt, views in self.tilts.items() if not views]

    @property
    def enough(self) -> bool:
        """Whether `solve` has what it needs."""
        return not self.missing

    def useful(self, seen: Seen, previous: Seen | None = None) -> tuple[bool, str]:
        """Whether a view should be taken, and what is new about it or why not, as a sentence.

        `previous`: the same cameras' frame before: the board must have stood still since. Without it that is not looked at.
        """
        for refuse in (self._unseen, lambda now: _moved(now, previous), self._unsharp):
            if why := refuse(seen):
                return False, why
        return self._news(seen)

    def _unseen(self, seen: Seen) -> str:
        blind = [name for name, found in zip(self.cameras, seen, strict=True) if found is None]
        if len(blind) == len(seen):
            return "no camera sees the board" if len(seen) > 1 else "the camera does not see the board"
        if len(seen) > 1 and (seen[0] is None or len(blind) > len(seen) - 2):
            return f"the {' and the '.join(blind)} camera does not see the board"
        return ""

    def _unsharp(self, seen: Seen) -> str:
        for camera, found in enumerate(seen):
            if found is None:
                continue
            blur, name = found.quality.blur_px, self.cameras[camera]
            if found.quality.contrast < FAINT:
                return f"too dark or too faint in the {name} image: {found.quality.contrast:.0f} grey levels of contrast"
            usual = float(np.median([own.blur_px for own in self._looks(camera)] or [np.inf]))
            if blur > SOFT_PX or (len(self.views) > 2 and blur > BLURRED * usual):
                return f"blurred in the {name} image: edges of {blur:.1f} px" + (f", usually {usual:.1f}" if self.views else "")
        return ""

    def _news(self, seen: Seen) -> tuple[bool, str]:
        grown = self.add(seen)
        shown = [sentence for sentence in self._unshown if sentence not in grown.missing]
        if shown:
            return True, f"new: {shown[0]}"
        if self.views and grown.range > max(self.range, RANGE) > self.range:
            return True, "new: another distance"
        now = grown.views[-1]
        alike = next((number for number, view in enumerate(self.views, start=1) if _alike(view, now)), None)
        if alike is not None:
            return False, f"like view {alike}: move, tilt or turn the board"
        if len(self.views) >= self.wanted:      # more of the same would only make `solve` slower
            return False, f"still missing: {self.missing[0]}" if self.missing else "nothing is missing"
        return True, "new"

    @property
    def summary(self) -> dict[str, Any]:
        """As JSON: what a display needs. Cells: rows of counts, null where no other camera looks."""
        cells = {name: [[int(n) if there else None for n, there in zip(*rows, strict=True)]
                        for rows in zip(self.cells(camera), self.shared(camera), strict=True)]
                 for camera, name in enumerate(self.cameras)}
        return {"views": len(self.views), "wanted": self.wanted, "cells": cells, "range": round(self.range, 3),
                "tilts": {str(tilt): views for tilt, views in self.tilts.items()}, "missing": self.missing,
                "enough": self.enough}


def _moved(seen: Seen, previous: Seen | None) -> str:
    for now, before in zip(seen, previous or (), strict=False):
        if now is None:
            continue
        aligned = None if before is None else sight.align(before, now)
        if before is None or aligned is None or isinstance(aligned, Refusal):
            return "the board has just come into view"
        _, here, there = np.intersect1d(aligned.ids, before.ids, return_indices=True)
        if not len(here):
            return "the board has just come into view"
        way = float(np.median(np.linalg.norm(aligned.corners_px[here] - before.corners_px[there], axis=1)))
        if way > STILL_PX:
            return f"the board moves: {way:.0f} px since the last frame"
    return ""


def _alike(one: Sequence[Look | None], other: Sequence[Look | None]) -> bool:
    pairs = [(a, b) for a, b in zip(one, other, strict=True) if a is not None and b is not None]
    return bool(pairs) and all(
        np.hypot(*np.subtract(a.middle, b.middle)) < NEW_MIDDLE and max(a.scale / b.scale, b.scale / a.scale) < NEW_SCALE
        and np.hypot(*np.subtract(a.tilt_rad, b.tilt_rad)) < NEW_TILT_RAD
        and abs(np.angle(np.exp(1j * (a.turn_rad - b.turn_rad)))) < NEW_TURN_RAD for a, b in pairs)


def _regions(counts: np.ndarray, shared: np.ndarray) -> list[str]:
    """Corners, edges and the middle of which less than half of the shared cells show the board."""
    across, down = ("left", "", "right"), ("upper", "", "lower")
    lacking = []
    for row, rows in enumerate((slice(0, 1), slice(1, 3), slice(3, 4))):
        for column in range(3):
            part = (rows, slice(2 * column, 2 * column + 2))
            there = counts[part][shared[part]]
            if len(there) and (there > 0).mean() < 0.5:
                words = [word for word in (down[row], across[column]) if word]
                lacking.append(" ".join([*words, ("middle", "edge", "corner")[len(words)]]))
    return lacking
