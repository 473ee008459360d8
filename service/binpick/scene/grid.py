"""Parts on the pixel grid: cut where the surface jumps or folds inwards, then take connected components.

The idea is that of locally convex connected patches (Stein et al., LCCP, 2014), on the organised grid instead of supervoxels:
a concave crease separates two parts, a convex one separates two faces of one part.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from binpick.data import Cloud, Labels, Mask
from binpick.scene.surface import Surface
from binpick.settings import SegmentSettings

STEP_M = 0.012
"""Two neighbouring points further apart than this along z never touch."""
SIGMAS = 4.0
"""A jump is larger than this many sigma of depth."""

Cut = Bool[np.ndarray, "links_h links_w"]


def segment(surface: Surface, of_interest: Mask, settings: SegmentSettings) -> tuple[Labels, Labels]:
    """Faces and parts among the pixels of interest; label 0 is nobody, no minimum size yet."""
    links = [_links(surface, of_interest, settings, axis) for axis in (1, 0)]
    faces = _components(of_interest, links[0][0], links[1][0])
    parts = _components(of_interest, links[0][1], links[1][1])
    return faces, parts


def _links(surface: Surface, of_interest: Mask, settings: SegmentSettings, axis: int) -> tuple[Cut, Cut]:
    """Whether each pixel holds on to its next neighbour along an axis: as one face, as one part."""
    def pair(field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return (field[:, :-1], field[:, 1:]) if axis == 1 else (field[:-1], field[1:])

    p, q = pair(surface.xyz)
    n_p, n_q = pair(surface.normal)
    step: Cloud = q - p
    off_p, off_q = np.abs(_dot(n_p, step)), np.abs(_dot(n_q, step))
    limit = np.maximum(np.float32(settings.jump_m), np.float32(SIGMAS) * pair(surface.sigma_z_m)[0])
    both = pair(of_interest)
    with np.errstate(invalid="ignore"):
        joined = both[0] & both[1] & (np.minimum(off_p, off_q) < limit) & (np.abs(step[..., 2]) < STEP_M)
        flat = _dot(n_p, n_q) > np.float32(np.cos(settings.crease_rad))
        convex = _dot(n_q - n_p, step) > 0
    return joined & flat, joined & (flat | convex)


def _dot(a: Cloud, b: Cloud) -> Float32[np.ndarray, "h w"]:
    product: Float32[np.ndarray, "h w"] = cv2.transform(a * b, np.ones((1, 3), dtype=np.float32))
    return product


def _components(nodes: Mask, right: Bool[np.ndarray, "h w-1"], down: Bool[np.ndarray, "h-1 w"]) -> Labels:
    """Connected components of a grid graph, by OpenCV on a grid of twice the size where every link is a pixel of its own."""
    rows, cols = nodes.shape
    fine = np.zeros((2 * rows - 1, 2 * cols - 1), dtype=np.uint8)
    fine[::2, ::2] = nodes
    fine[::2, 1::2] = right
    fine[1::2, ::2] = down
    _, labels = cv2.connectedComponents(fine, connectivity=4, ltype=cv2.CV_32S)
    return np.ascontiguousarray(labels[::2, ::2]).astype(np.int32)
