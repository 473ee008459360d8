"""The lens: how many distortion terms the corners give evidence for; a term that does not earn its place is left out."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from binpick_calib import bundle as bundles
from binpick_calib.bundle import Bundle, Lens, Seen

MODELS: dict[str, tuple[int, ...]] = {
    "k1": (0,), "k1 k2": (0, 1), "k1 k2 p1 p2": (0, 1, 2, 3), "k1 k2 p1 p2 k3": (0, 1, 2, 3, 4),
    "rational": (0, 1, 2, 3, 4, 5, 6, 7)}
"""The usual models, each holding the one before it; the places are those of OpenCV's k1 k2 p1 p2 k3 k4 k5 k6."""


def evidence(fits: Sequence[Bundle], terms: int) -> float:
    """Schwarz' criterion (BIC, 1978) over all cameras; the least is best. Each term must pay for itself by log n."""
    total = 0.0
    for fit in fits:
        coordinates = sum(r.size for r in fit.residuals_px)
        total += coordinates * np.log(fit.rms_px**2 / 2) + terms * np.log(coordinates)
    return total


def folds(K: Float[np.ndarray, "3 3"], distortion: Float[np.ndarray, "d"], image_size_px: tuple[int, int]) -> bool:
    """Whether the distortion turns back somewhere in the image: then two directions would share a pixel."""
    terms = np.zeros(8)
    terms[:min(8, len(distortion))] = distortion[:8]
    k1, k2, _, _, k3, k4, k5, k6 = terms
    corner = max(float(np.hypot((x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1]))
                 for x in (0, image_size_px[0]) for y in (0, image_size_px[1]))
    r = np.linspace(0, 3 * corner, 600)    # undistorted, the image's corner lies farther out than it is seen
    seen = r * (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
    turning = np.flatnonzero(np.diff(seen) <= 0)
    return bool(turning.size and seen[:turning[0] + 1].max() < corner)


def choose(by_camera: Sequence[Sequence[Seen]], guesses: Sequence[Lens],
           image_size_px: tuple[int, int]) -> tuple[str, list[Lens]]:
    """The model for all cameras (their lenses are of one kind) and each camera's lens by itself.

    The rational model is tried only where k3 has earned its place. A fit that folds inside the image is no candidate.
    """
    best: tuple[float, str, list[Lens]] | None = None
    for name, free in MODELS.items():
        if name == "rational" and best is not None and best[1] != "k1 k2 p1 p2 k3":
            break
        fits = []
        for seen, guess in zip(by_camera, guesses, strict=True):
            own = [s._replace(camera=0) for s in seen]
            fits.append(bundles.adjust(own, [guess], [np.eye(4)], {s.view: bundles.place(guess, s) for s in own}, free))
        score = evidence(fits, len(free))
        lenses = [fit.lenses[0] for fit in fits]
        if best is None or (score < best[0] and not any(folds(x.K, x.distortion, image_size_px) for x in lenses)):
            best = score, name, lenses
    assert best is not None
    return best[1], best[2]
