"""Several shots of one scene become what is matched: exposures merged, glare taken out, patterns side by side."""

from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from jaxtyping import Float32

from binpick.data import DOT_PATTERNS, Depth, Disparity, Image, Light, Rectified, frozen

Linear = Float32[np.ndarray, "h w"]
SAFE, SATURATED = 200, 250
"""Grey levels: to the first a pixel counts fully, from the second on not at all; rectifying mixes 255 with its neighbours."""
GLARE = 2.0
"""Times as bright as the median of the plain light, from which it is glare. All plain light taken out cost up to a fifth of the
measured pixels of the exam's steel and made bad-2 no better: what it shows of the parts themselves is worth matching."""
DISAGREEMENT_PX, SIGMAS = 1.0, 3.0
"""Patterns disagree when their disparities differ by more than both."""


@dataclass(frozen=True, slots=True, eq=False)
class Shots:
    """What the matcher gets: one pair per dot pattern, at least one.

    `guide` is the left image without the pattern, on the pairs' grid, where such a shot was taken.
    """

    pairs: tuple[Rectified, ...]
    guide: Image | None

    @property
    def matched(self) -> Rectified:
        """The first pattern's pair."""
        return self.pairs[0]


def combine(shots: tuple[Rectified, ...], lights: tuple[Light, ...]) -> Shots:
    """What to match of a cycle's shots; `lights` says what each was exposed with. Gray-code shots are left to `graycode`.

    Shots of one pattern that differ in exposure become one image (the longest exposure that is not saturated, brought to one
    scale, its square root taken so that dark contrast survives 8 bits). Shots without the projector show what glares by itself:
    that is taken out of the others, and they guide the filter; alone they are themselves matched. Both cameras are treated
    alike. No mask of saturated pixels is needed: a blob of them has no texture, which the filter drops, and along its rim they
    err less than others (measured on the exam's steel). Raises ValueError when there is nothing to match.
    """
    taken = list(zip(shots, lights, strict=True))
    patterns: dict[int, list[tuple[Rectified, Light]]] = {}
    for rectified, light in taken:
        if light.projector and light.pattern < DOT_PATTERNS:
            patterns.setdefault(light.pattern, []).append((rectified, light))
    plain = [(rectified, light) for rectified, light in taken if not light.projector]
    if not patterns:
        patterns, plain = {0: plain}, []
    if not patterns[min(patterns)]:
        raise ValueError("no shot to match: neither dots nor plain light")
    dots, ambient = [_view(group) for group in patterns.values()], _view(plain) if plain else None
    base = taken[0][0]
    pairs = tuple(replace(base, left=left, right=right) for left, right in (_pair(view, ambient) for view in dots))
    return Shots(pairs, ambient.compressed(0) if ambient else None)


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """Shots of one light that differ in exposure (µs, gain included) at most."""

    left: tuple[Image, ...]
    right: tuple[Image, ...]
    exposures: tuple[float, ...]

    @property
    def longest(self) -> float:
        return max(self.exposures)

    @property
    def top(self) -> float:
        """The brightest that can be told apart, in grey levels of the longest exposure."""
        return 255 * self.longest / min(self.exposures)

    def side(self, index: int) -> tuple[Image, ...]:
        return (self.left, self.right)[index]

    def linear(self, index: int) -> Linear:
        """Grey levels as the longest exposure would give them without an end of its scale."""
        order = sorted(range(len(self.exposures)), key=lambda k: -self.exposures[k])
        images = self.side(index)
        left_over = np.ones(images[0].shape, np.float32)
        total = np.zeros(images[0].shape, np.float32)
        for k in order:
            image = images[k]
            scaled = image * np.float32(self.longest / self.exposures[k])
            weight = left_over if k == order[-1] else left_over * _trust(image)
            total += weight * scaled
            left_over = left_over - weight
        return total

    def compressed(self, index: int) -> Image:
        """As it was when there is only one exposure."""
        images = self.side(index)
        return images[0] if len(images) == 1 else _compressed(self.linear(index), self.top)


def _view(group: list[tuple[Rectified, Light]]) -> _View:
    return _View(tuple(rectified.left for rectified, _ in group), tuple(rectified.right for rectified, _ in group),
                 tuple(light.exposure_us * float(10 ** (light.gain_db / 20)) for _, light in group))


def _pair(dots: _View, ambient: _View | None) -> tuple[Image, Image]:
    if ambient is None:
        return dots.compressed(0), dots.compressed(1)
    scale = np.float32(dots.longest / ambient.longest)
    plain = ambient.linear(0), ambient.linear(1)
    usual = np.float32(GLARE * (_median(plain[0]) + _median(plain[1])) / 2)
    left, right = (_compressed(cv2.max(dots.linear(side) - cv2.max(plain[side] - usual, 0.0) * scale, 0.0), dots.top)
                   for side in (0, 1))
    return left, right


def _median(plain: Linear) -> float:
    """The usual brightness; the black beyond the rectified image does not count."""
    seen = plain[plain > 0][::16]
    return float(np.median(seen)) if len(seen) else 0.0


def _compressed(linear: Linear, top: float) -> Image:
    """8 bits; a scale that is longer than that by its square root."""
    if top > 256:         # equal exposures may differ by rounding
        linear = cv2.sqrt(linear * np.float32(255 / top * 255))
    image: Image = np.asarray(cv2.convertScaleAbs(linear), np.uint8)
    return frozen(image)


def _trust(image: Image) -> Linear:
    """1 where nothing near is bright, 0 where something near is saturated."""
    peak = cv2.dilate(image, np.ones((3, 3), np.uint8))
    levels = np.clip((SATURATED - np.arange(256, dtype=np.float32)) / (SATURATED - SAFE), 0, 1)
    return np.asarray(cv2.LUT(peak, levels.astype(np.float32)), np.float32)


def fuse(depths: tuple[Depth, ...]) -> Depth:
    """The depth on which all patterns agree; the map for people is their mean, the confidence that of the least sure."""
    if len(depths) == 1:
        return depths[0]
    disparity, sigma_px = agree(tuple(depth.disparity for depth in depths), tuple(depth.sigma_px for depth in depths))
    confidence = np.minimum.reduce([depth.confidence for depth in depths])
    return Depth(disparity=disparity, fill=partial(_filled, depths), confidence=frozen(confidence),
                 measured=frozen(np.isfinite(disparity)), sigma_px=sigma_px)


def _filled(depths: tuple[Depth, ...]) -> Disparity:
    return np.asarray(np.mean([depth.filled for depth in depths], axis=0, dtype=np.float32))


def agree(disparities: tuple[Disparity, ...], sigmas: tuple[Disparity, ...]) -> tuple[Disparity, Disparity]:
    """One disparity and its sigma of several measurements of one view (px, NaN: not measured), weighted by 1/sigma².

    A pixel is kept where all of them measured it, with a spread within 1 px or 3 sigma of a difference of the least certain.
    """
    if len(disparities) == 1:
        return disparities[0], sigmas[0]
    shape = disparities[0].shape
    weights, total = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    low, high = np.full(shape, np.inf, np.float32), np.full(shape, -np.inf, np.float32)
    widest, everywhere = np.zeros(shape, np.float32), np.ones(shape, bool)
    for disparity, sigma in zip(disparities, sigmas, strict=True):
        measured = np.isfinite(disparity)
        weight = np.where(measured, 1 / sigma**2, 0).astype(np.float32)
        weights += weight
        total += weight * np.where(measured, disparity, 0)
        low, high = np.fmin(low, disparity), np.fmax(high, disparity)
        widest = np.fmax(widest, sigma)
        everywhere &= measured
    limit = np.maximum(np.float32(DISAGREEMENT_PX), np.float32(SIGMAS * np.sqrt(2)) * widest)
    kept = everywhere & ~(high - low > limit)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean, sigma = total / weights, 1 / np.sqrt(weights)
    nan = np.float32(np.nan)
    return frozen(np.where(kept, mean, nan)), frozen(np.where(kept, sigma, nan))
