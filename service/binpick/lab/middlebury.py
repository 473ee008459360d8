"""Middlebury's 2014 scenes: plain SGBM and ours on real images with ground truth, on the pixels that both cameras see."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32

from binpick.data import Image, Mask, Rectified
from binpick.errors import InputError
from binpick.lab import methods
from binpick.lab.stereo import Field, absolute, plain_matcher, score
from binpick.settings import PRESETS, StereoSettings
from binpick.stereo import depth, rectify

FILES = ("im0.png", "im1.png", "calib.txt", "disp0GT.pfm", "mask0nocc.png")
HALVINGS = 9
NOT_OCCLUDED = 255
"""In mask0nocc.png; 128: hidden from the right camera, 0: unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class RealScene:
    """One pair, its true disparity in px (inf: unknown) and the pixels to judge."""

    name: str
    rectified: Rectified
    truth: Float32[np.ndarray, "h w"]
    judged: Mask


def scenes(folder: Path) -> Iterator[RealScene]:
    """The scenes of a folder, one sub-folder each, by name. Raises InputError when there are none or one is broken."""
    found = sorted(path.parent for path in folder.glob("*/calib.txt"))
    if not found:
        raise InputError(f"{folder}: no Middlebury scenes here: sub-folders with {', '.join(FILES)} are expected")
    for place in found:
        if missing := [name for name in FILES if not (place / name).is_file()]:
            raise InputError(f"{place}: {', '.join(missing)} missing")
        truth = pfm(place / "disp0GT.pfm")
        pair = rectify.whole(_grey(place / "im0.png"), _grey(place / "im1.png"), 0, disparities(place / "calib.txt"))
        judged = np.asarray(_grey(place / "mask0nocc.png") == NOT_OCCLUDED) & np.isfinite(truth)
        yield RealScene(place.name, pair, truth, judged)


def marks(scene: RealScene) -> dict[str, Any]:
    """Plain SGBM and ours on OpenCV's five paths, with the same range; `less` is how much lower ours is, 0 to 1.

    Left of the search range OpenCV matches nothing: `plain_sgbm_bare` gets the images as they are, as everybody calls it, and
    `plain_sgbm` with their left border repeated, as ours does. Errors compare at equal density only: `quality` is the preset as
    it stands, `at_density_of` the same with the risk limit at which it measures as much as each of the others; `less` is there,
    and None where it never measures as much.
    """
    pair = scene.rectified
    matcher = plain_matcher(pair.window.num_disparities, cv2.STEREO_SGBM_MODE_SGBM)
    bare = replace(pair, left=pair.left[:, pair.margin :], right=pair.right[:, pair.margin :], margin=0)
    maps = {name: absolute(np.asarray(matcher.compute(images.left, images.right), dtype=np.int16), images)
            for name, images in ((methods.PLAIN, pair), ("plain_sgbm_bare", bare))}
    maps["quality"] = depth.measure(pair, methods.five_paths(PRESETS["quality"])).disparity
    rows = {name: _row(scene, disparity) for name, disparity in maps.items()}
    settings = methods.five_paths(PRESETS["quality"])
    equal = {name: _at_density(scene, settings, rows[name]["density"]) for name in (methods.PLAIN, "plain_sgbm_bare")}
    less = {name: {k: round(1 - equal[name][k] / rows[name][k], 3)
                   if rows[name][k] and equal[name]["density"] >= rows[name]["density"] else None for k in ("bad1", "bad2")}
            for name in equal}
    return {"disparities": pair.window.num_disparities, **rows, "at_density_of": equal, "less": less}


def _at_density(scene: RealScene, settings: StereoSettings, density: float) -> dict[str, float]:
    """The row of the smallest risk limit that measures that much, found by halving; of the largest when none does."""
    low, high = 0.0, 1.0
    row = _row(scene, depth.measure(scene.rectified, settings.model_copy(update={"max_risk": high})).disparity)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        tried = _row(scene, depth.measure(scene.rectified, settings.model_copy(update={"max_risk": middle})).disparity)
        if tried["density"] >= density:
            high, row = middle, tried
        else:
            low = middle
    return {**row, "max_risk": round(high, 4)}


def _row(scene: RealScene, disparity: Field) -> dict[str, float]:
    judged = score(disparity, scene.truth, scene.judged, scene.judged)
    return {"density": round(judged.density, 4), "bad1": round(judged.bad1, 4), "bad2": round(judged.bad2, 4),
            "median_px": round(judged.median_px, 4)}


def disparities(calib: Path) -> int:
    """`ndisp` of a calib.txt, whose lines are `key = value` with any spacing. Raises InputError."""
    for line in calib.read_text(encoding="utf-8").splitlines():
        key, _, value = line.partition("=")
        if key.strip() == "ndisp" and value.strip().isdecimal():
            return int(value)
    raise InputError(f"{calib}: no line `ndisp=<number>`")


def pfm(path: Path) -> Float32[np.ndarray, "h w"]:
    """A grey PFM file, top row first. Raises InputError.

    Its scale line is read for the byte order only, as Middlebury means it; OpenCV's reader multiplies by it.
    """
    with path.open("rb") as file:
        kind, size, scale = (file.readline().split() for _ in range(3))
        values = file.read()
    try:
        (columns, rows), order = map(int, size), "<f4" if float(scale[0]) < 0 else ">f4"
        if kind != [b"Pf"]:
            raise ValueError("not a grey PFM")
        grid = np.frombuffer(values, order).reshape(rows, columns)
    except (ValueError, IndexError) as error:
        raise InputError(f"{path}: not a grey PFM file: {error}") from error
    return np.ascontiguousarray(grid[::-1], dtype=np.float32)


def _grey(path: Path) -> Image:
    image: Image | None = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise InputError(f"{path}: not an image that can be read")
    return image
