"""Where the bin really stands: its model is fitted to the measured tops of its walls, near where it is expected.

Stereo sees a rim parallel to the baseline badly and the walls that face the cameras well. So every measured point near the
rim's height counts, on the rim's top or on the upper end of a wall, and each side is judged by how much of it was seen.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int
from scipy.spatial.transform import Rotation

from binpick import geometry
from binpick.data import Cloud
from binpick.errors import Code
from binpick.geometry import Transform, Vector
from binpick.settings import Bin

SHIFT_M, HEIGHT_M, YAW_RAD, TILT_RAD = 0.030, 0.010, np.radians(10.0), np.radians(3.0)
"""How far a bin may stand from where it is expected: along both of its sides, up or down, about z, and about x and y."""
SLACK = 1.18
"""What is refused lies this much beyond: 30 mm along both sides turned by 10° are 35 mm along one."""
BAND_M = 0.040
"""Points this far above or below the expected rim may show it: a tilted bin's rim is 30 mm off in a corner."""
SKIRT_M = 0.030
"""How much of the walls, from the rim down, takes part: further down walls may be sloped, ribbed, or hidden by parts."""
LIP_M = 0.003
"""Points less than this below the rim may belong to its top as well as to a wall."""
CELL_M = 0.004
YAW_STEP_RAD = np.radians(1.0)
GATES_M = (0.012, 0.009, 0.006, 0.004, 0.003, 0.003, 0.003, 0.003)
"""Of the steps of the fit: points further from the model than this do not count."""
FIT_POINTS = 400
"""Points of one side's top or wall that take part in the fit."""
WITHIN_M = 0.003
"""A point this near the model's rim shows it."""
SEGMENT_M = 0.010
"""A side is seen as far as its stretches of this length show at least two points."""
LEAST_SEEN = 0.30
"""A side of which less is seen is not there."""
FLOOR_WITHIN_M = 0.006
"""A floor further from the model's is another bin's."""

WALL_ROOM_M = 0.015
"""Points this near a wall do not tell the floor."""
FLOOR_STEP = 16
"""One point in so many tells the floor."""
SIDES = ("-x", "+x", "-y", "+y")

Points = Float32[np.ndarray, "n 3"]
Seen = tuple[float, float, float, float]
Index = Int[np.ndarray, "n"]


@dataclass(frozen=True, slots=True, eq=False)
class Rim:
    """A bin's rim as measured: where the bin stands, and how good the evidence is.

    `seen` are the shares of the sides at −x, +x, −y, +y that lie where the model has them; `rms_m` is how far their points
    are off. `fault` is None when this is the bin of the model, within the tolerances; else `message` says what is wrong.
    """

    T_expected_bin: Transform
    seen: Seen
    rms_m: float
    fault: Code | None = None
    message: str = ""


def tolerated_box(low: Vector, high: Vector) -> tuple[Vector, Vector]:
    """The box, in the expected bin's frame, that holds a box of the bin's own frame wherever the bin may stand."""
    corners = geometry.box_corners(low, high)
    turned = np.concatenate([geometry.rotate(geometry.make(_turn(yaw, about_x, about_y), np.zeros(3)), corners)
                             for yaw, about_x, about_y in product((-YAW_RAD, 0.0, YAW_RAD), *[(-TILT_RAD, TILT_RAD)] * 2)])
    shift = np.array([SHIFT_M, SHIFT_M, HEIGHT_M])
    return turned.min(axis=0) - shift, turned.max(axis=0) + shift


def locate(xyz_camera: Cloud, model: Bin, T_camera_expected: Transform) -> Rim:
    """Finds the bin in a cloud (frame `camera`, NaN = not measured) near its expected pose."""
    T_expected_camera = geometry.inverse(T_camera_expected)
    cloud = np.ascontiguousarray(xyz_camera[::2, ::2]).reshape(-1, 3)
    height = cv2.transform(cloud.reshape(-1, 1, 3), T_expected_camera[2:3]).ravel()
    points = geometry.transform(T_expected_camera, cloud[np.abs(height - np.float32(model.inner_size_m[2])) < BAND_M])
    best: tuple[Transform, Seen, float] = (np.eye(4), (0.0, 0.0, 0.0, 0.0), 0.0)
    for start in _starts(points, model):
        T_expected_bin = _fit(points, model, start)
        seen, rms_m = _judged(points, model, T_expected_bin)
        if sum(seen) > sum(best[1]):
            best = T_expected_bin, seen, rms_m
        if min(seen) >= LEAST_SEEN:
            break
    T_expected_bin, seen, rms_m = best
    fault, message = _fault(points, model, T_expected_bin, seen)
    if fault is None:
        message = _floor_fault(cloud[::FLOOR_STEP], model, geometry.inverse(T_expected_bin) @ T_expected_camera)
        fault = Code.BIN_MISMATCH if message else None
    return Rim(T_expected_bin, seen, rms_m, fault, message)


def _turn(yaw_rad: float, about_x_rad: float, about_y_rad: float) -> Float64[np.ndarray, "3 3"]:
    tilt = Rotation.from_rotvec([about_x_rad, about_y_rad, 0.0])
    return np.asarray((Rotation.from_euler("z", yaw_rad) * tilt).as_matrix())


def _starts(points: Points, model: Bin) -> Iterator[Transform]:
    """Poses to start the fit from, best first: the yaw and shift at which most of the model's outline is occupied, seen from above.

    For each yaw the occupied cells are counted along both axes; two opposite sides are two counts at a known distance.
    """
    length, width, _ = model.inner_size_m
    cells = np.unique(np.floor(points[:, :2] / np.float32(CELL_M)).astype(np.int32) @ np.array([1 << 12, 1], dtype=np.int32))
    row = ((cells + (1 << 11)) >> 12)
    x, y = (row + 0.5) * CELL_M, (cells - (row << 12) + 0.5) * CELL_M
    votes = []
    for yaw in np.arange(-YAW_RAD - 2 * YAW_STEP_RAD, YAW_RAD + 2.5 * YAW_STEP_RAD, YAW_STEP_RAD):
        along_x, along_y = x * np.cos(yaw) + y * np.sin(yaw), y * np.cos(yaw) - x * np.sin(yaw)
        vote_x, dx = _pair(along_x[np.abs(along_y) < width / 2 + SHIFT_M], length, width, model.wall_m)
        vote_y, dy = _pair(along_y[np.abs(along_x) < length / 2 + SHIFT_M], width, length, model.wall_m)
        votes.append((vote_x + vote_y, float(yaw), dx, dy))
    for _, yaw, dx, dy in sorted(votes, reverse=True)[:3]:
        yield _raised(points, model, yaw, np.array([dx, dy]))


def _pair(across: Float64[np.ndarray, "n"], apart_m: float, side_m: float, wall_m: float) -> tuple[float, float]:
    """Where two parallel sides stand best on cells counted across them: the vote, and the middle's shift."""
    reach = int(np.ceil((SLACK * SHIFT_M + BAND_M / 4) / CELL_M))
    half = round((apart_m + wall_m) / 2 / CELL_M)
    middle = half + reach + 2
    index = np.floor(across / CELL_M).astype(np.int64) + middle
    counts = np.bincount(index[(index >= 0) & (index < 2 * middle)], minlength=2 * middle)
    # a full line is one cell in each of side / cell rows; lines between two columns count in both
    share = np.sqrt(np.convolve(np.minimum(counts * (CELL_M / side_m), 1.0), [0.5, 1.0, 0.5], "same"))
    shifts = np.arange(-reach, reach + 1)
    votes = share[middle + shifts - half - 1] + share[middle + shifts + half]
    best = int(np.argmax(votes))
    return float(votes[best]), float(shifts[best] * CELL_M)


def _raised(points: Points, model: Bin, yaw: float, shift: Float64[np.ndarray, "2"]) -> Transform:
    """T_expected_bin of a yaw and a shift: height and tilt from the highest points along each side."""
    length, width, height = model.inner_size_m
    flat = geometry.make(_turn(yaw, 0.0, 0.0), np.array([*shift @ _turn(-yaw, 0.0, 0.0)[:2, :2], 0.0]))
    q = geometry.transform(geometry.inverse(flat), points)
    outward, side, _ = _places(q, model)
    near = np.abs(outward - model.wall_m / 2) < model.wall_m / 2 + 2 * CELL_M
    rows, levels = [[0.0, 0.05, 0.0], [0.0, 0.0, 0.05]], [0.0, 0.0]     # level where nothing tells
    for k, (at_x, at_y) in enumerate(((-length / 2, 0.0), (length / 2, 0.0), (0.0, -width / 2), (0.0, width / 2))):
        z = q[near & (side == k), 2]
        if len(z) >= FIT_POINTS / 10:
            rows.append([1.0, at_x, at_y])
            levels.append(float(_crest(z)) - height)
    lift, slope_x, slope_y = np.linalg.lstsq(np.array(rows), np.array(levels), rcond=None)[0]
    R = flat[:3, :3] @ _turn(0.0, float(np.arctan(slope_y)), float(-np.arctan(slope_x)))
    up = np.array([0.0, 0.0, height])
    return geometry.make(R, flat[:3, 3] + up + [0.0, 0.0, lift] - R @ up)


def _crest(z: Float32[np.ndarray, "n"]) -> np.floating:
    """The height of a rim's top among points of its wall: nine in ten lie below, parts that lean over it aside."""
    return np.quantile(z, 0.9)


def _places(q: Points, model: Bin) -> tuple[Float32[np.ndarray, "n"], Index, Float32[np.ndarray, "n"]]:
    """Of points in the bin's frame: how far beyond the nearest wall's inner face, which side's (0 to 3), and how far along it."""
    length, width, _ = model.inner_size_m
    beyond_x, beyond_y = np.abs(q[:, 0]) - np.float32(length / 2), np.abs(q[:, 1]) - np.float32(width / 2)
    of_x = beyond_x > beyond_y
    outward = np.where(of_x, beyond_x, beyond_y)
    side = np.where(of_x, np.where(q[:, 0] > 0, 1, 0), np.where(q[:, 1] > 0, 3, 2))
    return outward, side, np.where(of_x, q[:, 1], q[:, 0])


@dataclass(frozen=True, slots=True, eq=False)
class _Offsets:
    """Signed distances of points to the model's rim: to its top, else to the nearer face of the wall below."""

    distance: Float32[np.ndarray, "n"]
    on_top: Bool[np.ndarray, "n"]
    side: Index
    along: Float32[np.ndarray, "n"]

    @classmethod
    def of(cls, q: Points, model: Bin) -> "_Offsets":
        outward, side, along = _places(q, model)
        wall_m, above = np.float32(model.wall_m), q[:, 2] - np.float32(model.inner_size_m[2])
        below = above < -LIP_M
        on_top = ~below & (outward >= 0) & (outward <= wall_m)
        # near the top's own height a point beside it tells where the edge is not
        beside = np.where(~below & (outward > wall_m), outward - wall_m, outward)
        distance = np.where(on_top, above, np.where(above > -SKIRT_M, beside, np.float32(np.inf)))
        distance = np.where(above > GATES_M[0], np.float32(np.inf), distance)
        return cls(distance, on_top, side, along)


def _fit(points: Points, model: Bin, T_expected_bin: Transform) -> Transform:
    """The pose that brings the points nearest to the model, by Gauss-Newton with Tukey's weights."""
    points = _fair(points, model, T_expected_bin)
    axis = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    outwards = axis * np.array([[-1.0], [1.0], [-1.0], [1.0]])
    for gate in GATES_M:
        q = geometry.transform(geometry.inverse(T_expected_bin), points)
        offsets = _Offsets.of(q, model)
        near = np.flatnonzero(np.abs(offsets.distance) < gate)
        r, side = offsets.distance[near].astype(float), offsets.side[near]
        normal = np.where(offsets.on_top[near, None], [0.0, 0.0, 1.0], outwards[side])
        weight = (1 - (r / gate) ** 2) ** 2
        J = np.concatenate([np.cross(q[near], normal), normal], axis=1)
        H = np.einsum("ni,nj->ij", J * weight[:, None], J)
        # what nothing measures stays as it is; einsum, for BLAS would wake its threads
        H[np.diag_indices(6)] += 1e-3 * np.array([0.1, 0.1, 0.1, 1.0, 1.0, 1.0]) + 1e-6 * np.trace(H)
        step = -np.linalg.solve(H, np.einsum("ni,n->i", J, weight * r))
        moved = geometry.make(Rotation.from_rotvec(step[:3]).as_matrix(), step[3:])
        T_expected_bin = T_expected_bin @ geometry.inverse(moved)
    return T_expected_bin


def _fair(points: Points, model: Bin, T_expected_bin: Transform) -> Points:
    """The points near the model's rim, of each side's top and wall alike many at most: a well-seen wall must not outvote a rim."""
    offsets = _Offsets.of(geometry.transform(geometry.inverse(T_expected_bin), points), model)
    near = np.abs(offsets.distance) < GATES_M[0]
    groups = [np.flatnonzero(near & (offsets.side == side) & (offsets.on_top == top)) for side in range(4) for top in (0, 1)]
    return points[np.concatenate([group[::max(1, len(group) // FIT_POINTS)] for group in groups])]


def _judged(points: Points, model: Bin, T_expected_bin: Transform) -> tuple[Seen, float]:
    """Which share of each side was seen where the model has it, and the rms distance of the points that show it."""
    offsets = _Offsets.of(geometry.transform(geometry.inverse(T_expected_bin), points), model)
    shows = np.abs(offsets.distance) < WITHIN_M
    seen = [float((_stretches(offsets.along[shows & (offsets.side == k)], _side_m(model, k)) >= 2).mean()) for k in range(4)]
    rms_m = float(np.sqrt(np.mean(offsets.distance[shows].astype(float) ** 2))) if shows.any() else 0.0
    return (seen[0], seen[1], seen[2], seen[3]), rms_m


def _side_m(model: Bin, side: int) -> float:
    return model.inner_size_m[1 if side < 2 else 0]


def _stretches(along: Float32[np.ndarray, "n"], side_m: float) -> Int[np.ndarray, "k"]:
    """How many points each stretch of a side has."""
    count = max(1, round(side_m / SEGMENT_M))
    index = np.floor((along / np.float32(side_m) + np.float32(0.5)) * count).astype(np.int64)
    return np.bincount(index[(index >= 0) & (index < count)], minlength=count)


def _fault(points: Points, model: Bin, T_expected_bin: Transform, seen: Seen) -> tuple[Code | None, str]:
    """What speaks against the bin of the model standing there, within the tolerances."""
    there = [share >= LEAST_SEEN for share in seen]
    if sum(there) < 2:
        return Code.BIN_NOT_FOUND, "No rim was seen where the bin is expected: " + _shares(seen)
    if not all(there):
        return Code.BIN_MISMATCH, "The rim is not the model's: " + _shares(seen)
    x, y, z = T_expected_bin[:3, 3]
    tilt = float(np.arccos(np.clip(T_expected_bin[2, 2], -1, 1)))
    yaw = float(np.arctan2(T_expected_bin[1, 0], T_expected_bin[0, 0]))
    if tilt > SLACK * np.sqrt(2) * TILT_RAD:
        return Code.BIN_MISMATCH, f"The bin is tilted by {np.degrees(tilt):.1f} degrees."
    if max(abs(x), abs(y)) > SLACK * SHIFT_M or abs(z) > SLACK * HEIGHT_M + SHIFT_M * TILT_RAD or abs(yaw) > SLACK * YAW_RAD:
        return Code.BIN_NOT_FOUND, (f"A bin stands too far from where it is expected: by {1000 * x:.0f}, {1000 * y:.0f}, "
                                    f"{1000 * z:.0f} mm and {np.degrees(yaw):.1f} degrees.")
    return None, ""


def _shares(seen: Seen) -> str:
    return ", ".join(f"{100 * share:.0f} % at {side}" for side, share in zip(SIDES, seen, strict=True)) + "."


def _floor_fault(xyz_camera: Points, model: Bin, T_bin_camera: Transform) -> str:
    """Whether the lowest that was seen can be the model's floor: nothing lies below it, nor is it another plane above.

    A floor hidden by parts tells nothing; parts alone do not make one plane of more than half of what is seen.
    """
    length, width, height = model.inner_size_m
    q = geometry.transform(T_bin_camera, xyz_camera)
    inside = (np.abs(q[:, 0]) < length / 2 - WALL_ROOM_M) & (np.abs(q[:, 1]) < width / 2 - WALL_ROOM_M)
    z = q[inside, 2]
    if len(z) < FIT_POINTS:
        return ""
    lowest = float(np.quantile(z, 0.03))
    plane = float(np.mean(np.abs(z - lowest) < FLOOR_WITHIN_M)) > 0.5
    if lowest < -FLOOR_WITHIN_M or (plane and FLOOR_WITHIN_M < lowest < height / 5):
        return f"The floor lies {1000 * (height - lowest):.0f} mm below the rim, in the model {1000 * height:.0f} mm."
    return ""
