"""Residuals: how a rig fits the views of a board: where each corner is seen, and where the rig would have it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Int

from binpick import geometry
from binpick.errors import InputError
from binpick.geometry import Transform, epipolar
from binpick.rig import Rig, RigCamera
from binpick.rigcheck.board import Board
from binpick.rigcheck.coverage import Coverage
from binpick_calib import bundle as bundles
from binpick_calib.bundle import Bundle, Lens, Seen
from binpick_calib.solve import seen_by
from binpick_calib.views import FEWEST_VIEWS, View, Views

TERMS = 8
"""Distortion terms that the bundle knows: thin prisms and tilted sensors are beyond it."""


@dataclass(frozen=True, slots=True, eq=False)
class Misses:
    """One camera's corners: seen at `px`, less what the rig says by `off_px` (seen − expected), in views `views`."""

    px: Float[np.ndarray, "n 2"]
    off_px: Float[np.ndarray, "n 2"]
    views: Int[np.ndarray, "n"]

    @property
    def rms_px(self) -> float:
        """Root of the mean squared distance."""
        return bundles.rms(self.off_px)


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Corners that the first two cameras both see: `level_px` (x, row) in the rectified left image, how far the right one's row
    lies below it, how far the undistorted right corner lies from its epipolar line, and the view of each."""

    level_px: Float[np.ndarray, "n 2"]
    down_px: Float[np.ndarray, "n"]
    epipolar_px: Float[np.ndarray, "n"]
    views: Int[np.ndarray, "n"]

    @property
    def error_px(self) -> float:
        """Median of the absolute differences of rows: what `Quality.row_error_px` is."""
        return float(np.median(np.abs(self.down_px)))


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """Everything a calibration can be judged by, and what was not used, by file names. `fitted`: all unknowns fitted again
    from the rig on: its covariance is the rig's, and where it differs from the rig, the rig was made of other images."""

    misses: tuple[Misses, ...]
    rows: Rows
    boards: dict[int, Transform]
    fitted: Bundle
    coverage: Coverage
    rejected: dict[str, str]

    @property
    def rms_px(self) -> float:
        """Over all cameras and corners."""
        return bundles.rms(np.concatenate([own.off_px for own in self.misses]))

    def per_view_px(self) -> dict[int, tuple[float, ...]]:
        """Number of the view -> rms of each camera's image (NaN: not seen)."""
        return {view: tuple(bundles.rms(own.off_px[own.views == view]) if (own.views == view).any() else float("nan")
                            for own in self.misses) for view in self.boards}


def of(rig: Rig, views: Views, board: Board) -> Residuals:
    """The rig held, each board placed where it fits best. Raises InputError for images of another rig, and too few views."""
    if views.image_size_px != rig.image_size_px:
        raise InputError(f"the images have {views.image_size_px[0]}x{views.image_size_px[1]} px, the rig file is for "
                         f"{rig.image_size_px[0]}x{rig.image_size_px[1]}")
    rejected = views.rejected | (rig.quality.rejected if rig.quality else {})
    used = [view for view in (without(view, rejected) for view in views.used)
            if np.isfinite(view.corners_px[0]).any() and any(np.isfinite(px).any() for px in view.corners_px[1:])]
    if len(used) < FEWEST_VIEWS:
        raise InputError(f"{len(used)} of the views that the rig was made of show the board, {FEWEST_VIEWS} are needed")
    lenses, steps = [_lens(camera) for camera in rig.cameras], [camera.T_camera_rig for camera in rig.cameras]
    seen = [seen_by(view, camera, board) for view in used for camera in range(len(lenses))
            if np.isfinite(view.corners_px[camera]).any()]
    try:
        start = {s.view: bundles.place(lenses[0], s) for s in seen if s.camera == 0}
        held = bundles.adjust(seen, lenses, steps, start, (), held="rig")
        free = sorted({term for own in lenses for term in np.flatnonzero(own.distortion).tolist()})
        fitted = bundles.adjust(seen, lenses, steps, held.T_rig_board, free)
    except (cv2.error, np.linalg.LinAlgError, ValueError) as error:
        raise InputError("these images do not fit the rig file at all: were they taken with it?") from error
    off = {(s.view, s.camera): -r for s, r in zip(seen, held.residuals_px, strict=True)}
    return Residuals(tuple(_misses(camera, seen, off) for camera in range(len(lenses))), _rows(rig, seen), held.T_rig_board,
                     fitted, _coverage(rig, used), rejected)


def without(view: View, rejected: dict[str, str]) -> View:
    """The view less the images that were rejected: named alone, or beside the first camera's."""
    files = [name.split(", ") for name in rejected]
    out = {camera for camera, name in enumerate(view.names) if name and
           ([name] in files or (camera and [view.names[0], name] in files))}
    return replace(view, corners_px=tuple(np.full_like(px, np.nan) if camera in out else px
                                          for camera, px in enumerate(view.corners_px)))


def _lens(camera: RigCamera) -> Lens:
    terms = np.array(camera.distortion)
    if terms[TERMS:].any():
        raise InputError(f"{camera.name}: its thin prism or tilt terms are not known here")
    K = camera.K_px
    return Lens(np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], terms[:TERMS], np.zeros(max(0, TERMS - len(terms)))]))


def _misses(camera: int, seen: Sequence[Seen], off: dict[tuple[int, int], Float[np.ndarray, "_ 2"]]) -> Misses:
    own = [s for s in seen if s.camera == camera]
    if not own:
        raise InputError("one of the cameras sees no board in these images")
    return Misses(np.concatenate([s.px for s in own]), np.concatenate([off[s.view, camera] for s in own]),
                  np.repeat([s.view for s in own], [len(s.px) for s in own]))


def rectification(rig: Rig) -> tuple[np.ndarray, ...]:
    """R1, R2, P1, P2 and Q of the first two cameras: OpenCV's, with zero disparity at infinity, as the service rectifies."""
    left, right = rig.cameras[:2]
    T = right.T_camera_rig
    found: tuple[np.ndarray, ...] = cv2.stereoRectify(
        left.K_px, left.distortion_coefficients, right.K_px, right.distortion_coefficients, rig.image_size_px, T[:3, :3],
        T[:3, 3], flags=cv2.CALIB_ZERO_DISPARITY, alpha=-1)
    return found[:5]


def _rows(rig: Rig, seen: Sequence[Seen]) -> Rows:
    left, right = rig.cameras[:2]
    R1, R2, P1, P2, _ = rectification(rig)
    F = epipolar.fundamental(epipolar.essential(right.T_camera_rig), left.K_px, right.K_px)
    level, down, away, numbers = [], [], [], []
    by_view = {(s.view, s.camera): s for s in seen}
    for view in sorted({s.view for s in seen if (s.view, 1) in by_view}):
        one, other = by_view[view, 0], by_view[view, 1]
        here, there = _shared(one, other)
        px, partner = one.px[here], other.px[there]
        flat = [cv2.undistortPoints(p, c.K_px, c.distortion_coefficients, R=R, P=P)[:, 0]
                for p, c, R, P in ((px, left, R1, P1), (partner, right, R2, P2))]
        plain = [cv2.undistortPoints(p, c.K_px, c.distortion_coefficients, P=c.K_px)[:, 0]
                 for p, c in ((px, left), (partner, right))]
        level.append(flat[0])
        down.append(flat[1][:, 1] - flat[0][:, 1])
        away.append(epipolar.distances(F, *plain))
        numbers += [view] * len(px)
    if not level:
        raise InputError("the first two cameras never see the board at once in these images")
    return Rows(np.concatenate(level), np.concatenate(down), np.concatenate(away), np.array(numbers))


def _shared(one: Seen, other: Seen) -> tuple[list[int], list[int]]:
    """Places of the corners that both see."""
    there = {tuple(point): place for place, point in enumerate(other.points_m.tolist())}
    both = [(place, there[tuple(point)]) for place, point in enumerate(one.points_m.tolist()) if tuple(point) in there]
    return [here for here, _ in both], [place for _, place in both]


def _coverage(rig: Rig, used: Sequence[View]) -> Coverage:
    covered = Coverage(tuple(camera.name for camera in rig.cameras))
    for view in used:
        there = [found if np.isfinite(px).any() else None for found, px in zip(view.seen, view.corners_px, strict=False)]
        if there:
            covered = covered.add(there)
    return covered


def distances_m(boards: dict[int, Transform], board: Board) -> dict[int, float]:
    """How far along the first camera's axis the board's middle was in each view."""
    middle = board.points_m.mean(0).astype(float)[None]
    return {view: float(geometry.transform(T, middle)[0, 2]) for view, T in boards.items()}
