"""Advice: what to do better next time, as sentences, and what nothing in the images can tell; the weightiest first."""

from collections.abc import Iterator

import numpy as np

from binpick.rig import Rig
from binpick.rigcheck.board import Board
from binpick_calib.outlook import Outlook, blind_m
from binpick_calib.residuals import Misses, Residuals

ROW_PX = 0.2
"""Median row error above which block matching loses points."""
RMS_PX = 0.35
"""Above this corners are found badly or the board is bent; both real sets that binpick is tested on stay below 0.22."""
STANDING_OUT = 1.6
"""Times the median rms of the views: the worst sharp view of the real sets reaches 1.5."""
LOOSE = 0.003
"""Deviation of a focal length, of its value: 0.3 % of depth where the baseline does not make up for it."""
CELLS = (6, 4)
"""Parts of an image, columns and rows, that are asked whether their residuals point one way."""
FEWEST = 12
"""Corners in a part: with fewer its mean is one view's."""
LEANING = 0.5
"""Mean residual of a part of the image, of the rms: above this the lens or the board bends there in a way no term follows."""


def of(rig: Rig, fit: Residuals, ahead: Outlook) -> list[str]:
    """What to do, most telling first; a single sentence of praise when there is nothing."""
    told = [*_outlying(fit), *_residual(fit), *_determined(rig), *_unused(fit), *_depth(ahead)]
    told += [f"Take a view that shows {missing}." if "more views" not in missing else f"Take {missing}."
             for missing in fit.coverage.missing] if fit.coverage.views else []
    return told or ["Nothing: every figure is where it should be. Keep these images, and verify the rig after each knock."]


def _residual(fit: Residuals) -> Iterator[str]:
    if fit.rows.error_px > ROW_PX:
        yield (f"Rows differ by {fit.rows.error_px:.2f} px in the median; above {ROW_PX} px the matcher loses points. Solve "
               "again with sharper views, a flat board and cameras that are fixed to each other.")
    if fit.rms_px > RMS_PX:
        yield (f"Corners lie {fit.rms_px:.2f} px (rms) from where the rig puts them: glue the board onto a flat plate, light "
               "it evenly, and hold it still or shorten the exposure.")
    for name, own in zip(fit.coverage.cameras, fit.misses, strict=True):
        places = leaning(own)
        if places:
            yield (f"Residuals of the {name} image point one way in {places} of its {CELLS[0] * CELLS[1]} parts: the board is "
                   "not flat or not printed square, or few views reached there; print it anew, and take more views there.")


def leaning(own: Misses) -> int:
    """In how many parts of the image the residuals lean to one side."""
    size = own.px.max(axis=0) + 1
    column, row = np.clip(own.px / size * CELLS, 0, np.array(CELLS) - 1).astype(int).T
    part = row * CELLS[0] + column
    means = [np.linalg.norm(own.off_px[part == p].mean(axis=0)) for p in np.unique(part) if (part == p).sum() >= FEWEST]
    return int((np.array(means) > LEANING * own.rms_px).sum())


def _determined(rig: Rig) -> Iterator[str]:
    sigma = (rig.quality.sigma if rig.quality else None) or {}
    for camera in rig.cameras:
        loose_px = sigma.get(f"{camera.name}.fx_px", 0.0)
        if loose_px > LOOSE * camera.K_px[0, 0]:
            yield (f"The views leave the focal length of the {camera.name} camera open by {loose_px:.1f} px "
                   f"({100 * loose_px / camera.K_px[0, 0]:.2f} %): tilt the board by 20 to 40 degrees, every way.")


def _outlying(fit: Residuals) -> Iterator[str]:
    whole = {view: float(np.sqrt(np.nanmean(np.square(each)))) for view, each in fit.per_view_px().items()}
    usual = float(np.median(list(whole.values())))
    odd = [f"view {view}" for view, px in whole.items() if px > STANDING_OUT * usual]
    if odd:
        yield (f"Fitting more than {STANDING_OUT} times worse than the others: {', '.join(odd)}. Look there for blur, glare "
               "and a bent board, and take such views again.")


def _unused(fit: Residuals) -> Iterator[str]:
    if 4 * len(fit.rejected) > len(fit.boards):
        yield (f"{len(fit.rejected)} images or pairs were not used beside {len(fit.boards)} that were: see the reasons below, "
               "and take such views again.")


def _depth(ahead: Outlook) -> Iterator[str]:
    worse = np.flatnonzero(ahead.middle_m > ahead.matching_m)
    if len(worse) > len(ahead.distance_m) / 2:
        yield ("The calibration's doubt, not the matching, decides the depth error at most distances: more views, at the "
               "distances the rig will work at and tilted every way, would lower it.")


def untold(fit: Residuals, board: Board | None, work_m: float) -> list[str]:
    """What the images do not show, and what a watchdog that looks at rows alone cannot see later."""
    turn_mrad = 1e3 * 0.5 / fit.fitted.lenses[1].values[0]
    off_m = blind_m(fit.fitted, work_m, turn_mrad / 1e3)
    side = f"{1000 * board.square_m:g} mm between neighbours" if board else "its true side"
    return [
        (f"The scale: the board is taken at its word ({side}). A print 0.5 % too large makes every distance 0.5 % too short: "
         "measure it over its whole length."),
        ("A turn of the second camera about its vertical axis: rows stay as they are, and depth goes wrong. "
         f"{turn_mrad:.2f} mrad, half a pixel, put a part at {work_m:.2f} m off by {1000 * off_m:.1f} mm."),
        "A longer or shorter baseline, and focal lengths that change alike (warmth): rows stay, all distances scale.",
        "A move of the whole rig against the cell: both images change alike. Poses in the robot's frame are wrong by it.",
        ("Reference marks fixed in the cell show all of these but the first; without marks the watchdog sees pitch and roll of "
         "one camera against the other only.")]
