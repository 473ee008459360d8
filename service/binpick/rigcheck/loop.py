"""The loop of robot, rig and board in closed form: the guess that most samples agree on, from their poses alone.

A rig rides on a mount (flange or base) and the board on its carrier (base or flange): T_carrier_mount T_mount_rig T_rig_board
is the same T_carrier_board in every sample.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, islice, product

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from binpick import geometry
from binpick.geometry import Transform, Vector

Transforms = Sequence[Transform]
Solver = Callable[[Transforms, Transforms], Iterator[Transform]]
"""T_mount_rig by each method, from T_carrier_mount and T_rig_board of samples."""
METHODS = (cv2.CALIB_HAND_EYE_PARK, cv2.CALIB_HAND_EYE_HORAUD, cv2.CALIB_HAND_EYE_DANIILIDIS)
"""They agree within 0.6 mm on ViSP's eight images; Andreff's is off by 8 there, Li's of robot and world by 40. Tsai's, 2 mm
off, prints a line for each set of samples that it cannot solve."""
TRIPLES = 60
"""So many threes of samples are tried; of 30 samples a third may be wrong before none of the threes is right."""
COMBINATIONS = 16
"""So many ways to combine the places in which a three's boards may be seen: all of a board with four ends, tilted one way."""


@dataclass(frozen=True, slots=True, eq=False)
class Guess:
    """T_mount_rig, which place each sample's board was seen in, and how far each lies from the one in their middle, m."""

    T_mount_rig: Transform
    chosen: tuple[int, ...]
    apart_m: Float[np.ndarray, "n"]

    @property
    def score_m(self) -> float:
        """The median: half of the samples may be wrong."""
        return float(np.median(self.apart_m))


def free(mounts: Transforms, boards: Transforms) -> Iterator[Transform]:
    """Of a robot that turns about at least two axes, by OpenCV's solvers."""
    turns, ways = ([[T[:3, part] for T in some] for some in (mounts, boards)] for part in (slice(3), 3))
    for method in METHODS:
        try:
            R, t = cv2.calibrateHandEye(turns[0], ways[0], turns[1], ways[1], method=method)
        except cv2.error:
            continue
        T = geometry.make(R, t[:, 0])
        if geometry.is_rigid(T, 1e-4):
            yield T


def upright(mounts: Transforms, boards: Transforms) -> Iterator[Transform]:
    """Of a robot that turns about one axis only; the place along that axis is any.

    The axis shows in mount and rig; the turn about it and the place follow from the board's ways, which are linear in them.
    """
    turns = [(of_mount, of_board) for of_mount, of_board in _turns(mounts, boards) if np.linalg.norm(of_mount) > np.radians(5)]
    if not turns:
        return
    signs = [np.sign(of_mount @ turns[0][0]) for of_mount, _ in turns]
    axis, seen = (np.sum([sign * both[k] for sign, both in zip(signs, turns, strict=True)], axis=0) for k in (0, 1))
    axis /= np.linalg.norm(axis)
    straight, aside = (geometry.frame_of_axes(each, np.eye(3)[0], np.zeros(3))[:3, :3] for each in (axis, seen))
    R_start = straight @ aside.T
    rows, levels = [], []
    for mount, board in zip(mounts, boards, strict=True):
        R, way = mount[:3, :3], R_start @ board[:3, 3]
        along = (axis @ way) * axis
        rows.append(np.column_stack([R @ (way - along), R @ np.cross(axis, way), R, -np.eye(3)]))
        levels.append(-(mount[:3, 3] + R @ along))
    unknowns, known = np.concatenate(rows), np.concatenate(levels)
    cos, sin = np.linalg.lstsq(unknowns, known, rcond=1e-9)[0][:2]
    angle = float(np.arctan2(sin, cos))
    turned = unknowns[:, 0] * np.cos(angle) + unknowns[:, 1] * np.sin(angle)
    place = np.linalg.lstsq(unknowns[:, 2:], known - turned, rcond=1e-9)[0][:3]
    yield geometry.make(Rotation.from_rotvec(angle * axis).as_matrix() @ R_start, place)


def turn(R: Float[np.ndarray, "3 3"]) -> Vector:
    """The rotation vector."""
    vector: Vector = cv2.Rodrigues(R)[0][:, 0]
    return vector


def _turns(mounts: Transforms, boards: Transforms) -> Iterator[tuple[Vector, Vector]]:
    """Between two samples: of the mount, and of the board before the rig."""
    for i, j in combinations(range(len(mounts)), 2):
        yield turn(mounts[j][:3, :3].T @ mounts[i][:3, :3]), turn(boards[j][:3, :3] @ boards[i][:3, :3].T)


def spread_rad(mounts: Transforms) -> tuple[Vector, Float[np.ndarray, "3 3"]]:
    """Root mean square turn between two samples about three axes, the most first, and the axes (rows) in the mount's frame."""
    turns = np.array([of_mount for of_mount, _ in _turns(mounts, mounts)])
    values, axes = np.linalg.eigh(turns.T @ turns / len(turns))
    return np.sqrt(np.clip(values[::-1], 0, None)), np.ascontiguousarray(axes.T[::-1])


def middle(mounts: Transforms, T_mount_rig: Transform, boards: Transforms) -> Transform:
    """The mean T_carrier_board."""
    whole = np.array([mount @ T_mount_rig @ board for mount, board in zip(mounts, boards, strict=True)])
    return geometry.make(Rotation.from_matrix(whole[:, :3, :3]).mean().as_matrix(), whole[:, :3, 3].mean(axis=0))


def best(mounts: Transforms, boards: Transforms, solver: Solver) -> Transform | None:
    """By the method whose boards lie nearest to each other."""
    def apart_m(T_mount_rig: Transform) -> float:
        ways = [(mount @ T_mount_rig @ board)[:3, 3] for mount, board in zip(mounts, boards, strict=True)]
        return float(np.sqrt(np.var(ways, axis=0).sum()))

    return min(solver(mounts, boards), key=apart_m, default=None)


def guess(mounts: Transforms, places: Sequence[Transforms], turns: int, solver: Solver,
          corners: Float[np.ndarray, "k 3"]) -> Guess | None:
    """The least median of distances over many small sets of samples: it stands while most samples are right.

    `places` are the T_rig_board in which each sample's board may be seen, each in as many `turns` as the board has that look
    the same, one after the other; `corners` of the board are what is compared.
    """
    found = None
    owner = np.repeat(np.arange(len(mounts)), [len(some) for some in places])
    all_mounts, all_boards = np.array(mounts)[owner], np.array([T for some in places for T in some])
    for some, chosen in _sets(mounts, [len(some) for some in places], turns):
        solved = solver([mounts[i] for i in some], [places[i][k] for i, k in zip(some, chosen, strict=True)])
        # the methods differ by noise, which a three has too much of anyway
        for T_mount_rig in islice(solved, 1 if len(some) == 3 else None):
            tried = _judged(T_mount_rig, owner, all_mounts, all_boards, corners)
            if found is None or tried.score_m < found.score_m:
                found = tried
    return found


def _sets(mounts: Transforms, places: Sequence[int], turns: int) -> Iterator[tuple[tuple[int, ...], tuple[int, ...]]]:
    """All samples, all but one, and threes that turn about two axes, each with the places taken for their boards."""
    everyone = range(len(mounts))
    for left_out in (None, *everyone):
        some = tuple(i for i in everyone if i != left_out)
        yield some, (0,) * len(some)
    turned = {(i, j): turn(mounts[j][:3, :3].T @ mounts[i][:3, :3]) for i, j in combinations(everyone, 2)}
    threes = sorted(combinations(everyone, 3), key=lambda t: -np.linalg.norm(np.cross(turned[t[0], t[1]], turned[t[0], t[2]])))
    threes = threes[:max(TRIPLES, len(threes) // 2)]
    for three in threes[::max(1, len(threes) // TRIPLES)]:
        # which end the first is numbered from is all the same; the better place of each is tried first
        ways = product(range(0, places[three[0]], turns), *(range(places[i]) for i in three[1:]))
        for chosen in sorted(ways, key=lambda way: sum(k // turns for k in way))[:COMBINATIONS]:
            yield three, chosen


def _judged(T_mount_rig: Transform, owner: Int[np.ndarray, "m"], mounts: Float[np.ndarray, "m 4 4"],
            places: Float[np.ndarray, "m 4 4"], corners: Float[np.ndarray, "k 3"]) -> Guess:
    """The guess with every board in the place nearest to the one that lies in their middle."""
    whole = mounts @ T_mount_rig @ places
    boards = corners @ whole[:, :3, :3].transpose(0, 2, 1) + whole[:, None, :3, 3]
    apart = np.sqrt(((boards[:, None] - boards)**2).sum(3).mean(2))
    nearest = np.minimum.reduceat(apart, np.flatnonzero(np.diff(owner, prepend=-1)), axis=1)
    central = int(np.argmin(np.median(nearest, axis=1)))
    chosen = tuple(int(np.argmin(apart[central, owner == i])) for i in range(nearest.shape[1]))
    return Guess(T_mount_rig, chosen, nearest[central])
