"""Rotations: an even set of them, and which of them leave a part as it was."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

Turns = Float64[np.ndarray, "n 3 3"]
STEPS = 24
"""Turns about an axis of revolution that stand for all of them."""


def even(count: int) -> Turns:
    """Rotations spread evenly over all there are: a super-Fibonacci spiral (Alexa, CVPR 2022)."""
    s = np.arange(count) + 0.5
    r, rest = np.sqrt(s / count), np.sqrt(1 - s / count)
    alpha, beta = 2 * np.pi * s / np.sqrt(2), 2 * np.pi * s / 1.533751168755204288118041
    turns: Turns = Rotation.from_quat(
        np.column_stack([r * np.sin(alpha), r * np.cos(alpha), rest * np.sin(beta), rest * np.cos(beta)])).as_matrix()
    return turns


@dataclass(frozen=True, slots=True, eq=False)
class Symmetry:
    """Rotations about the part's centre that leave it as it was, identity first.

    With an `axis` of revolution any turn about it is one more, before each of `turns`.
    """

    turns: Turns
    axis: Float64[np.ndarray, "3"] | None = None

    @property
    def sampled(self) -> Turns:
        """All of them; of those about an axis of revolution, `STEPS`."""
        if self.axis is None:
            return self.turns
        about = Rotation.from_rotvec(np.outer(np.arange(STEPS) * (2 * np.pi / STEPS), self.axis)).as_matrix()
        return np.asarray(np.einsum("aij,bjk->abik", about, self.turns).reshape(-1, 3, 3))

    def canonical(self, R: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
        """Of all rotations that show the part alike, the smallest; of equally small ones the first."""
        if self.axis is not None:
            alike = R @ self.turns
            alike = np.stack([turn @ self._least(turn) for turn in alike])
        else:
            alike = R @ self.turns
        traces = np.round(np.trace(alike, axis1=1, axis2=2), 4)
        keys = [np.round(alike.reshape(-1, 9)[:, i], 3) for i in range(8, -1, -1)]
        return np.asarray(alike[np.lexsort([*keys, -traces])[0]])

    def _least(self, R: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
        """The turn about the axis that makes R smallest: trace(R turn) is a cosine of its angle."""
        if self.axis is None:
            return np.eye(3)
        x, y, z = self.axis
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        cosine = np.trace(R) - self.axis @ R @ self.axis
        angle = np.arctan2(np.trace(R @ cross), cosine)
        return np.asarray(Rotation.from_rotvec(angle * self.axis).as_matrix())


def angles(one: Turns, other: Float64[np.ndarray, "m 3 3"]) -> Float64[np.ndarray, "n m"]:
    """The angle between each rotation of one and each of the other, radians."""
    traces = one.reshape(-1, 9) @ other.reshape(-1, 9).T
    return np.asarray(np.arccos(np.clip((traces - 1) / 2, -1, 1)))


def thinned(turns: Turns, apart_rad: float, symmetry: Symmetry) -> Float64[np.ndarray, "k 3 3"]:
    """Those of `turns`, in order, that no earlier one is within `apart_rad` of, symmetric ones counted as one."""
    kept: list[int] = []
    free = np.ones(len(turns), dtype=bool)
    alike = symmetry.sampled
    for i in range(len(turns)):
        if free[i]:
            kept.append(i)
            free &= angles(turns, turns[i] @ alike).min(axis=1) >= apart_rad
    return turns[kept]
