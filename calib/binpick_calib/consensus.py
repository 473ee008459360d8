"""Consensus: which views agree on one step between two cameras; those that do not are left out one by one, worst first."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from binpick import geometry
from binpick.geometry import Transform
from binpick_calib import bundle as bundles
from binpick_calib.bundle import Bundle, Lens, Seen

START = (0, 1, 2, 3)
"""The distortion terms that are fitted while the views are still judged: k1 k2 p1 p2 suit every lens but the widest."""
OUTLYING = 2.5
"""Times the median misfit of the views that agree; sharp views of real sets differ by 1.5 at most."""
CONTRADICTING = 2.0
"""The median itself against what each camera has by itself: above this the step is wrong for most views."""
HARMLESS_PX = 0.15
"""A misfit below this is never an outlier: corners are found to 0.02 to 0.2 px."""


class Both(NamedTuple):
    """What two cameras saw in one view; the first is camera 0, the second camera 1."""

    first: Seen
    second: Seen


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """The step that most views agree on, with each lens as its camera has it alone, and each view's misfit with both (px)."""

    lenses: tuple[Lens, Lens]
    T_second_first: Transform
    agreeing: tuple[int, ...]
    misfit_px: dict[int, float]
    limit_px: float


def alone(seen: Sequence[Seen], image_size_px: tuple[int, int]) -> Bundle:
    """One camera by itself (Zhang's method)."""
    own = [s._replace(camera=0) for s in seen]
    lens = bundles.lens_of(own, image_size_px)
    return bundles.adjust(own, [lens], [np.eye(4)], {s.view: bundles.place(lens, s) for s in own}, START)


def steps(pairs: Sequence[Both], lenses: tuple[Lens, Lens]) -> dict[int, Transform]:
    """T_second_first as each view alone would have it."""
    return {pair.first.view: bundles.place(lenses[1], pair.second) @ geometry.inverse(bundles.place(lenses[0], pair.first))
            for pair in pairs}


def crosswise_px(pairs: Sequence[Both], lenses: tuple[Lens, Lens], by_view: dict[int, Transform]) -> Float[np.ndarray, "n n"]:
    """How far (rms) the second camera's corners of view `column` lie from where the step of view `row` foretells them."""
    boards = [bundles.place(lenses[0], pair.first) for pair in pairs]
    return np.array([[bundles.rms(bundles.misplaced_px(lenses[1], by_view[row.first.view] @ board, column.second))
                      for column, board in zip(pairs, boards, strict=True)] for row in pairs])


def misfit_px(pair: Both, lenses: tuple[Lens, Lens], T_second_first: Transform) -> float:
    """What remains in both images when only the board may move."""
    start = {pair.first.view: bundles.place(lenses[0], pair.first)}
    fitted = bundles.adjust((pair.first, pair.second), lenses, (np.eye(4), T_second_first), start, (), held="rig")
    return fitted.rms_px


def misfits_px(pairs: Sequence[Both], lenses: tuple[Lens, Lens], T_second_first: Transform) -> dict[int, float]:
    """The misfit of each view."""
    return {pair.first.view: misfit_px(pair, lenses, T_second_first) for pair in pairs}


def agree(pairs: Sequence[Both], image_size_px: tuple[int, int]) -> Agreement:
    """Starts with the half of the views that one view's step foretells best, then leaves out and takes in one by one.

    Least median of squares (Rousseeuw 1984) over the steps that single views give: up to half of them may be wrong. The
    lenses are held as each camera has them alone: free, they would bend until views that contradict each other agree.
    """
    first = alone([pair.first for pair in pairs], image_size_px)
    second = alone([pair.second for pair in pairs], image_size_px)
    lenses = (first.lenses[0], second.lenses[0])
    by_view = steps(pairs, lenses)
    off_px = crosswise_px(pairs, lenses, by_view)
    half = len(pairs) // 2 + 1
    best = int(np.argmin(np.sort(off_px, axis=1)[:, half - 1]))
    used = {pairs[i].first.view for i in np.argsort(off_px[best], kind="stable")[:half]}
    return _settled(pairs, lenses, by_view[pairs[best].first.view], used, CONTRADICTING * max(first.rms_px, second.rms_px))


def _settled(pairs: Sequence[Both], lenses: tuple[Lens, Lens], T_second_first: Transform, used: set[int],
             most_px: float) -> Agreement:
    banned: set[int] = set()
    while True:
        kept = [pair for pair in pairs if pair.first.view in used]
        fitted = bundles.adjust([s for pair in kept for s in (pair.first, pair.second)], lenses, (np.eye(4), T_second_first),
                                {pair.first.view: bundles.place(lenses[0], pair.first) for pair in kept}, (), held="lenses")
        T_second_first = fitted.T_cam_rig[1]
        misfit = misfits_px(pairs, lenses, T_second_first)
        limit = max(HARMLESS_PX, OUTLYING * min(most_px, float(np.median([misfit[view] for view in used]))))
        worst = max(used, key=lambda view: misfit[view])
        more = {view for view, px in misfit.items() if px <= limit} - used - banned
        if misfit[worst] > limit and len(used) > 3:
            used, banned = used - {worst}, banned | {worst}
        elif more:
            used = used | more
        else:
            return Agreement(lenses, T_second_first, tuple(sorted(used)), misfit, limit)
