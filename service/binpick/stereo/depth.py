"""Measured disparity of a rectified pair, or of several shots: search, confirm, refine, judge."""

from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from jaxtyping import UInt8

from binpick import threads
from binpick.data import Depth, Disparity, Image, Light, Mask, Rectified, Window, frozen
from binpick.settings import StereoSettings
from binpick.settings.stereo import Hybrid, Onnx, Sgbm
from binpick.stereo import evidence, filter, graycode, prefilter, pyramid, refine, search, shots, trust, weights
from binpick.stereo.refine import Reach, Refined
from binpick.stereo.strip import Strip, joined, strips
from binpick.stereo.warp import warp
from binpick.stereo.weights import Model

STRIP_ROWS, OVERLAP_ROWS = 608, 24
"""Most rows that are refined and judged at a time, half of a camera's, and what they see beyond: planes reach 18 rows, their
bend 26 (at a border it sees two less). Strips begin at even rows, as cells of 2x2 px demand. A strip's result is the same
whoever computes it."""
TEXTURE_PX = 7
WARM_PX = 96
"""Side of the images that `warm` measures; their size matters to nothing that is compiled."""
LEAST_CONTRAST = 2
"""Grey levels between the darkest and the brightest pixel around, from which there is something to match."""


def measure(rectified: Rectified, settings: StereoSettings, guide: Image | None = None) -> Depth:
    """The disparity of the window's pixels: measured or NaN, with its own sigma.

    `guide` is the left image without the pattern, for the map for people; the left image itself when there is none.
    Raises ImageError and InputError as `search.search`.
    """
    matcher = settings.matcher
    if isinstance(matcher, Hybrid):
        fewer = settings.model_copy(update={"speckle_px": settings.speckle_px // 4})
        small = None if guide is None else pyramid.guide(guide, rectified.window)
        return pyramid.double(_measure(pyramid.shrink(rectified), matcher.shrunk, fewer, small, HALF), rectified.window)
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
    found = np.ascontiguousarray(whole[:, rectified.margin:])
    cut = strips(found.shape[0], STRIP_ROWS, OVERLAP_ROWS)
    with threads.pool("strip") as pool:
        # planes need no confidence: they are fitted beside the right view's search
        confirming = pool.submit(filter.confirm, whole, seen, matcher)
        refined = list(pool.map(lambda rows: refine.refine(found[rows.seen], rows.of(rectified), scale.reach), cut))
        confidence, views = confirming.result()
        judge = partial(_judged, found, confidence, rectified, scale.model, settings.max_risk)
        disparity, sound, sigma_px = joined(pool.map(judge, cut, refined))
        clean = partial(_cleaned, disparity, sound, settings.speckle_px)
        measured, = joined(pool.map(clean, strips(found.shape[0], STRIP_ROWS, settings.speckle_px)))
    low, nan = np.float32(rectified.window.min_disparity), np.float32(np.nan)
    disparity += low
    for field in (disparity, sigma_px):
        np.copyto(field, nan, where=~measured)
    return Depth(disparity=frozen(disparity), fill=partial(filter.fill, views, seen, settings, guide),
                 confidence=frozen(confidence), measured=frozen(measured), sigma_px=frozen(sigma_px))


def _judged(found: Disparity, confidence: UInt8[np.ndarray, "h w"], rectified: Rectified, model: Model, max_risk: float,
            strip: Strip, refined: Refined) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Disparity, whether to believe it, and its sigma, of a strip."""
    pair = strip.of(rectified)
    judged = trust.judge(evidence.gather(found[strip.seen], refined, confidence[strip.seen], pair), model)
    sound = trust.believed(refined.disparity, judged, max_risk) & _textured(refined.disparity, pair)
    return strip.inner(refined.disparity), strip.inner(sound), strip.inner(judged.sigma_px)


def _cleaned(disparity: Disparity, sound: Mask, speckle_px: int, strip: Strip) -> tuple[np.ndarray]:
    """What is sound and no speckle, of a strip. An island that is cut off has as many pixels as the overlap has rows, so that
    it counts as what it is: no speckle."""
    here = sound[strip.seen]
    return (strip.inner(here & ~trust.speckled(disparity[strip.seen], here, speckle_px)),)


def _textured(disparity: Disparity, pair: Rectified) -> Mask:
    """Where both images vary at all within a block: black and saturated areas, or a covered camera, match everything."""
    block = np.ones((TEXTURE_PX, TEXTURE_PX), dtype=np.uint8)
    left, right = (cv2.morphologyEx(image, cv2.MORPH_GRADIENT, block) for image in (pair.left[:, pair.margin:], pair.right))
    return np.asarray(cv2.min(left, warp(right, disparity, pair.margin, cv2.INTER_NEAREST)) >= LEAST_CONTRAST)


def warm(settings: StereoSettings) -> None:
    """Compiles what `measure` needs, or finds it compiled: some seconds once, that no cycle must wait for."""
    known = settings if not isinstance(settings.matcher, Onnx) else settings.model_copy(update={"matcher": Sgbm()})
    noise = np.random.default_rng(0).integers(0, 255, (2, WARM_PX, WARM_PX), np.uint8)
    left, right = (frozen(np.ascontiguousarray(image)) for image in noise)
    margin = 2 * search.STEP
    measure(Rectified(left=left, right=right, window=Window(0, 0, WARM_PX - margin, WARM_PX, 0, margin), margin=margin,
                      focal_px=1.0, baseline_m=1.0, cx_px=0.0, cy_px=0.0, T_camera_rect=np.eye(4)), known)


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
