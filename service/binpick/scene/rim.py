"""The rim of a bin's model and its fit to measured points: Gauss-Newton on distances to the tops and upper ends of the walls.

Stereo sees a rim parallel to the baseline badly and the walls that face the cameras well. So every measured point near the
rim's height counts, on the rim's top or on the wall below it, and each side is judged by how much of it was seen.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int
from scipy.spatial.transform import Rotation

from binpick import geometry
from binpick.geometry import Transform, Vector
from binpick.settings import Bin

SKIRT_M = 0.030
"""How much of the walls, from the rim down, takes part: further down walls may be sloped, ribbed, or hidden by parts."""
LIP_M = 0.003
"""Points less than this below the rim may belong to its top."""
CELL_M = 0.004
"""Edge of the cells in which the search for a start counts points."""
YAW_STEP_RAD = np.radians(1.5)
"""Yaws tried: ends of a side of 0.6 m then are off by less than two cells."""
GATES_M = (0.012, 0.012, 0.012, 0.009, 0.006, 0.004, 0.003, 0.003, 0.003)
"""Of the steps of the fit: points further from the model than this do not count."""
START_BELOW_M = 0.004
"""The fit starts this much lower than the rim seems to be."""
GROUP_POINTS = 150
"""Points of one side's top or wall that take part in the fit."""
WITHIN_M = 0.003
"""A point this near the model's rim shows it."""
BEYOND_M = (0.004, 0.025)
"""So far outside of a rim nothing is as high; where parts of a full bin go on, there is none."""
STRETCH_M = 0.010
"""A side is seen where a stretch of this length shows two points, one of them on top, and at most half as many beyond."""
OUTWARDS = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])

Points = Float32[np.ndarray, "n 3"]
Values = Float32[np.ndarray, "n"]
Index = Int[np.ndarray, "n"]
Shares = Float64[np.ndarray, "4"]


@dataclass(frozen=True, slots=True, eq=False)
class Offsets:
    """Signed distances of points to the rim: from its top's height, else sideways from an edge or wall; inf: above or below.

    `side` is the nearest: 0 to 3 at −x, +x, −y, +y; `along` is the place along it; `beyond`: higher than things stand outside.
    """

    distance: Values
    on_top: Bool[np.ndarray, "n"]
    beyond: Bool[np.ndarray, "n"]
    side: Index
    along: Values


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Shares of the four sides: seen where the model has them, or passed by things as high; the rest was not measured.

    `rms_m` is the distance of the points that show them.
    """

    there: Shares
    passed: Shares
    rms_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Rim:
    """The model's rim: inner size, wall, and how far beyond its inner face the face of each wall lies that the camera sees."""

    size_m: tuple[float, float, float]
    wall_m: float
    face_m: Float32[np.ndarray, "4"]

    @classmethod
    def of(cls, model: Bin, camera: Vector) -> "Rim":
        """As seen from the camera's position in the bin's frame: it sees the outside of a wall that it stands beyond."""
        length, width, _ = model.inner_size_m
        half = np.array([length, length, width, width]) / 2 + model.wall_m
        return cls(model.inner_size_m, model.wall_m, np.where(OUTWARDS @ camera > half, model.wall_m, 0.0).astype(np.float32))

    def offsets(self, q: Points) -> Offsets:
        """Of points in the bin's frame."""
        outward, side, along = self._places(q)
        wall_m, above = np.float32(self.wall_m), q[:, 2] - np.float32(self.size_m[2])
        below = above < -LIP_M
        on_top = ~below & (outward >= 0) & (outward <= wall_m)
        # at the top's own height, what lies beside it tells where its edge is
        beside = outward - np.where(below, self.face_m[side], np.where(outward > wall_m, wall_m, np.float32(0)))
        near = (above > -SKIRT_M) & (above < GATES_M[0])
        beyond = near & (outward > wall_m + BEYOND_M[0]) & (outward < wall_m + BEYOND_M[1])
        return Offsets(np.where(near, np.where(on_top, above, beside), np.float32(np.inf)), on_top, beyond, side, along)

    def starts(self, points: Points, shift_m: float, yaw_rad: float) -> Iterator[Transform]:
        """Poses T_frame_bin to start the fit from, best first: where most of the outline is occupied, seen from above.

        For each yaw the occupied cells are counted across both axes: two opposite sides are two counts at a known distance.
        """
        length, width, _ = self.size_m
        cells = np.unique(np.floor(points[:, :2] / np.float32(CELL_M)).astype(np.int32) @ np.array([1 << 12, 1], np.int32))
        row = (cells + (1 << 11)) >> 12
        x, y = (row + 0.5) * CELL_M, (cells - (row << 12) + 0.5) * CELL_M
        votes = []
        steps = int(np.ceil(yaw_rad / YAW_STEP_RAD)) + 1
        for yaw in np.arange(-steps, steps + 1) * YAW_STEP_RAD:
            across_x, across_y = x * np.cos(yaw) + y * np.sin(yaw), y * np.cos(yaw) - x * np.sin(yaw)
            vote_x, dx = self._pair(across_x[np.abs(across_y) < width / 2 + shift_m], length, width, shift_m)
            vote_y, dy = self._pair(across_y[np.abs(across_x) < length / 2 + shift_m], width, length, shift_m)
            votes.append((vote_x + vote_y, float(yaw), dx, dy))
        for _, yaw, dx, dy in sorted(votes, reverse=True)[:3]:
            yield self._raised(points, yaw, dx, dy)

    def fit(self, points: Points, T_frame_bin: Transform) -> Transform:
        """The pose that brings the points nearest to the rim, with Tukey's weights; what nothing measures stays as it is."""
        points = self._fair(points, T_frame_bin)
        for gate in GATES_M:
            q = geometry.transform(geometry.inverse(T_frame_bin), points)
            offsets = self.offsets(q)
            near = np.flatnonzero(np.abs(offsets.distance) < gate)
            r = offsets.distance[near].astype(float)
            normal = np.where(offsets.on_top[near, None], [0.0, 0.0, 1.0], OUTWARDS[offsets.side[near]])
            weight = (1 - (r / gate) ** 2) ** 2
            slopes = np.concatenate([np.cross(q[near], normal), normal], axis=1)
            H = np.einsum("ni,nj->ij", slopes * weight[:, None], slopes)     # BLAS would wake its threads for it
            H[np.diag_indices(6)] += 1e-3 * np.array([0.1, 0.1, 0.1, 1.0, 1.0, 1.0]) + 1e-6 * np.trace(H)
            step = -np.linalg.solve(H, np.einsum("ni,n->i", slopes, weight * r))
            moved = geometry.make(Rotation.from_rotvec(step[:3]).as_matrix(), step[3:])
            T_frame_bin = T_frame_bin @ geometry.inverse(moved)
        return T_frame_bin

    def seen(self, points: Points, T_frame_bin: Transform) -> Seen:
        """What of the rim was seen there."""
        offsets = self.offsets(geometry.transform(geometry.inverse(T_frame_bin), points))
        shows = np.abs(offsets.distance) < WITHIN_M
        there, passed = np.empty(4), np.empty(4)
        for side in range(4):
            on, top, past = (self._count(offsets, chosen, side) for chosen in (shows, shows & offsets.on_top, offsets.beyond))
            goes_on = (past >= 2) & (2 * past > on)
            there[side], passed[side] = np.mean((on >= 2) & (top >= 1) & ~goes_on), np.mean(goes_on)
        rms_m = float(np.sqrt(np.mean(offsets.distance[shows].astype(float) ** 2))) if shows.any() else 0.0
        return Seen(there, passed, rms_m)

    def _count(self, offsets: Offsets, chosen: Bool[np.ndarray, "n"], side: int) -> Int[np.ndarray, "k"]:
        """How many of the chosen points lie along each stretch of a side."""
        side_m = self.size_m[1 if side < 2 else 0]
        count = max(1, round(side_m / STRETCH_M))
        along = offsets.along[chosen & (offsets.side == side)]
        index = np.floor((along / np.float32(side_m) + np.float32(0.5)) * count).astype(np.int64)
        return np.bincount(index[(index >= 0) & (index < count)], minlength=count)

    def _places(self, q: Points) -> tuple[Values, Index, Values]:
        """How far beyond the nearest wall's inner face points lie, which side's that is, and how far along it."""
        beyond_x, beyond_y = (np.abs(q[:, axis]) - np.float32(self.size_m[axis] / 2) for axis in (0, 1))
        of_x = beyond_x > beyond_y
        side = np.where(of_x, np.where(q[:, 0] > 0, 1, 0), np.where(q[:, 1] > 0, 3, 2))
        return np.where(of_x, beyond_x, beyond_y), side, np.where(of_x, q[:, 1], q[:, 0])

    def _pair(self, across: Float64[np.ndarray, "n"], apart_m: float, side_m: float, shift_m: float) -> tuple[float, float]:
        """Where two parallel sides stand best on cells counted across them: the vote, and the shift of their middle."""
        # turned about the middle a shift is longer along one axis; a tilt brings the rim another centimetre aside
        reach = int(np.ceil((1.2 * shift_m + 0.010) / CELL_M))
        half = round((apart_m + self.wall_m) / 2 / CELL_M)
        middle = half + reach + 2
        index = np.floor(across / CELL_M).astype(np.int64) + middle
        counts = np.bincount(index[(index >= 0) & (index < 2 * middle)], minlength=2 * middle)
        # a full line is one cell in each of side / cell rows; roots: two lines half seen are worth more than one
        share = np.sqrt(np.convolve(np.minimum(counts * (CELL_M / side_m), 1.0), [0.5, 1.0, 0.5], "same"))
        shifts = np.arange(-reach, reach + 1)
        votes = share[middle + shifts - half - 1] + share[middle + shifts + half]
        best = int(np.argmax(votes))
        return float(votes[best]), float(shifts[best] * CELL_M)

    def _raised(self, points: Points, yaw: float, dx: float, dy: float) -> Transform:
        """T_frame_bin of a yaw and a shift (along turned axes): height and tilt from the highest points of each side."""
        length, width, height = self.size_m
        turn = Rotation.from_euler("z", yaw).as_matrix()
        flat = geometry.make(turn, turn @ np.array([dx, dy, 0.0]))
        q = geometry.transform(geometry.inverse(flat), points)
        outward, side, _ = self._places(q)
        near = np.abs(outward - self.wall_m / 2) < self.wall_m / 2 + 2 * CELL_M
        # level where nothing tells otherwise
        rows, levels = [[0.0, 0.05, 0.0], [0.0, 0.0, 0.05]], [0.0, 0.0]
        for k in range(4):
            z = q[near & (side == k), 2]
            if len(z) >= GROUP_POINTS / 5:
                rows.append([1.0, OUTWARDS[k, 0] * length / 2, OUTWARDS[k, 1] * width / 2])
                # of the points of rim and wall nine in ten lie below the top; along a tilted side that is too high, and what
                # lies above the model's top pulls it up, what lies below does not pull it down
                levels.append(float(np.quantile(z, 0.9)) - height - START_BELOW_M)
        lift, slope_x, slope_y = np.linalg.lstsq(np.array(rows), np.array(levels), rcond=None)[0]
        R = turn @ Rotation.from_rotvec([np.arctan(slope_y), -np.arctan(slope_x), 0.0]).as_matrix()
        up = np.array([0.0, 0.0, height])
        return geometry.make(R, flat[:3, 3] + up + np.array([0.0, 0.0, lift]) - R @ up)

    def _fair(self, points: Points, T_frame_bin: Transform) -> Float32[np.ndarray, "m 3"]:
        """The points near the rim, of each side's top and wall alike many at most: a well-seen wall must not outvote a rim."""
        offsets = self.offsets(geometry.transform(geometry.inverse(T_frame_bin), points))
        near = np.abs(offsets.distance) < GATES_M[0]
        groups = [np.flatnonzero(near & (offsets.side == side) & (offsets.on_top == top))
                  for side in range(4) for top in (False, True)]
        chosen = np.concatenate([group[::max(1, len(group) // GROUP_POINTS)] for group in groups])
        return np.asarray(points[chosen])
