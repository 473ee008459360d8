"""What became of grasps that nobody spoke of: the bin as the last cycle saw it against the bin as it is now.

The rule, where a controller has read a result, told nothing of it, and triggered again:

- A published part is *gone* when at least 30 % of its volume is, and half of its cells fell: then the first of its grasps held.
  It took another part along when more than 170 % is missing there and, as what slid into the gap came from somewhere, in the
  whole bin. What fell beside it, in one patch with it, has no verdict of its own.
- When nothing changed anywhere in the bin, the first grasp missed, for that is the one a controller takes; but a robot that did
  not move looks the same. So this counts only once a part was seen to go with nobody telling, which shows that a robot works
  here and does not tell; and it puts the grasp back at first, and blocks it the second time (`binpick.grasp.memory`).
- In every other case something was touched that says nothing of a grasp, and there is no verdict.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Int32

from binpick.data import HeightMap, Mask
from binpick.grasp.memory import CHANGED_TENTHS, UNSEEN, tenths
from binpick.outcomes import DOUBLE, MISSED, OK, Attempt, Look, Memory

GONE_SHARE, FALLEN_SHARE = 0.3, 0.5
DOUBLE_SHARE = 1.7
SEEN_SHARE = 0.5
"""Of a part's cells so many must be seen both times to say anything of it."""
SOLID_CELLS, SOLID_SHARE = 5, 0.8
"""A change counts where it fills a square of 1 cm, of which half was seen both times: at edges single cells come and go."""
WALL_CELLS = 3
"""The strip along the walls, where a camera sees past the rim and mismatches."""
AROUND_CELLS = (2, 5)
"""Between so many cells from a part's outline its surroundings show how thick it is."""

Tenths = Int32[np.ndarray, "rows cols"]


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """The bin then and now: heights in tenths of a millimetre, how far each cell fell (0 where it was not seen both times),

    whose part it was (0: nobody's), and in which patch of fallen cells it lies (0: none).
    """

    before: Tenths
    fall: Tenths
    known: Mask
    parts: Tenths
    fallen: Tenths

    @classmethod
    def of(cls, look: Look, heights: HeightMap) -> "Comparison":
        """Of two maps of one bin, but for a strip along its walls."""
        before, after = look.heights.cells.astype(np.int32), tenths(heights).astype(np.int32)
        known = np.zeros(before.shape, dtype=bool)
        inner = (slice(WALL_CELLS, -WALL_CELLS),) * 2
        known[inner] = (before[inner] != UNSEEN) & (after[inner] != UNSEEN)
        fall = np.where(known, before - after, 0)
        fallen = cv2.connectedComponents((fall >= CHANGED_TENTHS).astype(np.uint8), connectivity=4)[1]
        return cls(before, fall, known, look.parts.cells.astype(np.int32), fallen)

    @property
    def untouched(self) -> bool:
        """Nowhere in the bin a square centimetre lies otherwise than it lay."""
        square = (SOLID_CELLS, SOLID_CELLS)
        changed, known = (cv2.boxFilter(cells.astype(np.float32), -1, square, normalize=False, borderType=cv2.BORDER_CONSTANT)
                          for cells in (np.abs(self.fall) >= CHANGED_TENTHS, self.known))
        return not ((changed >= SOLID_SHARE * known) & (known > SOLID_CELLS**2 / 2)).any()

    def patches(self, mine: Mask) -> frozenset[int]:
        """The patches of fallen cells that reach into a part."""
        return frozenset(np.unique(self.fallen[mine]).tolist()) - {0}

    def missing_shares(self, mine: Mask) -> tuple[float, float]:
        """What is missing where a part lay, and in the whole bin, as shares of its own volume; 0 where too little was seen.

        Where it lay goes as far as the fall does, but for what lay on other published parts. In the whole bin rises make up
        for falls.
        """
        if self.known[mine].mean() < SEEN_SHARE or (self.fall[mine & self.known] >= CHANGED_TENTHS).mean() < FALLEN_SHARE:
            return 0.0, 0.0
        thickness = _thickness(mine, self.before)
        if not thickness:
            return 0.0, 0.0
        there = np.isin(self.fallen, sorted(self.patches(mine))) & (mine | (self.parts == 0))
        changed = np.abs(self.fall) >= CHANGED_TENTHS
        own = thickness * float(mine.sum())
        return float(self.fall[there].sum()) / own, float(self.fall[changed].sum()) / own


def verified(memory: Memory, heights: HeightMap) -> tuple[Attempt, ...]:
    """The verdicts on what was published last, `source` "seen"; none without a look, or on a bin of another size."""
    look = memory.look
    if look is None or look.heights.cells.shape != heights.height.shape:
        return ()
    now = Comparison.of(look, heights)
    gone: list[Attempt] = []
    claimed: frozenset[int] = frozenset()
    for attempt in look.attempts:
        mine = now.parts == attempt.grasp
        if not mine.any() or now.patches(mine) & claimed:
            continue
        there, everywhere = now.missing_shares(mine)
        if there >= GONE_SHARE:
            claimed |= now.patches(mine)
            gone.append(_seen(attempt, DOUBLE if min(there, everywhere) > DOUBLE_SHARE else OK))
    if gone or not memory.silent or not now.untouched:
        return tuple(gone)
    return (_seen(look.attempts[0], MISSED),)


def _seen(attempt: Attempt, outcome: int) -> Attempt:
    return attempt.model_copy(update={"outcome": outcome, "source": "seen"})


def _thickness(mine: Mask, before: Tenths) -> float:
    """How far a part stands above what lies lower around it, in tenths of a millimetre; 0 where nothing does.

    Of what lies on others this is an upper limit: one sees past them further down.
    """
    inner, outer = (cv2.dilate(mine.astype(np.uint8), np.ones((2 * reach + 1,) * 2, dtype=np.uint8)) for reach in AROUND_CELLS)
    around: Bool[np.ndarray, "rows cols"] = (outer > inner) & (before != UNSEEN)
    top = before[mine & (before != UNSEEN)]
    if not top.size:
        return 0.0
    steps = np.median(top) - before[around]
    steps = steps[steps > CHANGED_TENTHS]
    return float(np.median(steps)) if steps.size else 0.0
