"""Measured disparity of a rectified pair, or of several shots: search, confirm, refine, judge."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import UInt8

from binpick.data import Depth, Disparity, Image, Light, Mask, Rectified, frozen
from binpick.settings import StereoSettings
from binpick.settings.stereo import Hybrid, Sgbm
from binpick.stereo import evidence, filter, graycode, prefilter, pyramid, refine, search, shots, trust, weights
from binpick.stereo.refine import Reach
from binpick.stereo.trust import Trust
from binpick.stereo.weights import Model

STRIP_ROWS, OVERLAP_ROWS = 248, 24
"""Rows that are refined and judged at a time, and what they see beyond: the widest window reaches 17 rows. Both are even, as
cells of 2x2 px demand, and do not depend on the machine: a strip's result is the same whoever computes it."""
TEXTURE_PX = 7
LEAST_CONTRAST = 2
"""Grey levels between the darkest and the brightest pixel around, from which there is something to match."""


def measure(rectified: Rectified, settings: StereoSettings, guide: Image | None = None) -> Depth:
    """The disparity of the window's pixels: measured or NaN, with its own sigma.

    `guide` is the left image without the pattern, for the map for people; the left image itself when there is none.
    Raises ImageError and InputError as `search.search`.
    """
    matcher = settings.matcher
    if isinstance(matcher, Hybrid):
        sgbm = Sgbm.model_validate(matcher.model_dump(exclude={"kind"}))
        fewer = settings.model_copy(update={"speckle_px": settings.speckle_px // 4})
        small = None if guide is None else pyramid.guide(guide, rectified.window)
        return pyramid.double(_measure(pyramid.shrink(rectified), sgbm, fewer, small, HALF), rectified.window)
    return _measure(rectified, matcher, settings, guide, FULL)


@dataclass(frozen=True, slots=True)
class _Scale:
    """What depends on the resolution."""

    reach: Reach
    model: Model


FULL, HALF = _Scale(refine.FULL, weights.FULL), _Scale(refine.HALF, weights.HALF)


def _measure(rectified: Rectified, matcher: search.Plain, settings: StereoSettings, guide: Image | None, scale: _Scale,
             ) -> Depth:
    seen = replace(rectified, left=prefilter.prefilter(rectified.left, settings.prefilter),
                   right=prefilter.prefilter(rectified.right, settings.prefilter))
    whole = search.search(seen.left, seen.right, seen.window.num_disparities, matcher)
    confidence, filled = filter.confirm(whole, seen, matcher, settings, guide)
    found = np.ascontiguousarray(whole[:, rectified.margin:])
    disparity, judged = _refined(found, confidence, rectified, scale)
    sound = trust.measured(disparity, judged, settings.max_risk, settings.speckle_px) & _textured(rectified)
    low, nan = np.float32(rectified.window.min_disparity), np.float32(np.nan)
    return Depth(disparity=frozen(np.where(sound, disparity + low, nan)), filled=frozen(filled + low),
                 confidence=frozen(confidence), measured=frozen(sound), sigma_px=frozen(np.where(sound, judged.sigma_px, nan)))


@dataclass(frozen=True, slots=True)
class _Strip:
    """Rows `top` to `bottom` of a window, seen with those from `first` to `last`."""

    first: int
    top: int
    bottom: int
    last: int

    def inner(self, field: np.ndarray) -> np.ndarray:
        """Without the overlap."""
        return field[self.top - self.first:self.bottom - self.first]


def _refined(found: Disparity, confidence: UInt8[np.ndarray, "h w"], rectified: Rectified, scale: _Scale,
             ) -> tuple[Disparity, Trust]:
    """The refined disparity and what to think of it, strip by strip on as many threads as OpenCV is given."""
    rows = found.shape[0]
    tops = range(0, rows, STRIP_ROWS)
    strips = [_Strip(max(0, top - OVERLAP_ROWS), top, min(top + STRIP_ROWS, rows), min(top + STRIP_ROWS + OVERLAP_ROWS, rows))
              for top in tops]

    def work(strip: _Strip) -> tuple[np.ndarray, ...]:
        part = slice(strip.first, strip.last)
        pair = replace(rectified, left=rectified.left[part], right=rectified.right[part])
        refined = refine.refine(found[part], pair, scale.reach)
        judged = trust.judge(evidence.gather(found[part], refined, confidence[part], pair), scale.model)
        return tuple(strip.inner(field) for field in (refined.disparity, judged.odds, judged.sigma_px))

    with ThreadPoolExecutor(max(1, cv2.getNumThreads()), thread_name_prefix="binpick-strip") as pool:
        done = list(pool.map(work, strips))
    disparity, odds, sigma_px = (np.concatenate(fields) for fields in zip(*done, strict=True))
    return disparity, Trust(odds, sigma_px)


def _textured(rectified: Rectified) -> Mask:
    """Where the image varies at all within a block: black and saturated areas match everything equally well."""
    image = rectified.left[:, rectified.margin:]
    contrast = cv2.morphologyEx(image, cv2.MORPH_GRADIENT, np.ones((TEXTURE_PX, TEXTURE_PX), dtype=np.uint8))
    return np.asarray(contrast >= LEAST_CONTRAST)


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
