"""What may be done to both images before they are matched: less noise, or more contrast."""

from typing import Literal

import cv2
import numpy as np

from binpick.data import Image, frozen

Kind = Literal["none", "gaussian", "clahe", "bilateral"]

GAUSSIAN_SIGMA_PX = 0.7
CLIP_LIMIT = 2.0
TILES = (8, 8)
BILATERAL_PX = 5
BILATERAL_SIGMA_GREY = 25.0
BILATERAL_SIGMA_PX = 2.0


def prefilter(image: Image, kind: Kind) -> Image:
    """The image as the matcher shall see it."""
    if kind == "gaussian":
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), GAUSSIAN_SIGMA_PX), dtype=np.uint8)
    elif kind == "clahe":
        image = np.asarray(cv2.createCLAHE(CLIP_LIMIT, TILES).apply(image), dtype=np.uint8)
    elif kind == "bilateral":
        image = np.asarray(cv2.bilateralFilter(image, BILATERAL_PX, BILATERAL_SIGMA_GREY, BILATERAL_SIGMA_PX), dtype=np.uint8)
    return frozen(image)
