"""The bundle: lenses, steps between the cameras and places of the board, fitted together to every corner seen."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import least_squares

from binpick import geometry
from binpick.geometry import Transform
from binpick_calib import covariance
from binpick_calib.covariance import Covariance

STEPS = 40
"""From guesses as good as ours it takes 5 to 15; terms without evidence creep on for thousands."""
Held = Literal["nothing", "lenses", "rig"]
LADDER = 0.5 * np.sqrt(2) ** np.arange(10)
"""Focal lengths of the image's width to begin with: fields of view of 90 to 2.5 degrees."""
PINHOLE = 4
"""fx, fy, cx, cy come before the distortion."""


class Seen(NamedTuple):
    """One camera's corners in one view: where they lie on the board, and in the image."""

    view: int
    camera: int
    points_m: Float[np.ndarray, "n 3"]
    px: Float[np.ndarray, "n 2"]


@dataclass(frozen=True, slots=True, eq=False)
class Lens:
    """fx, fy, cx, cy and OpenCV's k1 k2 p1 p2 k3 k4 k5 k6; terms the model leaves out are 0."""

    values: Float[np.ndarray, "12"]

    @property
    def K(self) -> Float[np.ndarray, "3 3"]:
        """The camera matrix, px."""
        fx, fy, cx, cy = self.values[:PINHOLE]
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])

    @property
    def distortion(self) -> Float[np.ndarray, "8"]:
        """All eight coefficients in OpenCV's order."""
        return self.values[PINHOLE:]


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """What was fitted. `residuals_px` has one row for each corner, in the order of the `Seen`.

    `covariance`: of the lenses, then of (rotation vector, position) of each camera but the first; None when any was held.
    """

    lenses: tuple[Lens, ...]
    T_cam_rig: tuple[Transform, ...]
    T_rig_board: dict[int, Transform]
    residuals_px: tuple[Float[np.ndarray, "_ 2"], ...]
    covariance: Covariance | None = None

    @property
    def rms_px(self) -> float:
        """Root of the mean squared distance between a corner and where it should be."""
        return rms(np.concatenate(self.residuals_px))


def rms(residuals_px: Float[np.ndarray, "n 2"]) -> float:
    """As OpenCV counts it: of the distances, not of their components."""
    return float(np.sqrt((residuals_px**2).sum(axis=1).mean()))


def pose(T: Transform) -> Float[np.ndarray, "6"]:
    """Rotation vector and position."""
    return np.concatenate([cv2.Rodrigues(T[:3, :3])[0][:, 0], T[:3, 3]])


def _transform(six: Float[np.ndarray, "6"]) -> Transform:
    return geometry.make(cv2.Rodrigues(six[:3])[0], six[3:])


def lens_of(seen: Sequence[Seen], image_size_px: tuple[int, int]) -> Lens:
    """A first guess: the focal length by the board's vanishing points or from a ladder, what fits best; no distortion.

    Where the board is tilted little or seen through much distortion, its vanishing points are anywhere: in one of 40 drawn sets
    at 18 times the true focal length, from where the fit does not come back.
    """
    K = cv2.initCameraMatrix2D([s.points_m.astype(np.float32) for s in seen], [s.px.astype(np.float32) for s in seen],
                               image_size_px, 1.0)
    guesses = [Lens(np.array([f, f, K[0, 2], K[1, 2], *np.zeros(8)])) for f in (K[0, 0], *(image_size_px[0] * LADDER))]
    off_px = [rms(np.concatenate([misplaced_px(guess, place(guess, s), s) for s in seen])) for guess in guesses]
    return guesses[int(np.argmin(off_px))]


def misplaced_px(lens: Lens, T_camera_board: Transform, seen: Seen) -> Float[np.ndarray, "n 2"]:
    """Where the lens would see the corners, less where they were seen."""
    six = pose(T_camera_board)
    px = cv2.projectPoints(seen.points_m, six[:3], six[3:], lens.K, lens.distortion)[0][:, 0]
    off: Float[np.ndarray, "n 2"] = px - seen.px
    return off


def place(lens: Lens, seen: Seen) -> Transform:
    """T_camera_board of one image."""
    _, r, t = cv2.solvePnP(seen.points_m, seen.px, lens.K, lens.distortion, flags=cv2.SOLVEPNP_IPPE)
    r, t = cv2.solvePnPRefineLM(seen.points_m, seen.px, lens.K, lens.distortion, r, t)
    return geometry.make(cv2.Rodrigues(r)[0], t[:, 0])


@dataclass(frozen=True, slots=True)
class _Layout:
    """Where each unknown stands in the vector: lenses, steps, then boards."""

    cameras: int
    views: tuple[int, ...]
    free: Int[np.ndarray, "k"]
    held: Held

    def vector(self, lenses: Sequence[Lens], steps: Sequence[Transform],
               boards: dict[int, Transform]) -> Float[np.ndarray, "u"]:
        return np.concatenate([*(lens.values for lens in lenses), *(pose(T) for T in steps[1:]),
                               *(pose(boards[v]) for v in self.views)])

    def lens(self, camera: int) -> slice:
        return slice(12 * camera, 12 * camera + 12)

    def step(self, camera: int) -> slice:
        start = 12 * self.cameras + 6 * (camera - 1)
        return slice(start, start + 6)

    def board(self, view: int) -> slice:
        start = 12 * self.cameras + 6 * (self.cameras - 1) + 6 * self.views.index(view)
        return slice(start, start + 6)

    @property
    def moving(self) -> Int[np.ndarray, "m"]:
        """The unknowns that are fitted."""
        rig = 12 * self.cameras + 6 * (self.cameras - 1)
        boards = np.arange(rig, rig + 6 * len(self.views))
        if self.held == "rig":
            return boards
        if self.held == "lenses":
            return np.arange(12 * self.cameras, boards[-1] + 1)
        lenses = [12 * c + np.concatenate([np.arange(PINHOLE), PINHOLE + self.free]) for c in range(self.cameras)]
        return np.concatenate([*lenses, np.arange(12 * self.cameras, rig), boards]).astype(int)


def _project(unknowns: Float[np.ndarray, "u"], layout: _Layout, seen: Seen,
             slopes: Float[np.ndarray, "n2 u"] | None) -> Float[np.ndarray, "n 2"]:
    """Where one image's corners should be; fills their slopes over all unknowns when asked (OpenCV's own derivatives)."""
    board, lens = unknowns[layout.board(seen.view)], Lens(unknowns[layout.lens(seen.camera)])
    r, t, chain = board[:3], board[3:], None
    if seen.camera:
        step = unknowns[layout.step(seen.camera)]
        r, t, *chain = cv2.composeRT(r, t, step[:3], step[3:])
    px, by = cv2.projectPoints(seen.points_m, r, t, lens.K, lens.distortion)
    if slopes is not None:
        slopes[:, layout.lens(seen.camera)] = by[:, 6:18]
        if chain is None:
            slopes[:, layout.board(seen.view)] = by[:, :6]
        else:
            turn_board, turn_place, turn_step, turn_way, way_board, way_place, way_step, way_way = chain
            slopes[:, layout.board(seen.view)] = by[:, :3] @ np.hstack([turn_board, turn_place]) + \
                by[:, 3:6] @ np.hstack([way_board, way_place])
            slopes[:, layout.step(seen.camera)] = by[:, :3] @ np.hstack([turn_step, turn_way]) + \
                by[:, 3:6] @ np.hstack([way_step, way_way])
    projected: Float[np.ndarray, "n 2"] = px[:, 0]
    return projected


def adjust(seen: Sequence[Seen], lenses: Sequence[Lens], T_cam_rig: Sequence[Transform], T_rig_board: dict[int, Transform],
           free: Sequence[int], held: Held = "nothing") -> Bundle:
    """The least squares over every corner (Levenberg-Marquardt, MINPACK), from a first guess.

    `free`: the distortion terms that are fitted, as places in OpenCV's order; the others become 0.
    Held lenses stay whole; with the rig held only the boards move.
    """
    if held == "nothing":
        kept = np.isin(np.arange(-PINHOLE, 8), [*range(-PINHOLE, 0), *free])
        lenses = [Lens(np.where(kept, lens.values, 0)) for lens in lenses]
    layout = _Layout(len(lenses), tuple(T_rig_board), np.array(free, dtype=int), held)
    start, moving = layout.vector(lenses, T_cam_rig, T_rig_board), layout.moving
    rows = np.cumsum([0, *(2 * len(s.px) for s in seen)])

    def unknowns(x: Float[np.ndarray, "m"]) -> Float[np.ndarray, "u"]:
        full = start.copy()
        full[moving] = x
        return full

    def residuals(x: Float[np.ndarray, "m"]) -> Float[np.ndarray, "r"]:
        full = unknowns(x)
        return np.concatenate([(_project(full, layout, s, None) - s.px).ravel() for s in seen])

    def slopes(x: Float[np.ndarray, "m"]) -> Float[np.ndarray, "r m"]:
        full, filled = unknowns(x), np.zeros((rows[-1], len(start)))
        for s, top, bottom in zip(seen, rows[:-1], rows[1:], strict=True):
            _project(full, layout, s, filled[top:bottom])
        return filled[:, moving]

    found = least_squares(residuals, start[moving], slopes, method="lm", x_scale="jac", max_nfev=STEPS)
    doubt = None
    if held == "nothing":
        of_rig = layout.moving[:len(moving) - 6 * len(layout.views)]
        views = np.repeat([layout.views.index(s.view) for s in seen], np.diff(rows))
        doubt = covariance.of(found.jac, found.fun, views, of_rig, len(start) - 6 * len(layout.views))
    return _unpack(unknowns(found.x), doubt, layout, np.split(found.fun.reshape(-1, 2), rows[1:-1] // 2))


def _unpack(full: Float[np.ndarray, "u"], doubt: Covariance | None, layout: _Layout,
            residuals_px: list[Float[np.ndarray, "_ 2"]]) -> Bundle:
    cameras = range(layout.cameras)
    return Bundle(
        lenses=tuple(Lens(full[layout.lens(c)]) for c in cameras),
        T_cam_rig=(np.eye(4), *(_transform(full[layout.step(c)]) for c in cameras[1:])),
        T_rig_board={v: _transform(full[layout.board(v)]) for v in layout.views},
        residuals_px=tuple(residuals_px), covariance=doubt)
