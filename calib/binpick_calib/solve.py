"""The solution: all cameras and the steps between them, from the views that agree; the others are named with the reason."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from binpick import geometry
from binpick.errors import InputError
from binpick.rig import Quality, Rig, RigCamera
from binpick.rigcheck.board import Board
from binpick_calib import bundle as bundles
from binpick_calib import consensus, lens, plausible, reasons
from binpick_calib.bundle import Bundle, Seen
from binpick_calib.consensus import Agreement, Both
from binpick_calib.views import FEWEST_VIEWS, View, Views, sides

AGREEING = 0.6
"""Of the views that show both cameras the right way round: with fewer, nobody can say which are right."""
EXCHANGED = 0.7
"""Of all views: as many show the second camera on the left only if the two sides were given the wrong way round."""
TERMS = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


@dataclass(frozen=True, slots=True)
class Solution:
    """The rig, and how each view fits it: number of the view -> residual rms of each camera's image, px (NaN: not seen)."""

    rig: Rig
    quality: Quality
    per_view_px: dict[int, tuple[float, ...]]


def solve(views: Views, board: Board, created: str) -> Solution:
    """Judges the views, chooses the distortion model, then fits everything together.

    Raises InputError when the views contradict each other, do not determine the cameras, or make a rig that cannot be.
    """
    try:
        return _solve(views, board, created)
    except (cv2.error, np.linalg.LinAlgError, ValueError, OverflowError) as error:
        raise InputError("the views do not determine the cameras: tilt the board more, every way, and fill the image with it "
                         f"({type(error).__name__})") from error


def _solve(views: Views, board: Board, created: str) -> Solution:
    kept, rejected = _judged(views, board)
    by_camera = [[s for s in kept if s.camera == camera] for camera in range(len(views.used[0].corners_px))]
    guesses = [bundles.lens_of(seen, views.image_size_px) for seen in by_camera]
    model, lenses = lens.choose(by_camera, guesses, views.image_size_px)
    boards = {s.view: bundles.place(lenses[0], s) for s in by_camera[0]}
    steps = [np.eye(4), *(_step(boards, seen, own) for seen, own in zip(by_camera[1:], lenses[1:], strict=True))]
    fitted = bundles.adjust(kept, lenses, steps, boards, lens.MODELS[model])
    solution = _solution(fitted, kept, model, views, rejected, str(board), created)
    wrong = plausible.faults(solution.rig)
    if wrong:
        raise InputError(". ".join(wrong))
    return solution


def _step(boards: dict[int, geometry.Transform], seen: Sequence[Seen], own: bundles.Lens) -> geometry.Transform:
    """A first guess: the view in the middle of all, by position."""
    each = [bundles.place(own, s) @ geometry.inverse(boards[s.view]) for s in seen]
    places = np.array([T[:3, 3] for T in each])
    middle: geometry.Transform = each[int(np.argmin(np.linalg.norm(places - np.median(places, axis=0), axis=1)))]
    return middle


def seen_by(view: View, camera: int, board: Board) -> Seen:
    """A view's corners that the camera saw."""
    px = view.corners_px[camera]
    there = np.isfinite(px).all(axis=1)
    return Seen(view.number, camera, board.points_m[there].astype(float), px[there].astype(float))


def _judged(views: Views, board: Board) -> tuple[list[Seen], dict[str, str]]:
    """All corners of the views that agree, camera by camera against the first, and the reasons of the others."""
    rejected = dict(views.rejected)
    kept: dict[tuple[int, int], Seen] = {}
    names = sides(len(views.used[0].corners_px))
    for camera in range(1, len(names)):
        pairs = [Both(seen_by(v, 0, board), seen_by(v, camera, board)._replace(camera=1)) for v in views.used
                 if np.isfinite(v.corners_px[camera]).any()]
        files = {v.number: f"{v.names[0]}, {v.names[camera]}" for v in views.used}
        if len(pairs) < FEWEST_VIEWS:
            raise InputError(f"left and {names[camera]} both see the board in {len(pairs)} views, {FEWEST_VIEWS} are needed")
        forward = pairs if camera > 1 else _right_way_round(pairs, views.image_size_px)
        found = consensus.agree(forward, views.image_size_px)
        off = {p.first.view: reasons.reason(p, pairs, found, views.image_size_px[0])
               for p in pairs if p.first.view not in found.agreeing}
        _consistent(forward, found, {files[number]: why for number, why in off.items()}, names[camera])
        rejected |= {files[number]: why for number, why in off.items()}
        for p in pairs:
            if p.first.view in found.agreeing:
                kept[p.first.view, 0] = p.first
                kept[p.first.view, camera] = p.second._replace(camera=camera)
    return [kept[key] for key in sorted(kept)], rejected


def _right_way_round(pairs: Sequence[Both], image_size_px: tuple[int, int]) -> list[Both]:
    """The views whose second camera stands to the right of the first. Raises InputError when the sides are exchanged."""
    lenses = [bundles.lens_of([p[camera] for p in pairs], image_size_px) for camera in (0, 1)]
    places = {view: geometry.inverse(T)[:3, 3] for view, T in consensus.steps(pairs, (lenses[0], lenses[1])).items()}
    across, down, _ = np.median(np.abs(list(places.values())), axis=0)
    if down > across:
        return list(pairs)
    forward = [p for p in pairs if places[p.first.view][0] > 0]
    backward = len(pairs) - len(forward)
    if backward >= EXCHANGED * len(pairs):
        raise InputError(f"in {backward} of {len(pairs)} views the right camera stands to the left of the left one: "
                         "exchange --left and --right (or the images are mirrored)")
    return forward


def _consistent(pairs: Sequence[Both], found: Agreement, off: dict[str, str], name: str) -> None:
    """Raises InputError when too few views agree, or when others agree among themselves on something else."""
    others = [p for p in pairs if p.first.view not in found.agreeing]
    told = "; ".join(f"{files}: {why}" for files, why in off.items())
    if len(found.agreeing) < max(FEWEST_VIEWS, AGREEING * len(pairs)):
        raise InputError(f"no consistent solution: only {len(found.agreeing)} of {len(pairs)} views agree on where {name} "
                         f"stands from left, {FEWEST_VIEWS} and most are needed; these disagree: {told}")
    if len(others) < 3:
        return
    off_px = consensus.crosswise_px(others, found.lenses, consensus.steps(others, found.lenses))
    best = off_px[int(np.argmax((off_px < 3 * found.limit_px).sum(axis=1)))] < 3 * found.limit_px
    if best.sum() >= 3:
        group = ", ".join(str(p.first.view) for p, also in zip(others, best, strict=True) if also)
        first = ", ".join(map(str, found.agreeing))
        raise InputError(f"no consistent solution: views {first} agree, and views {group} agree on another step: "
                         f"a camera was moved in between; take all views again ({told})")


def _solution(fitted: Bundle, kept: Sequence[Seen], model: str, views: Views, rejected: dict[str, str], board: str,
              created: str) -> Solution:
    names = sides(len(fitted.lenses))
    misfit = {(s.view, s.camera): r for s, r in zip(kept, fitted.residuals_px, strict=True)}
    numbers = sorted({s.view for s in kept})
    per_view = {n: tuple(bundles.rms(misfit[n, c]) if (n, c) in misfit else float("nan") for c in range(len(names)))
                for n in numbers}
    whole = {n: bundles.rms(np.concatenate([r for (view, _), r in misfit.items() if view == n])) for n in numbers}
    cameras = tuple(_camera(*each) for each in zip(names, fitted.lenses, fitted.T_cam_rig, strict=True))
    quality = Quality(
        rms_px=fitted.rms_px, row_error_px=_row_error_px(kept, fitted, views.image_size_px), rejected=rejected,
        per_view_px={str(n): px for n, px in whole.items()}, distortion_model=model, sigma=_sigma(fitted, names, model))
    rig = Rig(image_size_px=views.image_size_px, cameras=cameras, quality=quality, board=board, created=created)
    return Solution(rig, quality, per_view)


def _sigma(fitted: Bundle, names: Sequence[str], model: str) -> dict[str, float]:
    """The deviations by name; for the step of a camera its distance (along it) and its turn (all axes together)."""
    assert fitted.covariance is not None
    unknowns = np.eye(len(fitted.covariance.scatter))
    spread, told = fitted.covariance.deviations(unknowns), {}
    for camera, name in enumerate(names):
        for i in (0, 1, 2, 3, *(bundles.PINHOLE + term for term in lens.MODELS[model])):
            told[f"{name}.{TERMS[i]}"] = float(spread[12 * camera + i])
    for number, (name, T) in enumerate(zip(names[1:], fitted.T_cam_rig[1:], strict=True)):
        turn = 12 * len(names) + 6 * number
        along = T[:3, 3] / np.linalg.norm(T[:3, 3]) @ unknowns[turn + 3:turn + 6]
        told[f"{name}.distance_m"] = float(fitted.covariance.deviations(along[None])[0])
        told[f"{name}.turn_rad"] = float(np.linalg.norm(spread[turn:turn + 3]))
    # products of large matrices end differently in their last digits where BLAS has more threads
    return {key: float(f"{deviation:.6g}") for key, deviation in told.items()}


def _row_error_px(kept: Sequence[Seen], fitted: Bundle, image_size_px: tuple[int, int]) -> float:
    """Median row difference of a corner of the first two cameras after rectification: what the matcher will suffer from."""
    left, right = fitted.lenses[:2]
    T = fitted.T_cam_rig[1]
    R1, R2, P1, P2, *_ = cv2.stereoRectify(left.K, left.distortion, right.K, right.distortion, image_size_px,
                                           T[:3, :3], T[:3, 3])
    rows: list[dict[tuple[int, float, float], float]] = []
    for camera, own, R, P in ((0, left, R1, P1), (1, right, R2, P2)):
        rows.append({})
        for s in (s for s in kept if s.camera == camera):
            level = cv2.undistortPoints(s.px, own.K, own.distortion, R=R, P=P)[:, 0, 1]
            rows[-1] |= {(s.view, *point[:2]): row for point, row in zip(s.points_m.tolist(), level.tolist(), strict=True)}
    return float(np.median([abs(row - rows[1][key]) for key, row in rows[0].items() if key in rows[1]]))


def _camera(name: str, own: bundles.Lens, T_cam_rig: geometry.Transform) -> RigCamera:
    distortion = own.distortion if own.distortion[5:].any() else own.distortion[:5]
    return RigCamera.model_validate({"name": name, "K": own.K.tolist(), "distortion": distortion.tolist(),
                                     "T_cam_rig": T_cam_rig.tolist()})
