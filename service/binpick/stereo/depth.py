"""A rectified pair's measured disparity, or several shots': match, then gate; everything that wants depth calls this."""

from dataclasses import replace

import cv2
import numpy as np

from binpick.data import Depth, Image, Light, Rectified
from binpick.settings import StereoSettings
from binpick.stereo import filter, graycode, match, shots


def measure(rectified: Rectified, settings: StereoSettings, guide: Image | None = None) -> Depth:
    """The disparity of the window's pixels: measured or NaN, with its own sigma.

    `guide` is the left image without the pattern, for the map for people; the left image itself when there is none.
    """
    matched = match.match(rectified, settings)
    if guide is not None:
        rows, cols = matched.half_guide.shape
        small = np.asarray(cv2.resize(guide, (cols, rows), interpolation=cv2.INTER_AREA), dtype=np.uint8)
        matched = replace(matched, half_guide=small)
    return filter.measure(matched, rectified, settings)


def of_shots(taken: tuple[Rectified, ...], lights: tuple[Light, ...], settings: StereoSettings) -> tuple[Rectified, Depth]:
    """The pair that stands for a cycle's shots, and their depth; `lights` says what each was exposed with.

    A Gray code is read where there is one. Else the shots are combined, each pattern of dots is matched by itself, and a pixel
    is measured where all patterns agree. One shot is simply matched.
    """
    if graycode.complete(lights):
        return taken[0], graycode.measure(taken, lights, settings.speckle_px)
    if len(taken) == 1:
        return taken[0], measure(taken[0], settings)
    combined = shots.combine(taken, lights)
    return combined.matched, shots.fuse(tuple(measure(pair, settings, combined.guide) for pair in combined.pairs))
