"""The loop of robot, rig and board in closed form: the guess that most samples agree on, from their poses alone.

A rig rides on a mount (flange or base) and the board on its carrier (base or flange): T_carrier_mount T_mount_rig T_rig_board is the
same T_carrier_board in every sample.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, islice, product

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from binpick import geometry
from binpick.geometry import Transform

Transforms = Sequence[Transform]
Solver = Callable[[Transforms, Transforms], Iterator[Transform]]
"""T_mount_rig by each method, from T_carrier_mount and T_rig_board of samples."""
METHODS = (cv2.CALIB_HAND_EYE_PARK, cv2.CALIB_HAND_EYE_HORAUD, cv2.CALIB_HAND_EYE_DANIILIDIS)
"""They agree within 0.6 mm on ViSP's eight images; Andreff's is off by 8 there, Li's of robot and world by 40. Tsai's, 2 mm off,
prints a line for each set of samples that it cannot solve."""
TRIPLES = 60
"""So many threes of samples are tried; of 30 samples a third may be wrong before none of the threes is right."""
COMBINATIONS = 16
"""So many ways to combine the places in which a three's boards may be seen."""


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


def free(A: Transforms, C: Transforms) -> Iterator[Transform]:
    """Of a robot that turns about at least two axes, by OpenCV's solvers."""
    Ra, ta, Rc, tc = [a[:3, :3] for a in A], [a[:3, 3] for a in A], [c[:3, :3] for c in C], [c[:3, 3] for c in C]
    for method in METHODS:
        try:
            R, t = cv2.calibrateHandEye(Ra, ta, Rc, tc, method=method)
        except cv2.error:
            continue
        T = geometry.make(R, t[:, 0])
        if geometry.is_rigid(T, 1e-4):
            yield T


def upright(A: Transforms, C: Transforms) -> Iterator[Transform]:
    """Of a robot that turns about one axis only; the place along that axis is any.

    The axis shows in mount and rig; the turn about it and the place follow from the board's ways, which are linear in them.
    """
    turns = [(a, c) for a, c in _turns(A, C) if np.linalg.norm(a) > np.radians(5)]
    if not turns:
        return
    along = [a * np.sign(a @ turns[0][0]) for a, _ in turns]
    same = [c * np.sign(a @ turns[0][0]) for a, c in turns]
    axis, seen = (np.sum(each, axis=0) / np.linalg.norm(np.sum(each, axis=0)) for each in (along, same))
    R0 = geometry.frame_of_axes(axis, np.eye(3)[0], np.zeros(3))[:3, :3] @ \
        geometry.frame_of_axes(seen, np.eye(3)[0], np.zeros(3))[:3, :3].T
    rows, levels = [], []
    for a, c in zip(A, C, strict=True):
        v = R0 @ c[:3, 3]
        up = (axis @ v) * axis
        rows.append(np.column_stack([a[:3, :3] @ (v - up), a[:3, :3] @ np.cross(axis, v), a[:3, :3], -np.eye(3)]))
        levels.append(-(a[:3, 3] + a[:3, :3] @ up))
    cos, sin = np.linalg.lstsq(np.concatenate(rows), np.concatenate(levels), rcond=1e-9)[0][:2]
    angle = float(np.arctan2(sin, cos))
    held = [np.column_stack([row[:, :2] @ [np.cos(angle), np.sin(angle)], row[:, 2:]]) for row in rows]
    whole = np.concatenate(held)
    place = np.linalg.lstsq(whole[:, 1:], np.concatenate(levels) - whole[:, 0], rcond=1e-9)[0]
    yield geometry.make(Rotation.from_rotvec(angle * axis).as_matrix() @ R0, place[:3])


def _turns(A: Transforms, C: Transforms) -> Iterator[tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]]:
    """Rotation vectors between two samples, of the mount and of the board before the rig."""
    for i, j in combinations(range(len(A)), 2):
        yield turn(A[j][:3, :3].T @ A[i][:3, :3]), turn(C[j][:3, :3] @ C[i][:3, :3].T)


def turn(R: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    """The rotation vector."""
    vector: Float[np.ndarray, "3"] = cv2.Rodrigues(R)[0][:, 0]
    return vector


def angle_rad(T_a: Transform, T_b: Transform) -> float:
    """Between two transforms."""
    return float(np.linalg.norm(turn(T_a[:3, :3].T @ T_b[:3, :3])))


def spread_rad(A: Transforms) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Root mean square turn between two samples about three axes, the most first, and the axes (rows) in the mount's frame."""
    turns = np.array([a for a, _ in _turns(A, A)])
    values, axes = np.linalg.eigh(turns.T @ turns / len(turns))
    return np.sqrt(np.clip(values[::-1], 0, None)), axes.T[::-1]


def best(A: Transforms, C: Transforms, solver: Solver) -> Transform | None:
    """By the method whose boards lie nearest to each other."""
    found = [(float(np.sqrt(np.var([(a @ X @ c)[:3, 3] for a, c in zip(A, C, strict=True)], axis=0).sum())), X)
             for X in solver(A, C)]
    return min(found, key=lambda each: each[0])[1] if found else None


def middle(A: Transforms, X: Transform, C: Transforms) -> Transform:
    """The mean T_carrier_board."""
    boards = [a @ X @ c for a, c in zip(A, C, strict=True)]
    R = Rotation.from_matrix([T[:3, :3] for T in boards]).mean().as_matrix()
    return geometry.make(R, np.mean([T[:3, 3] for T in boards], axis=0))


def guess(A: Transforms, places: Sequence[Transforms], solver: Solver, corners: Float[np.ndarray, "k 3"]) -> Guess | None:
    """The least median of distances over many small sets of samples: it stands while most samples are right.

    `places` are the T_rig_board in which each sample's board may be seen; `corners` of the board are what is compared.
    """
    found = None
    for some, chosen in _sets(A, places):
        for X in solver([A[i] for i in some], [places[i][k] for i, k in zip(some, chosen, strict=True)]):
            tried = _judged(X, A, places, corners)
            if found is None or tried.score_m < found.score_m:
                found = tried
    return found


def _sets(A: Transforms, places: Sequence[Transforms]) -> Iterator[tuple[tuple[int, ...], tuple[int, ...]]]:
    """All samples, all but one, and threes that turn about two axes, each with the places taken for their boards."""
    everyone = range(len(A))
    for left_out in (None, *everyone):
        some = tuple(i for i in everyone if i != left_out)
        yield some, (0,) * len(some)
    turned = {(i, j): turn(A[j][:3, :3].T @ A[i][:3, :3]) for i, j in combinations(everyone, 2)}
    threes = sorted(combinations(everyone, 3), key=lambda t: -np.linalg.norm(np.cross(turned[t[0], t[1]], turned[t[0], t[2]])))
    threes = threes[:max(TRIPLES, len(threes) // 2)]
    for three in threes[::max(1, len(threes) // TRIPLES)]:
        for chosen in islice(product(*(range(len(places[i])) for i in three)), COMBINATIONS):
            yield three, chosen


def _judged(X: Transform, A: Transforms, places: Sequence[Transforms], corners: Float[np.ndarray, "k 3"]) -> Guess:
    """The guess with every board in the place nearest to the one that lies in their middle."""
    owner = np.concatenate([[i] * len(some) for i, some in enumerate(places)])
    boards = np.array([geometry.transform(a @ X @ place, corners) for a, some in zip(A, places, strict=True) for place in some])
    apart = np.sqrt(((boards[:, None] - boards)**2).sum(3).mean(2))
    nearest = np.minimum.reduceat(apart, np.flatnonzero(np.diff(owner, prepend=-1)), axis=1)
    central = int(np.argmin(np.median(nearest, axis=1)))
    chosen = tuple(int(np.argmin(apart[central, owner == i])) for i in range(len(A)))
    return Guess(X, chosen, nearest[central])
