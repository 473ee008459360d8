"""Plausibility: what no real rig looks like, however small its residuals; each fault is one sentence that says what to do."""

from collections.abc import Iterator

import numpy as np

from binpick.rig import Rig, RigCamera
from binpick_calib.lens import folds

SQUEEZED = 0.02
"""fx against fy: pixels are square to 0.1 % in every camera of today; the rest is the calibration's own doubt."""
OFF_CENTRE = 0.25
"""The principal point from the image's middle, of the image's width: lens mounts hold it within 10 %."""
FOCAL_OF_WIDTH = (0.2, 30.0)
"""Focal length of the image's width: a field of view of 136 to 2 degrees."""
BENT = 0.4
"""One term's share of a radius in the corner of the image: fisheyes apart, lenses stay below 0.3."""
DOUBTED = 0.02
"""One standard deviation of a focal length, of its value: above this the views have not determined it."""


def faults(rig: Rig) -> list[str]:
    """Everything about the rig that cannot be true; empty for a sound one."""
    lenses = [fault for camera in rig.cameras for fault in _lens_faults(camera, rig)]
    return lenses + [fault for camera in rig.cameras[1:] for fault in _baseline_faults(camera, rig)]


def _lens_faults(camera: RigCamera, rig: Rig) -> Iterator[str]:
    K, (width, height) = camera.K_px, rig.image_size_px
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    if not FOCAL_OF_WIDTH[0] * width < fx < FOCAL_OF_WIDTH[1] * width:
        yield (f"{camera.name}: a focal length of {fx:.0f} px for an image {width} px wide: "
               "the views are too few or too alike, or the image size is not that of these parameters")
        return
    if abs(fx / fy - 1) > SQUEEZED:
        yield (f"{camera.name}: fx/fy is {fx / fy:.3f}, pixels are square: the image was squeezed when it was scaled, "
               "or the views are too alike")
    if max(abs(cx - width / 2), abs(cy - height / 2)) > OFF_CENTRE * width:
        yield (f"{camera.name}: the principal point ({cx:.0f}, {cy:.0f}) px is far from the middle of {width}x{height}: "
               "the image was cropped, or the views are too few or too alike")
    yield from _distortion_faults(camera, rig)
    sigma = (rig.quality.sigma if rig.quality else None) or {}
    if sigma.get(f"{camera.name}.fx_px", 0) > DOUBTED * fx:
        yield (f"{camera.name}: the views leave the focal length open by {sigma[f'{camera.name}.fx_px']:.0f} px of {fx:.0f}: "
               "tilt the board by 20 to 40 degrees, every way")


def _distortion_faults(camera: RigCamera, rig: Rig) -> Iterator[str]:
    K, (width, height) = camera.K_px, rig.image_size_px
    terms = np.zeros(14)
    terms[:len(camera.distortion)] = camera.distortion
    corner = max(np.hypot((x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1]) for x in (0, width) for y in (0, height))
    rational = bool(terms[5:].any())
    for name, term, power in (("k1", terms[0], 2), ("k2", terms[1], 4), ("k3", terms[4], 6)):
        share = abs(term) * corner**power
        if not rational and share > BENT:
            yield (f"{camera.name}: {name} = {term:.3g} moves the corner of the image by {100 * share:.0f} % of its radius, "
                   "no lens does: too few views reach the corners, or it belongs to another image size")
    if folds(K, terms, rig.image_size_px):
        yield (f"{camera.name}: the distortion folds the image over itself before its corner: "
               "take views that fill the corners")


def _baseline_faults(camera: RigCamera, rig: Rig) -> Iterator[str]:
    T = camera.T_camera_rig
    x, y, z = -T[:3, :3].T @ T[:3, 3]
    said = (f"{camera.name} stands ({1000 * x:.0f}, {1000 * y:.0f}, {1000 * z:.0f}) mm right, below and in front of "
            f"{rig.cameras[0].name}")
    if abs(z) > max(abs(x), abs(y)):
        yield f"{said}: a baseline along the optical axis gives no depth; are the partners mixed up?"
    elif camera is rig.cameras[1] and abs(y) > abs(x):
        yield f"{said}: one above the other cannot be matched along rows; turn the rig or the images by 90 degrees"
    elif camera is rig.cameras[1] and x < 0:
        yield f"{said}: left and right are exchanged: give each side the other's images or parameters"
    if not 0.001 < np.linalg.norm(T[:3, 3]) < 5:
        yield f"{said}: check the unit: a baseline is 1 mm to 5 m"
