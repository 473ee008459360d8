"""Auto exposure and auto gain: the next value from an image's mean grey; a linear sensor is right after a few images."""

from math import log10

TARGET_GREY = 100.0
TOLERANCE = 0.05
BLACK_GREY = 1.0


def settled(mean: float) -> bool:
    """Whether an image is as bright as it should be."""
    return abs(mean / TARGET_GREY - 1) <= TOLERANCE


def exposure_us(now_us: float, mean: float, low_us: float, high_us: float) -> float:
    """The next exposure; unchanged once the image is right."""
    if settled(mean):
        return now_us
    return float(min(max(now_us * TARGET_GREY / max(mean, BLACK_GREY), low_us), high_us))


def gain_db(now_db: float, mean: float, low_db: float, high_db: float) -> float:
    """The next gain, for when exposure alone does not do it; in steps of 0.1 dB."""
    if settled(mean):
        return now_db
    return round(min(max(now_db + 20 * log10(TARGET_GREY / max(mean, BLACK_GREY)), low_db), high_db), 1)
