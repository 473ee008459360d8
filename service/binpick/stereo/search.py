"""The raw search: one function from a pair to a view's disparity, whichever the matcher."""

from typing import TypeAlias, TypeGuard

import cv2
import numpy as np
from jaxtyping import Int16

from binpick.data import Disparity, Image
from binpick.errors import ImageError, InputError
from binpick.settings.stereo import Bm, Onnx, Sgbm
from binpick.stereo import network, semiglobal

SCALE = semiglobal.SCALE
STEP = 16
"""OpenCV searches multiples of this many disparities: StereoBM refuses others, StereoSGBM's documentation forbids them."""
MOST_DISPARITIES = 2032
"""The largest multiple of STEP whose disparities fit OpenCV's int16 in 1/16 px; beyond 2047 px they wrap to negative ones."""
PREFILTER_CAP = 31
"""Where SGBM clips gradients; also StereoBM's default, which its right matcher has whatever the left one's is."""
MOST_BYTES = 2 << 30
"""What a cost volume may take; the modes hh and hh4 hold all of it, the others a few rows."""
BYTES_PER_COST = 4
"""Measured on OpenCV 4.14: 231 MB for 888x600 px and 112 disparities: a cost and a sum, 16 bits each."""
MODES = {
    "sgbm": cv2.STEREO_SGBM_MODE_SGBM,
    "hh": cv2.STEREO_SGBM_MODE_HH,
    "hh4": cv2.STEREO_SGBM_MODE_HH4,
}
Plain: TypeAlias = Sgbm | Bm | Onnx
"""What searches a pair as it is; `settings.Hybrid` is Sgbm on a shrunk one (see `depth`)."""


def search(left: Image, right: Image, num_disparities: int, matcher: Plain) -> Disparity:
    """The left view's disparity, px, as found: NaN where nothing was, no other judgement yet.

    Both images share rows and a left margin of num_disparities columns, and `right` is already shifted by the smallest
    disparity (`data.Rectified`), so that what is found lies in [0, num_disparities) and never near the end of OpenCV's int16.
    The result has the images' shape; its margin means nothing. StereoBM measures nothing within half a block of the images'
    borders. All but networks drop what differs by more than 1 px on the way back from the right.
    Raises ImageError on a window too small for the block, InputError on a range or a model that cannot be used.
    """
    _check(left, num_disparities, matcher)
    if isinstance(matcher, Onnx):
        return _seen(network.disparity(left, right, matcher.model), num_disparities)
    if _compiled(matcher):
        whole = np.full(left.shape, np.nan, np.float32)
        whole[:, num_disparities:] = _pixels(semiglobal.of_left(left, right, num_disparities, matcher), num_disparities)
        return whole
    return _left_pass(left, right, _engine(matcher, num_disparities))


def search_right(left: Image, right: Image, num_disparities: int, matcher: Plain) -> Disparity:
    """The right view's disparity on the right view's grid, px, positive; NaN where nothing was found.

    A right pixel x shows what the left view has at x + disparity. OpenCV's right matcher searches -num_disparities + 1 to 0
    and so returns *negated* disparities (as its WLS filter wants them, opencv_contrib#2974), -16 * num_disparities where it
    found none; it has neither uniqueness nor left-right check, and it gives up the last num_disparities columns, so both
    images are padded there, and a match in the padding is none. A network sees the pair mirrored. Raises as `search`.
    """
    _check(left, num_disparities, matcher)
    if isinstance(matcher, Onnx):
        mirrored = network.disparity(_mirror(right), _mirror(left), matcher.model)
        return np.ascontiguousarray(_seen(mirrored, num_disparities)[:, ::-1])
    if _compiled(matcher):
        return _inside(_pixels(semiglobal.of_right(left, right, num_disparities, matcher), num_disparities))
    return _right_pass(left, right, _engine(matcher, num_disparities))


def _compiled(matcher: Sgbm | Bm) -> TypeGuard[Sgbm]:
    """Whether our own loops search, or OpenCV."""
    return isinstance(matcher, Sgbm) and matcher.mode == "3way"


def _engine(matcher: Sgbm | Bm, num_disparities: int) -> cv2.StereoMatcher:
    if isinstance(matcher, Bm):
        engine = cv2.StereoBM.create(num_disparities, matcher.block_px)
        engine.setPreFilterType(cv2.STEREO_BM_PREFILTER_XSOBEL)
        engine.setPreFilterCap(PREFILTER_CAP)
        engine.setTextureThreshold(matcher.texture_threshold)
        engine.setUniquenessRatio(matcher.uniqueness_percent)
        engine.setDisp12MaxDiff(1)
        return engine
    return cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=num_disparities, blockSize=matcher.block_px, P1=matcher.p1, P2=matcher.p2,
        disp12MaxDiff=1, preFilterCap=PREFILTER_CAP, uniquenessRatio=matcher.uniqueness_percent, speckleWindowSize=0,
        speckleRange=0, mode=MODES[matcher.mode])


def _left_pass(left: Image, right: Image, engine: cv2.StereoMatcher) -> Disparity:
    return _pixels(np.asarray(engine.compute(left, right), dtype=np.int16), engine.getNumDisparities())


def _right_pass(left: Image, right: Image, engine: cv2.StereoMatcher) -> Disparity:
    num_disparities = engine.getNumDisparities()
    padded = [cv2.copyMakeBorder(image, 0, 0, 0, num_disparities, cv2.BORDER_REPLICATE) for image in (right, left)]
    raw = np.asarray(cv2.ximgproc.createRightMatcher(engine).compute(*padded), dtype=np.int16)
    return _inside(_pixels(-raw[:, :left.shape[1]], num_disparities))


def _inside(found: Disparity) -> Disparity:
    """A right view's, without matches in what was put beside the left image."""
    reach = np.arange(found.shape[1] - 1, -1, -1, dtype=np.float32)
    found[found > reach] = np.nan
    return found


def _pixels(raw: Int16[np.ndarray, "h w"], num_disparities: int) -> Disparity:
    """1/16 px to px; OpenCV's mark for nothing found is one disparity outside the range, at either end."""
    found: Disparity = np.multiply(raw, np.float32(1 / SCALE), dtype=np.float32)
    np.copyto(found, np.float32(np.nan), where=(raw < 0) | (raw >= SCALE * num_disparities))
    return found


def _seen(found: Disparity, num_disparities: int) -> Disparity:
    """Nothing outside the range, and nothing that would have been seen outside of the other image."""
    reach = np.arange(found.shape[1], dtype=np.float32)
    with np.errstate(invalid="ignore"):
        inside = (found >= 0) & (found < num_disparities) & (found <= reach)
    return np.where(inside, found, np.float32(np.nan))


def _mirror(image: Image) -> Image:
    return np.ascontiguousarray(image[:, ::-1])


def _check(left: Image, num_disparities: int, matcher: Plain) -> None:
    """What OpenCV would answer with rubbish instead of an error (each case is a test)."""
    if num_disparities < STEP or num_disparities % STEP or num_disparities > MOST_DISPARITIES:
        raise InputError(f"{num_disparities} disparities cannot be searched: it must be a multiple of {STEP} up to "
                         f"{MOST_DISPARITIES}; bring the nearest distance further away")
    if isinstance(matcher, Onnx):
        return
    rows, cols = left.shape
    if cols - num_disparities <= matcher.block_px or rows < matcher.block_px:
        raise ImageError(f"a window of {cols - num_disparities}x{rows} px is too small for a matched block of "
                         f"{matcher.block_px} px: use a smaller block_px or a larger window")
    needed = BYTES_PER_COST * rows * cols * num_disparities
    if isinstance(matcher, Sgbm) and matcher.mode in ("hh", "hh4") and needed > MOST_BYTES:
        raise InputError(f"mode {matcher.mode} would need {needed / 2**30:.1f} GiB here: use mode 3way or sgbm")
