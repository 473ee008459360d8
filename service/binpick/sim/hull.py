"""A tool's mesh as the judge sees it: the convex solid around its corners."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

PITCH_M = 0.003


@dataclass(frozen=True, slots=True)
class Hull:
    """The smallest convex solid around these corners, metres, in the body's own frame."""

    corners_m: tuple[tuple[float, float, float], ...]

    def depth(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """How far each point lies below the surface; negative outside, there not a distance."""
        sides = ConvexHull(np.array(self.corners_m)).equations
        depth: Float[np.ndarray, "n"] = -(points @ sides[:, :3].T + sides[:, 3]).max(axis=1)
        return depth

    def surface(self) -> Float[np.ndarray, "n 3"]:
        """Points all over the surface, corners and edges included, no further apart than PITCH_M."""
        corners = np.array(self.corners_m)
        return np.vstack([_triangle(*corners[side]) for side in ConvexHull(corners).simplices])


def _triangle(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> Float[np.ndarray, "n 3"]:
    longest = max(float(np.linalg.norm(p - q)) for p, q in ((a, b), (b, c), (c, a)))
    count = max(1, int(np.ceil(longest / PITCH_M)))
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(count + 1), np.arange(count + 1)))
    u, v = (share[i + j <= count, None] / count for share in (i, j))
    points: Float[np.ndarray, "n 3"] = a + u * (b - a) + v * (c - a)
    return points
