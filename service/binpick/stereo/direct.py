"""Seen directly or in a mirror: what the projector lights directly lies where its ray goes, a reflection does not."""

import numpy as np
from jaxtyping import Bool, Float

Points = Float[np.ndarray, "n 3"]
Places = Float[np.ndarray, "n 2"]
Camera = Float[np.ndarray, "3 4"]
FEWEST = 200
"""Points from which the projector can be found at all."""
SAMPLED, TRIALS, DRAWN = 2000, 300, 8
"""Points tried, and RANSAC's trials of so many points each: with a third of all points wrong, 12 trials are free of them."""
ROUNDS = 4
NEAR_PX = 1.5
"""Projector pixels within which a point supports a trial: rows are read to half a pixel."""
LEAST_PX, SIGMAS = 0.6, 4.0
"""A point is direct within so many projector pixels, and so many robust sigmas of all, across the columns."""


def seen(points: Points, places: Places) -> Bool[np.ndarray, "n"]:
    """Which points are lit where they are seen, not seen in a mirror.

    `points` are column, row and disparity in the rectified view, `places` column and row in the projector's picture. A
    projective 3x4 map leads from one to the other, whatever cameras and projector are. It is found anew each cycle (RANSAC on
    the direct linear transform; Hartley and Zisserman 2004, 7.1), so nobody calibrates the projector. A mirror image stands
    behind its mirror, but the light that it shows fell elsewhere. All are taken for direct when they are too few to tell.
    """
    if len(points) < FEWEST:
        return np.ones(len(points), dtype=bool)
    extended = np.concatenate([_normal(points), np.ones((len(points), 1))], axis=1)
    spread = places.std(axis=0).max() + 1e-9
    scaled = (places - places.mean(axis=0)) / spread
    some = np.linspace(0, len(points) - 1, min(SAMPLED, len(points))).astype(np.intp)
    sample = extended[some], scaled[some]
    camera = _best(*sample, NEAR_PX / spread)
    for _ in range(ROUNDS):
        near = np.abs(_off(camera, *sample)).max(axis=1) < NEAR_PX / spread
        if near.sum() < FEWEST / 2:
            return np.ones(len(points), dtype=bool)
        camera = _linear(sample[0][near][None], sample[1][near][None])[0]
    off_px = np.abs(_off(camera, extended, scaled)) * spread
    across = off_px[off_px.max(axis=1) < NEAR_PX, 0]
    limit_px = min(NEAR_PX, max(LEAST_PX, SIGMAS * 1.4826 * float(np.median(across)))) if len(across) else NEAR_PX
    direct: Bool[np.ndarray, "n"] = (off_px[:, 0] < limit_px) & (off_px[:, 1] < NEAR_PX)
    return direct


def _normal(points: Points) -> Points:
    """Mean 0, deviation 1: else the transform is badly conditioned."""
    normal: Points = (points - points.mean(axis=0)) / (points.std(axis=0) + 1e-9)
    return normal


def _best(points: Float[np.ndarray, "n 4"], places: Places, near: float) -> Camera:
    """The map that most points support, of those through a few points each."""
    drawn = np.random.default_rng(0).integers(0, len(points), (TRIALS, DRAWN))
    cameras = _linear(points[drawn], places[drawn])
    support = [int((np.abs(_off(camera, points, places)).max(axis=1) < near).sum()) for camera in cameras]
    best: Camera = cameras[int(np.argmax(support))]
    return best


def _linear(points: Float[np.ndarray, "t n 4"], places: Float[np.ndarray, "t n 2"]) -> Float[np.ndarray, "t 3 4"]:
    """The direct linear transform, several at once."""
    nothing = np.zeros_like(points)
    rows = np.concatenate([np.concatenate([points, nothing, -places[..., :1] * points], axis=-1),
                           np.concatenate([nothing, points, -places[..., 1:] * points], axis=-1)], axis=-2)
    _, vectors = np.linalg.eigh(np.swapaxes(rows, -1, -2) @ rows)
    cameras: Float[np.ndarray, "t 3 4"] = vectors[..., 0].reshape(-1, 3, 4)
    return cameras


def _off(camera: Camera, points: Float[np.ndarray, "n 4"], places: Places) -> Places:
    """How far each point's place is from where the map puts it."""
    image = points @ camera.T
    with np.errstate(divide="ignore", invalid="ignore"):
        off: Places = image[:, :2] / image[:, 2:] - places
    return off
