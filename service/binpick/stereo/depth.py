"""A rectified pair's measured disparity: match, then gate; everything that wants depth calls this."""

from binpick.data import Depth, Rectified
from binpick.settings import StereoSettings
from binpick.stereo import filter, match


def measure(rectified: Rectified, settings: StereoSettings) -> Depth:
    """The disparity of the window's pixels: measured or NaN, with its own sigma."""
    return filter.measure(match.match(rectified, settings), rectified, settings)
