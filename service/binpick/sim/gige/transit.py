"""What the network does to the packets of an image on their way: loses, doubles, overtakes, delays them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64

Indices = Int64[np.ndarray, "_"]
REACH = 8
"""How many packets one that is overtaken falls back at most."""


@dataclass(frozen=True, slots=True)
class Transit:
    """Shares of all packets, 0 to 1. `late_ms` is how long after the image's end the late ones come; without `resends` none
    is sent again when it is asked for."""

    loss: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    late: float = 0.0
    late_ms: float = 10.0
    resends: bool = True

    def plan(self, count: int, random: np.random.Generator) -> tuple[Indices, Indices]:
        """Which of `count` packets arrive in which order, and which come late. The same generator, the same plan."""
        chance = random.random((4, count))
        places = np.arange(count, dtype=np.float64)
        behind = np.where(chance[2] < self.reorder, random.integers(1, REACH + 1, count) + 0.5, 0.0)
        alive = chance[0] >= self.loss
        late = alive & (chance[3] < self.late)
        times = np.where(chance[1] < self.duplicate, 2, 1)
        order = np.argsort(places + behind, kind="stable")
        order = order[(alive & ~late)[order]]
        return np.repeat(order, times[order]), np.flatnonzero(late)
