"""A window's rows in strips: each sees some rows beyond its own, and gives what the whole window would have given."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from binpick.data import Rectified


@dataclass(frozen=True, slots=True)
class Strip:
    """Rows `top` to `bottom` of a window, seen with those from `first` to `last`."""

    first: int
    top: int
    bottom: int
    last: int

    @property
    def seen(self) -> slice:
        """All its rows."""
        return slice(self.first, self.last)

    def of(self, rectified: Rectified) -> Rectified:
        """Those of both images."""
        return replace(rectified, left=rectified.left[self.seen], right=rectified.right[self.seen])

    def inner(self, field: np.ndarray) -> np.ndarray:
        """Without the overlap."""
        return field[self.top - self.first:self.bottom - self.first]


def strips(rows: int, most: int, overlap: int) -> list[Strip]:
    """At most so many rows at a time, seen with `overlap` more to both sides where there are any.

    Strips are an even number of equal ones, so that two threads have as much to do; they do not depend on the machine.
    """
    count = 2 * -(-rows // (2 * most))
    each = max(-(-rows // (2 * count)) * 2, 2)
    return [Strip(max(0, top - overlap), top, min(top + each, rows), min(top + each + overlap, rows))
            for top in range(0, rows, each)]


def joined(fields: Iterable[tuple[np.ndarray, ...]]) -> tuple[np.ndarray, ...]:
    """The strips' fields, one below the other."""
    return tuple(np.concatenate(rows) for rows in zip(*fields, strict=True))
