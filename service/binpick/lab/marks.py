"""The stereo exam's marks: every figure of a series of scenes, as DESIGN defines them, for machines.

All shares and medians are over the measured pixels of parts, pooled over the scenes; density is over the pixels of parts that
both cameras see.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32

from binpick.lab import depths, methods
from binpick.lab.depths import Answer, Marked, Series

PLACES = {"planes": depths.PLANE, "curved": depths.CURVED, "edges": depths.EDGE}
CLIP_PX = 1.0
"""A bias is the mean signed error with each error cut to ± this: a few wild matches are no bias."""
Figures = dict[str, Any]
Errors = Float32[np.ndarray, "n"]


def figures(series: Series, scenes: Sequence[Marked]) -> Figures:
    """All figures of one series; None where nothing was measured."""
    apart = (methods.PLAIN, *methods.OURS)
    return {
        "world": series.world, "kinds": series.kinds, "projector": series.projector,
        "shots": max(1, len(series.shots)),
        "seeds": [s.seed for s in scenes],
        "part_pixels": sum(len(s.truth_px) for s in scenes),
        "rows": {name: _row(scenes, name) for name in scenes[0].answers},
        "splits": {name: _split(scenes, name) for name in apart},
        "sigma": {name: [{"seed": s.seed, **_calibration(s, s.answers[name])} for s in scenes] for name in methods.OURS},
        "scenes": {name: [{"seed": s.seed, **_row([s], name)} for s in scenes] for name in apart},
    }


def _row(scenes: Sequence[Marked], name: str) -> Figures:
    """One method's line of the table."""
    error = _errors(scenes, name)
    visible = np.concatenate([s.visible_both for s in scenes])
    planes = [_bias(s.answers[name].error_px[s.region == depths.PLANE]) for s in scenes]
    return {
        **_accuracy(error, visible),
        "plane_bias_px": _bias(error[_where(scenes, depths.PLANE)]),
        "plane_bias_worst_px": max((b for b in planes if b is not None), key=abs, default=None),
        "dz_median_mm": _rounded(np.median(known), 3) if (known := _depth_errors_mm(scenes, name)).size else None,
        "time_ms": _rounded(1000 * np.median([t for s in scenes for t in s.answers[name].seconds]), 1),
        "times_plain": _rounded(np.median([_ratio(s, name) for s in scenes]), 2),
    }


def _split(scenes: Sequence[Marked], name: str) -> Figures:
    """One method on planes, round faces and edges apart."""
    error, visible = _errors(scenes, name), np.concatenate([s.visible_both for s in scenes])
    split = {}
    for place, number in PLACES.items():
        here = _where(scenes, number)
        split[place] = {"share_of_part_pixels": _share(here), **_accuracy(error[here], visible[here]),
                        "bias_px": _bias(error[here])}
    return split


def _accuracy(error: Errors, visible: Bool[np.ndarray, "n"]) -> Figures:
    measured = np.isfinite(error)
    size = np.abs(error[measured])
    return {
        "density": _share(measured[visible]),
        "bad05": _share(size > 0.5), "bad1": _share(size > 1), "bad2": _share(size > 2),
        "median_px": _rounded(np.median(size), 4) if size.size else None,
        "p95_px": _rounded(np.percentile(size, 95), 3) if size.size else None,
    }


def _calibration(scene: Marked, answer: Answer) -> Figures:
    """How often a scene's errors stay within the sigma claimed for them; 68.3 % and 95.4 % for a normal distribution."""
    assert answer.sigma_px is not None
    measured, edge = np.isfinite(answer.error_px), scene.region == depths.EDGE
    size, sigma = np.abs(answer.error_px), answer.sigma_px
    off = measured & ~edge
    near = measured & edge
    return {"within_1": _share((size <= sigma)[off]), "within_2": _share((size <= 2 * sigma)[off]),
            "edges_within_1": _share((size <= sigma)[near]), "sigma_median_px": _rounded(np.median(sigma[off]), 3)
            if off.any() else None}


def _depth_errors_mm(scenes: Sequence[Marked], name: str) -> Errors:
    """|dz| of the measured pixels, from z = f b / d."""
    errors = []
    for scene in scenes:
        error = scene.answers[name].error_px
        there = np.isfinite(error)
        true, found = scene.truth_px[there], (scene.truth_px + error)[there]
        errors.append(np.abs(np.float32(1000 * scene.depth_scale) * (1 / true - 1 / np.maximum(found, np.float32(1e-3)))))
    return np.concatenate(errors).astype(np.float32)


def _errors(scenes: Sequence[Marked], name: str) -> Errors:
    return np.concatenate([s.answers[name].error_px for s in scenes])


def _where(scenes: Sequence[Marked], place: int) -> Bool[np.ndarray, "n"]:
    return np.concatenate([s.region == place for s in scenes])


def _bias(error: Errors) -> float | None:
    known = error[np.isfinite(error)]
    return _rounded(np.clip(known, -CLIP_PX, CLIP_PX).mean(dtype=np.float64), 4) if known.size else None


def _ratio(scene: Marked, name: str) -> float:
    """Time in plain SGBM calls, both timed on this scene within seconds of each other."""
    return float(np.median(scene.answers[name].seconds) / np.median(scene.answers[methods.PLAIN].seconds))


def _share(of: Bool[np.ndarray, "n"]) -> float | None:
    return _rounded(of.mean(), 4) if of.size else None


def _rounded(value: Any, digits: int) -> float:
    return round(float(value), digits)
