"""What became of grasps in one bin, as plain numbers: the same for the pipeline, a recording and the daemon's file.

Positions and heights are in the frame `bin`, metres. `binpick.grasp.memory` holds the laws; here is only what is kept.
"""

import base64
import binascii
import zlib
from datetime import datetime
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Int16
from pydantic import Field, field_validator, model_validator

from binpick.message import Triple, Wire

OK, MISSED, DROPPED, COLLISION, SKIPPED, DOUBLE, UNREACHABLE = OUTCOMES = tuple(range(1, 8))
"""As the wire has them."""
PACKING = 1
"""Of zlib's 9: a whole bin takes 3 ms, a patch none."""
Side = Annotated[int, Field(ge=0, le=4096)]


class Grid(Wire):
    """Whole numbers on the cells of a height map, row by row: 16 bits little-endian, zlib, base64."""

    rows: Side
    cols: Side
    packed: str

    @classmethod
    def of(cls, cells: Int16[np.ndarray, "rows cols"]) -> "Grid":
        """Packs them."""
        raw = zlib.compress(cells.astype("<i2").tobytes(), PACKING)
        return cls(rows=cells.shape[0], cols=cells.shape[1], packed=base64.b64encode(raw).decode())

    @property
    def cells(self) -> Int16[np.ndarray, "rows cols"]:
        """Unpacked."""
        return np.frombuffer(self._raw(), dtype="<i2").astype(np.int16).reshape(self.rows, self.cols)

    def _raw(self) -> bytes:
        return zlib.decompress(base64.b64decode(self.packed, validate=True))

    @model_validator(mode="after")
    def _whole(self) -> "Grid":
        try:
            size = len(self._raw())
        except (binascii.Error, zlib.error) as error:
            raise ValueError(f"packed: {error}") from error
        if size != 2 * self.rows * self.cols:
            raise ValueError(f"packed: {size} bytes are not {self.rows} x {self.cols} cells")
        return self


class Attempt(Wire):
    """A published grasp and what became of it; `captured_at`, `cycle_id` and `grasp` together name it.

    `reach_m` is how far from `position_m` its own part goes; `patch` is what lay around it: heights in
    tenths of a millimetre, -32768 where nothing was seen.
    """

    captured_at: str
    cycle_id: int
    grasp: int
    tool: int
    position_m: Triple
    approach: Triple
    """The tool's z."""
    reach_m: float
    patch: Grid
    outcome: Annotated[int, Field(ge=0, le=7)] = 0
    """As on the wire; 0: nobody knows."""
    source: Literal["told", "seen"] = "told"
    """Told by the controller, or seen by the cameras."""

    @field_validator("captured_at")
    @classmethod
    def _instant(cls, text: str) -> str:
        if datetime.fromisoformat(text).tzinfo is None:
            raise ValueError("an instant needs its time zone")
        return text

    @property
    def name(self) -> tuple[str, int, int]:
        """Orders attempts by time."""
        return self.captured_at, self.cycle_id, self.grasp


class Look(Wire):
    """The bin as the last cycle saw it, and the grasps that it published: what the next cycle compares with.

    `heights` are tenths of a millimetre as in a patch; `parts` has on each published part's cells its first grasp's number,
    0 elsewhere.
    """

    heights: Grid
    parts: Grid
    attempts: tuple[Attempt, ...]


class Memory(Wire):
    """What is remembered of one bin, oldest first."""

    attempts: tuple[Attempt, ...] = ()
    look: Look | None = None


NO_MEMORY = Memory()
