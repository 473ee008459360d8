"""What may be done to both images before they are matched: less noise, or more contrast.

The constants are the mildest of three or two tried once on four of the exam's tuning scenes under plain SGBM (no command
repeats that). Its bad-1 was 5.52 % without a filter, 5.65 % with `gaussian`, 5.26 % with `clahe`, 5.69 % with `bilateral`: none
is the default, since what blurs takes from the matcher what it lives on, and SGBM clips gradients by itself.
"""

from typing import Literal

import cv2
import numpy as np

from binpick.data import Image, frozen

Kind = Literal["none", "gaussian", "clahe", "bilateral"]

GAUSSIAN_SIGMA_PX = 0.5
"""1.0 px: bad-1 6.54 %."""
CLIP_LIMIT = 2.0
"""How steep the local contrast may get, in multiples of an even histogram; 4.0 is no better on dots and worse without."""
TILES = (8, 8)
"""OpenCV's default grid. Both images are equalised apart, so a tile of one does not show quite what the other's does."""
BILATERAL_PX = 5
BILATERAL_SIGMA_GREY = 10.0
"""Above sensor noise, below the contrast of a dot; 25: bad-1 5.91 %."""
BILATERAL_SIGMA_PX = 2.0


def prefilter(image: Image, kind: Kind) -> Image:
    """The image as the matcher shall see it; the given one is left alone."""
    if kind == "gaussian":
        return frozen(np.asarray(cv2.GaussianBlur(image, (0, 0), GAUSSIAN_SIGMA_PX), dtype=np.uint8))
    if kind == "clahe":
        return frozen(np.asarray(cv2.createCLAHE(CLIP_LIMIT, TILES).apply(image), dtype=np.uint8))
    if kind == "bilateral":
        smooth = cv2.bilateralFilter(image, BILATERAL_PX, BILATERAL_SIGMA_GREY, BILATERAL_SIGMA_PX)
        return frozen(np.asarray(smooth, dtype=np.uint8))
    return image
