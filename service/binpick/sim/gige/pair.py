"""The usual rig: two cameras, left and right, at the addresses that a person finds in the README."""

from binpick.sim.gige.features import SIZE_PX
from binpick.sim.gige.group import GigeGroup, ImageFn


class GigePair(GigeGroup):
    """Cameras 0 (left) and 1 (right)."""

    def __init__(self, image: ImageFn, addresses: tuple[str, str] = ("127.0.0.2", "127.0.0.3"),
                 size_px: tuple[int, int] = SIZE_PX, serials: tuple[str, ...] = ()) -> None:
        super().__init__(image, addresses, size_px, serials)
