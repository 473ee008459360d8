"""Pictures that carry their head and number in their pixels, drawn in advance: for long runs, where nothing may be mixed up."""

import numpy as np

from binpick.data import Image, Light
from binpick.sim.gige.features import SIZE_PX

HEAD_BITS, SHOT_BITS, CHECK_BITS = 4, 32, 12
FIELDS = HEAD_BITS + SHOT_BITS + CHECK_BITS
MAX_SIDE = 16
MODULUS = 4093
"""The largest prime of CHECK_BITS."""


class Numbered:
    """An image source of a group: a texture of each head's own, with a row of black and white squares at the upper left."""

    def __init__(self, heads: int, size_px: tuple[int, int] = SIZE_PX) -> None:
        """Raises ValueError when the image is too narrow for the squares."""
        width, height = size_px
        self._side = min(MAX_SIDE, width // FIELDS)
        if not self._side:
            raise ValueError(f"a numbered image is at least {FIELDS} pixels wide")
        random = np.random.default_rng(0)
        self._textures = [random.integers(0, 256, (height, width), np.uint8) for _ in range(heads)]

    def __call__(self, index: int, _light: Light, shot: int) -> Image:
        """Costs one copy of the texture."""
        image, side = self._textures[index].copy(), self._side
        bits = np.array([255 * (_code(index, shot) >> place & 1) for place in range(FIELDS)], np.uint8)
        image[:side, :side * FIELDS] = np.repeat(bits, side)
        return image


def read(image: Image) -> tuple[int, int]:
    """Head and shot of a numbered picture. Raises ValueError when it is none, or damaged there."""
    side = min(MAX_SIDE, image.shape[1] // FIELDS)
    middle = image[side // 2, side // 2:side * FIELDS:side]
    code = sum(int(bright) << place for place, bright in enumerate(middle > 127))
    head, shot = code & (1 << HEAD_BITS) - 1, code >> HEAD_BITS & (1 << SHOT_BITS) - 1
    if code != _code(head, shot):
        raise ValueError("the picture carries no number")
    return head, shot


def _code(head: int, shot: int) -> int:
    number = head | shot % (1 << SHOT_BITS) << HEAD_BITS
    return number | (number * 31 + 7) % MODULUS << HEAD_BITS + SHOT_BITS
