"""Reasons: why a view disagrees with the others: exchanged, mirrored, a wrong partner, bad corners, or a board that moved."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from binpick import geometry
from binpick_calib import bundle as bundles
from binpick_calib.bundle import Seen
from binpick_calib.consensus import Agreement, Both, misfit_px

TELLING = 0.1
"""Of the view's misfit: an explanation that leaves no more of it is the right one, also where few views fix the lenses."""


def reason(pair: Both, pairs: Sequence[Both], found: Agreement, width_px: int) -> str:
    """What explains the view's misfit best, if anything explains it."""
    def leaves_px(first: Seen, second: Seen) -> float:
        other = Both(first._replace(camera=0), second._replace(px=_aligned(first, second), view=first.view, camera=1))
        return misfit_px(other, found.lenses, found.T_second_first)

    first, second = pair
    within_px = max(found.limit_px, TELLING * leaves_px(first, second))
    explained = {"left and right are exchanged in this view": leaves_px(second, first),
                 "both images of this view are mirrored": leaves_px(mirrored(first, width_px), mirrored(second, width_px))}
    if min(explained.values()) > within_px:    # a search over all views only where nothing nearer explains it
        explained |= {f"wrong partner: its second image belongs to the first image of view {other.first.view}":
                      leaves_px(other.first, second) for other in pairs if other is not pair}
    best = min(explained, key=lambda why: explained[why])
    if explained[best] <= within_px:
        return best
    for which, seen, lens in zip(("first", "second"), pair, found.lenses, strict=True):
        own_px = bundles.rms(bundles.misplaced_px(lens, bundles.place(lens, seen), seen))
        if own_px > within_px:
            return f"the corners of its {which} image lie {own_px:.2f} px off any flat board: the board bent, or was misread"
    return _moved(pair, found)


def _aligned(first: Seen, second: Seen) -> Float[np.ndarray, "n 2"]:
    """The second image's corners, numbered from the other end when the board lies the other way in it.

    Cameras of a rig stand upright to each other within far less than 90 degrees. A board seen in part carries numbers.
    """
    if len(first.px) != len(second.px):
        return second.px
    same_way = (first.px[-1] - first.px[0]) @ (second.px[-1] - second.px[0]) > 0
    return second.px if same_way else second.px[::-1]


def mirrored(seen: Seen, width_px: int) -> Seen:
    """The corners of the image that was flipped left to right.

    Seen in a mirror a board runs the other way: its points are mirrored too, about its own middle.
    """
    middle = seen.points_m.max(axis=0) + seen.points_m.min(axis=0)
    points = np.column_stack([middle[0] - seen.points_m[:, 0], seen.points_m[:, 1:]])
    return seen._replace(points_m=points, px=np.column_stack([width_px - 1 - seen.px[:, 0], seen.px[:, 1]]))


def _moved(pair: Both, found: Agreement) -> str:
    """How far the board moved between the two images, about its middle."""
    T_first_before = bundles.place(found.lenses[0], pair.first)
    T_first_after = geometry.inverse(found.T_second_first) @ bundles.place(found.lenses[1], pair.second)
    middle = pair.first.points_m.mean(axis=0)[None]
    way_m = np.linalg.norm(geometry.transform(T_first_after, middle) - geometry.transform(T_first_before, middle))
    turn = np.linalg.norm(bundles.pose(geometry.inverse(T_first_before) @ T_first_after)[:3])
    size_m = np.linalg.norm(np.ptp(pair.first.points_m, axis=0))
    said = f"{1000 * way_m:.1f} mm and {np.degrees(turn):.1f}° from where the others put it"
    if way_m > size_m or turn > 0.5:
        return f"wrong partner: the second image shows the board {said}"
    return f"the board moved between the two images: the second shows it {said}"
