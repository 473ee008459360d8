"""Covariance: how far off the fitted rig may be, by the scatter of the corners and by what leaving out each view changes."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

Square = Float[np.ndarray, "u u"]


@dataclass(frozen=True, slots=True, eq=False)
class Covariance:
    """Of the rig's unknowns in the order of the bundle's vector (lenses, then steps); 0 where a term was held.

    `scatter` takes every corner for a witness of its own; `jackknife` takes every view for one (Tukey 1958): corners of a view
    err together, by the board's bend, its light and its blur. On real sets that doubles or trebles the deviations.
    """

    scatter: Square
    jackknife: Square

    def deviations(self, directions: Float[np.ndarray, "k u"]) -> Float[np.ndarray, "k"]:
        """One standard deviation of each linear combination of the unknowns: the larger of the two, never told too small."""
        both = [np.einsum("ku,uw,kw->k", directions, matrix, directions) for matrix in (self.scatter, self.jackknife)]
        return np.asarray(np.sqrt(np.clip(np.maximum(*both), 0, None)))


def of(jacobian: Float[np.ndarray, "r m"], residuals: Float[np.ndarray, "r"], views: Int[np.ndarray, "r"],
       places: Int[np.ndarray, "p"], size: int) -> Covariance:
    """Of a fit whose unknowns are those of the rig (`places` in the bundle's vector of `size`), then six of each view's board.

    `views`: which view each residual belongs to, counted from 0 in the order of the boards. Each board's own unknowns are
    projected out; leaving out a view is one step of Gauss and Newton, within 3 % of fitting anew on two real sets.
    """
    normals, slopes, squares = [], [], 0.0
    number = len(places)
    for view in range(int(views.max()) + 1):
        own, r = jacobian[views == view], residuals[views == view]
        board, _ = np.linalg.qr(own[:, number + 6 * view:number + 6 * view + 6])
        free = own[:, :number] - board @ (board.T @ own[:, :number])
        left = r - board @ (board.T @ r)
        normals.append(free.T @ free)
        slopes.append(free.T @ left)
        squares += float(left @ left)
    whole = np.sum(normals, axis=0)
    scale = 1 / np.sqrt(np.maximum(np.diag(whole), 1e-300))     # px and shares of a radius are orders apart
    changes = np.array([_inverse(whole - normal, scale) @ slope for normal, slope in zip(normals, slopes, strict=True)])
    variance = squares / max(1, len(residuals) - number - 6 * len(normals))
    return Covariance(_spread(variance * _inverse(whole, scale), places, size),
                      _spread((1 - 1 / len(normals)) * changes.T @ changes, places, size))


def _inverse(normal: Float[np.ndarray, "p p"], scale: Float[np.ndarray, "p"]) -> Float[np.ndarray, "p p"]:
    inverse: Float[np.ndarray, "p p"] = np.linalg.pinv(normal * np.outer(scale, scale), hermitian=True) * np.outer(scale, scale)
    return inverse


def _spread(matrix: Float[np.ndarray, "p p"], places: Int[np.ndarray, "p"], size: int) -> Square:
    whole = np.zeros((size, size))
    whole[np.ix_(places, places)] = matrix
    return whole
