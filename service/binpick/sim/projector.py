"""The projector between the cameras: the pictures it throws, dots or stripes, and where in them a point lies."""

import functools

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from binpick import data, geometry
from binpick.errors import InputError
from binpick.sim import exam

PATTERN_SEED = 20240607
# pattern cells per camera pixel: dots are sampled finer than any camera resolves them
CELLS_PER_PX = 2.0
ROW = 4096
# pictures kept beside the first: a sequence shows each to two cameras in turn
KEPT = 2

Values = Float32[np.ndarray, "n"]


class Projector:
    """A pinhole that throws square pictures at the bin's floor, numbered as `Light.pattern`; positions in frame `bin`."""

    def __init__(self, world: str, optics: exam.Optics = exam.OPTICS) -> None:
        setup = exam.setup(world)
        T_bin_camera = geometry.inverse(setup.T_camera_bin)
        self.position_m = geometry.transform(T_bin_camera, np.array(optics.projector_position_m))
        T_bin_projector = geometry.frame_of_axes(-self.position_m, np.array([1.0, 0.0, 0.0]), self.position_m)
        self._T_projector_bin = geometry.inverse(T_bin_projector)
        self._cells_per_rad = setup.left.focal_px[0] * CELLS_PER_PX
        # wide enough for everything that stands in the bin, seen from above the rim
        reach = float(np.hypot(*setup.bin_size_m[:2]) / 2 / (self.position_m[2] - setup.bin_size_m[2]))
        self._side, self._optics = int(2 * reach * self._cells_per_rad), optics
        self._dots = _dots(self._side, PATTERN_SEED, optics)
        self._pictures: dict[int, Float32[np.ndarray, "s s"]] = {}

    def place(self, points: Float32[np.ndarray, "n 3"]) -> tuple[Values, Values]:
        """Column and row of the picture's cells that throw their light towards each point."""
        p = geometry.transform(self._T_projector_bin, points)
        half = np.float32(self._side / 2)
        scale = np.float32(self._cells_per_rad) / p[:, 2]
        return p[:, 0] * scale + half, p[:, 1] * scale + half

    def picture(self, pattern: int) -> Float32[np.ndarray, "s s"]:
        """Brightness 0 to 1 of the picture's cells, not weakened by distance. Raises InputError. Not for threads to share."""
        if not 0 <= pattern <= data.BLACK_PATTERN:
            raise InputError(f"the projector has no pattern {pattern}; it has 0 to {data.BLACK_PATTERN}")
        if pattern == 0:
            return self._dots
        if pattern not in self._pictures:
            while len(self._pictures) >= KEPT:
                del self._pictures[next(iter(self._pictures))]
            self._pictures[pattern] = (_dots(self._side, PATTERN_SEED + pattern, self._optics)
                                       if pattern < data.DOT_PATTERNS else _stripes(self._side, pattern))
        return self._pictures[pattern]


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


def _stripes(side: int, pattern: int) -> Float32[np.ndarray, "s s"]:
    """An image of OpenCV's Gray code, or its white or black, as wide as the picture; above and below it is dark."""
    width, height = data.GRAY_CODE_SIZE_PX
    if pattern in (data.WHITE_PATTERN, data.BLACK_PATTERN):
        image = np.full((height, width), 255 if pattern == data.WHITE_PATTERN else 0, np.uint8)
    else:
        image = _gray_code()[pattern - data.FIRST_GRAY_PATTERN]
    rows = side * height // width
    picture = np.zeros((side, side), np.float32)
    top = (side - rows) // 2
    # cells are finer than the image's pixels: AREA keeps each of them a square with sharp sides
    picture[top:top + rows] = cv2.resize(image, (side, rows), interpolation=cv2.INTER_AREA) / np.float32(255)
    return picture


@functools.cache
def _gray_code() -> tuple[UInt8[np.ndarray, "h w"], ...]:
    return tuple(cv2.structured_light.GrayCodePattern.create(*data.GRAY_CODE_SIZE_PX).generate()[1])


def _dots(side: int, seed: int, optics: exam.Optics) -> Float32[np.ndarray, "s s"]:
    """One dot of random strength near every point of a grid, so that no stretch of a row repeats or stays empty."""
    rng = np.random.default_rng(seed)
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
