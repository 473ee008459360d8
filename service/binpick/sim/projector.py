"""The dot projector between the cameras: its pattern, and how much of it falls on a point."""

import cv2
import numpy as np
from jaxtyping import Float32

from binpick import geometry
from binpick.sim import exam

PATTERN_SEED = 20240607
# pattern cells per camera pixel: dots are sampled finer than any camera resolves them
CELLS_PER_PX = 2.0
ROW = 4096


class Projector:
    """A pinhole that throws pseudo-random dots at the bin's floor; positions in frame `bin`."""

    def __init__(self, world: str, optics: exam.Optics = exam.OPTICS) -> None:
        setup = exam.setup(world)
        T_bin_camera = geometry.inverse(setup.T_camera_bin)
        self.position_m = geometry.transform(T_bin_camera, np.array(optics.projector_position_m))
        T_bin_projector = geometry.frame_of_axes(-self.position_m, np.array([1.0, 0.0, 0.0]), self.position_m)
        self._T_projector_bin = geometry.inverse(T_bin_projector)
        self._cells_per_rad = setup.left.focal_px[0] * CELLS_PER_PX
        # wide enough for everything that stands in the bin, seen from above the rim
        reach = float(np.hypot(*setup.bin_size_m[:2]) / 2 / (self.position_m[2] - setup.bin_size_m[2]))
        self._pattern = _dots(int(2 * reach * self._cells_per_rad), optics)

    def light(self, points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n"]:
        """Pattern brightness 0 to 1 in the direction of each point, not yet shadowed or weakened by distance."""
        p = geometry.transform(self._T_projector_bin, points)
        half = np.float32(self._pattern.shape[0] / 2)
        scale = np.float32(self._cells_per_rad) / p[:, 2]
        return sample(self._pattern, p[:, 0] * scale + half, p[:, 1] * scale + half, cv2.BORDER_CONSTANT)


def sample(image: Float32[np.ndarray, "h w"], u: Float32[np.ndarray, "n"], v: Float32[np.ndarray, "n"],
           border: int) -> Float32[np.ndarray, "n"]:
    """The image at sub-pixel places (column u, row v), linearly between its cells."""
    count = len(u)
    if not count:
        return np.zeros(0, np.float32)
    # remap works on grids: the list is folded into rows and its last row filled up
    u, v = (np.append(axis, np.zeros(-len(axis) % ROW, np.float32)).reshape(-1, ROW) for axis in (u, v))
    values: Float32[np.ndarray, "n"] = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=border).ravel()[:count]
    return values


def _dots(side: int, optics: exam.Optics) -> Float32[np.ndarray, "s s"]:
    """One dot of random strength near every point of a grid, so that no stretch of a row repeats or stays empty."""
    rng = np.random.default_rng(PATTERN_SEED)
    pitch, sigma = optics.dot_pitch_px * CELLS_PER_PX, optics.dot_sigma_px * CELLS_PER_PX
    grid = np.arange(0, side, pitch)
    x, y = (axis + rng.uniform(-0.5, 0.5, (len(grid), len(grid))) * pitch for axis in np.meshgrid(grid, grid))
    impulses = np.zeros((side, side), np.float32)
    strength = rng.uniform(0.5, 1.0, x.shape)
    np.add.at(impulses, (y.astype(int).clip(0, side - 1), x.astype(int).clip(0, side - 1)), strength)
    smooth = cv2.GaussianBlur(impulses, (0, 0), sigma) * np.float32(2 * np.pi * sigma**2)
    dark = np.float32(optics.dark_between_dots)
    pattern: Float32[np.ndarray, "s s"] = dark + (1 - dark) * np.minimum(smooth, np.float32(1.0))
    return pattern
