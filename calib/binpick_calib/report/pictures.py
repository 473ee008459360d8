"""Pictures: photographs inside the page: rectified pairs under scan lines, and small prints of what was not used."""

import base64
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from binpick.data import Image
from binpick.rig import Rig
from binpick_calib.residuals import rectification
from binpick_calib.views import read

PAIR_PX = 560
"""Width of each picture of a pair: two of them side by side still show a row's error of two pixels."""
THUMB_PX = 200
SCAN_LINES = 15


def png(image: Image) -> str:
    """The picture as an address that holds it."""
    return "data:image/png;base64," + base64.b64encode(cv2.imencode(".png", image)[1].tobytes()).decode("ascii")


def small(image: Image, width: int) -> UInt8[np.ndarray, "_ _"]:
    """At most that wide."""
    if image.shape[1] <= width:
        return image
    return np.asarray(cv2.resize(image, (width, round(image.shape[0] * width / image.shape[1])), interpolation=cv2.INTER_AREA),
                      dtype=np.uint8)


def thumbnail(path: Path) -> str:
    """An `img`, or a word where there is no picture."""
    image = read(path)
    return '<span class="none">cannot be shown</span>' if image is None else f'<img alt="" src="{png(small(image, THUMB_PX))}">'


def rectified(rig: Rig, left: Image, right: Image) -> str:
    """Both pictures turned onto common rows, side by side, with lines right across: a line meets the same corner in both.

    Each is slid along its rows until its middle is in view, which a verged pair's would not be.
    """
    R1, R2, P1, P2, _ = rectification(rig)
    size = np.array(rig.image_size_px)
    sides = list(zip((left, right), rig.cameras[:2], (R1, R2), (P1[:, :3].copy(), P2[:, :3].copy()), strict=True))
    middles = [cv2.undistortPoints(size / 2, c.K_px, c.distortion_coefficients, R=R, P=P)[0, 0] for _, c, R, P in sides]
    down = float(np.mean([size[1] / 2 - middle[1] for middle in middles]))
    flat = []
    for (image, camera, R, P), middle in zip(sides, middles, strict=True):
        P[:2, 2] += size[0] / 2 - middle[0], down
        maps = cv2.initUndistortRectifyMap(camera.K_px, camera.distortion_coefficients, R, P, rig.image_size_px, cv2.CV_32FC1)
        bright = cv2.convertScaleAbs(image, alpha=255 / max(float(np.quantile(image, 0.99)), 1.0))
        turned = cv2.remap(bright, *maps, cv2.INTER_LINEAR)
        flat.append(small(np.asarray(turned, dtype=np.uint8), PAIR_PX))
    both = np.hstack(flat)
    height, width = both.shape
    lines = "".join(f"M0 {(n + 0.5) * height / SCAN_LINES:.1f}H{width}" for n in range(SCAN_LINES))
    return (f'<svg class="pair" viewBox="0 0 {width} {height}" role="img"><image width="{width}" height="{height}" '
            f'href="{png(both)}"/><path class="scan" d="{lines}"/></svg>')
