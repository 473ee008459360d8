"""Relief: the points that a pair of images measures, coarsely in the whole view, then finely about a gauge found there."""

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Float

from binpick.data import Image, Rectified, Window
from binpick.rig import Rig
from binpick.settings.stereo import PRESETS
from binpick.stereo import cloud, depth, rectify

QUARTER = 4
NEAREST = 0.5
"""Of the image's width: a disparity beyond is nearer than cameras are mounted."""
AROUND_M = 0.02
Points = Float[np.ndarray, "n 3"]


def coarse(left: Image, right: Image, rig: Rig) -> Points:
    """Points of the whole view in the rig frame, metres, of images a quarter as large: where things are, to some mm."""
    smaller = _shrunk(rig)
    images = [cv2.resize(image, smaller.image_size_px, interpolation=cv2.INTER_AREA) for image in (left, right)]
    width, height = smaller.image_size_px
    rect = rectify.rectification(smaller)
    view = Window(0, 0, width, height, 0, 16 * int(NEAREST * width / 16))
    return measured(rectify.rectify(images[0], images[1], smaller, rectify.visible(rect, smaller, view)))


def _shrunk(rig: Rig) -> Rig:
    document = rig.model_dump()
    width, height = rig.image_size_px
    document["image_size_px"] = (width // QUARTER, height // QUARTER)
    for camera in document["cameras"]:
        K = np.array(camera["K"])
        K[:2] /= QUARTER
        K[:2, 2] -= 0.5 - 0.5 / QUARTER     # pixel centres are whole numbers
        camera["K"] = K.tolist()
    return Rig.model_validate(document)


def fine(left: Image, right: Image, rig: Rig, about: Points) -> Rectified:
    """The rectified pair at full size, of the box that holds these points."""
    rect = rectify.rectification(rig)
    low, high = about.min(0) - AROUND_M, about.max(0) + AROUND_M
    view = rectify.visible(rect, rig, rectify.window(rect, np.eye(4), low, high))
    return rectify.rectify(left, right, rig, view)


def measured(pair: Rectified) -> Points:
    """What depth measures in a pair, in the rig frame."""
    xyz = cloud.reproject(depth.measure(pair, PRESETS["quality"]), pair).xyz
    return np.asarray(xyz[np.isfinite(xyz[..., 2])], dtype=float)


def gauged(left: Image, right: Image, rig: Rig, inside: Callable[[Points], np.ndarray]) -> tuple[Rectified, Points]:
    """The pair about a gauge, and the points measured there; `inside` tells which coarse points are the gauge's."""
    points = coarse(left, right, rig)
    pair = fine(left, right, rig, points[inside(points)])
    return pair, measured(pair)
