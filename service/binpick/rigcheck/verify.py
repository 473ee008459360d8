"""Verification: whether a rig file still holds, by one look at a board: rows, flatness, scale, pose."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float

from binpick import geometry
from binpick.errors import InputError
from binpick.geometry import Transform, rectification, triangulation
from binpick.rig import Rig
from binpick.rigcheck import gauge, sight
from binpick.rigcheck.detection import Detection, Refusal
from binpick.rigcheck.rows import Rows
from binpick.rigcheck.verdict import LIMITS, Limits, Verdict, judged

MOST_PX = 40.0
"""Rows further apart are no drift: such images are not of one moment, or not of these two cameras."""


def verify(detections: Sequence[Detection | None], rig: Rig, expected: Transform | None = None,
           limits: Limits = LIMITS) -> Verdict:
    """The verdict by a board, anywhere in the view of the rig's first two cameras.

    `expected` is T_rig_board as it was, for a board that stands where it stood. Raises InputError when the cameras do not both
    see the board, the images are of another size than the rig's, or cannot be a pair of it.
    """
    left, right = _pair(detections, rig)
    rays = _rays(left, right, rig)
    rows = _rows(*rays)
    places = _places(*rays)
    if np.median(places[:, 2]) <= 0:
        raise InputError("the board would lie behind the cameras: left and right are exchanged")
    if abs(rows.row_px) > MOST_PX:
        raise InputError(f"the rows of the two images are {abs(rows.row_px):.0f} px apart: they are not of one moment, or not "
                         "of this rig's cameras")
    scale, T_rect_board, sigma_permille = _similar(left.points_m, places)
    T_rig_board = _rig_rect(rig) @ T_rect_board
    seen = Verdict(str(left.board), len(places), float(np.linalg.norm(places.mean(0))), rows,
                   scale_permille=1000 * (scale - 1), sigma_permille=sigma_permille,
                   pose=tuple(tuple(map(float, row)) for row in T_rig_board))
    planarity_m, bend_m, sigma_bend_m = gauge.bend(places)
    seen = replace(seen, planarity_m=planarity_m, bend_m=bend_m, sigma_bend_m=sigma_bend_m)
    if expected is not None:
        offset_m, offset_rad = _offset(T_rig_board, expected, left)
        seen = replace(seen, offset_m=offset_m, offset_rad=offset_rad)
    return judged(seen, limits)


@dataclass(frozen=True, slots=True, eq=False)
class _Rays:
    """A camera's rays (x/z, y/z) in its rectified frame, with the pair's focal length, px, and baseline, m."""

    rays: Float[np.ndarray, "n 2"]
    focal_px: float
    baseline_m: float


def _pair(detections: Sequence[Detection | None], rig: Rig) -> tuple[Detection, Detection]:
    blind = [camera.name for camera, found in zip(rig.cameras, detections[:2], strict=False) if found is None]
    left, right = detections[:2]
    if left is None or right is None:
        raise InputError(f"the board is not seen by: {', '.join(blind)}")
    for found in (left, right):
        if found.image_size_px != rig.image_size_px:
            raise InputError(f"images of {found.image_size_px[0]}x{found.image_size_px[1]} px, but the rig was calibrated at "
                             f"{rig.image_size_px[0]}x{rig.image_size_px[1]}")
    both = sight.pair(left, right)
    if isinstance(both, Refusal):
        raise InputError(both.reason)
    return both


def _turns(rig: Rig) -> rectification.Rectification:
    left, right = rig.cameras[:2]
    return rectification.opencv(left.K_px, right.K_px, right.T_camera_rig, rig.image_size_px)


def _rig_rect(rig: Rig) -> Transform:
    return geometry.make(_turns(rig).R_left.T, np.zeros(3))


def _rays(left: Detection, right: Detection, rig: Rig) -> tuple[_Rays, _Rays]:
    turns = _turns(rig)
    focal_px = float(np.mean([np.diag(camera.K_px)[:2] for camera in rig.cameras[:2]]))
    baseline_m = float(np.linalg.norm(rig.cameras[1].T_camera_rig[:3, 3]))
    seen = (cv2.undistortPoints(found.corners_px.astype(float), camera.K_px, camera.distortion_coefficients, R=R)[:, 0]
            for found, camera, R in zip((left, right), rig.cameras, (turns.R_left, turns.R_right), strict=False))
    first, second = (_Rays(rays, focal_px, baseline_m) for rays in seen)
    return first, second


def _rows(left: _Rays, right: _Rays) -> Rows:
    """The right camera's turn about x by a small angle lifts its rows by f (1 + y²) times that; about z by −f x times."""
    off_px = left.focal_px * (right.rays[:, 1] - left.rays[:, 1])
    x, y = right.rays.T
    slopes = left.focal_px * np.column_stack([1 + y**2, -x])
    (pitch, roll), _, _, _ = np.linalg.lstsq(slopes, off_px, rcond=None)
    explained = slopes @ [pitch, roll]
    sigma_px = float(np.sqrt(np.sum((off_px - explained)**2) / (len(off_px) - 2)))
    sigmas = sigma_px * np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))
    return Rows(row_px=float(np.median(off_px)), sigma_px=sigma_px / float(np.sqrt(len(off_px))), points=len(off_px),
                off_px=float(np.sqrt(np.mean(explained**2))), pitch_rad=float(pitch), roll_rad=float(roll),
                sigma_pitch_rad=float(sigmas[0]), sigma_roll_rad=float(sigmas[1]))


def _places(left: _Rays, right: _Rays) -> Float[np.ndarray, "n 3"]:
    """The points in the rectified left frame, metres; rows that differ are met half way."""
    P_left, P_right = np.eye(3, 4), np.eye(3, 4)
    P_right[0, 3] = -left.baseline_m
    return triangulation.triangulate(P_left, P_right, left.rays, right.rays)


def _similar(points_m: Float[np.ndarray, "n 3"], places: Float[np.ndarray, "n 3"]) -> tuple[float, Transform, float]:
    """The scale, the pose and the sigma of the scale, per mille, that lay the board's points onto those seen (Umeyama 1991)."""
    found, scale = cv2.estimateAffine3D(points_m.astype(float), places, force_rotation=True)
    T = geometry.make(found[:, :3], found[:, 3])
    off = geometry.transform(T, points_m.astype(float) * scale) - places
    # distances across the line of sight tell the scale; along it the scatter is ten times as large, and tells little
    across = off - np.outer(off @ places.mean(0), places.mean(0)) / (places.mean(0) @ places.mean(0))
    spread = points_m - points_m.mean(0)
    sigma = np.sqrt((across**2).sum() / max(1, len(off) - 2) / (spread**2).sum())
    # the pose is that of the real board: its middle is where it was seen
    T[:3, 3] = places.mean(0) - T[:3, :3] @ points_m.mean(0)
    return float(scale), T, float(1000 * sigma)


def _offset(T_rig_board: Transform, expected: Transform, left: Detection) -> tuple[float, float]:
    """Of the board's middle, m, and angle; a board that looks the same after a turn lies the way that is nearer."""
    points = left.board.points_m.astype(float)
    numberings = [np.arange(len(points), dtype=np.int32), *left.board.turns]
    turned = [_similar(points[ids], geometry.transform(T_rig_board, points))[1] for ids in numberings]
    angles = [float(np.linalg.norm(cv2.Rodrigues(expected[:3, :3].T @ T[:3, :3])[0])) for T in turned]
    nearest = int(np.argmin(angles))
    middle = points.mean(0)
    way = geometry.transform(turned[nearest], middle) - geometry.transform(expected, middle)
    return float(np.linalg.norm(way)), angles[nearest]
