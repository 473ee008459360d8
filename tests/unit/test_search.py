"""The raw search measures planted shifts with every matcher, in both views; and OpenCV's traps, each shown, each avoided."""

import subprocess
import sys

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from binpick.errors import ImageError, InputError
from binpick.settings.stereo import Bm, Sgbm
from binpick.stereo.search import MOST_DISPARITIES, Plain, search, search_right

ND = 64
MATCHERS = [Sgbm(), Sgbm(mode="sgbm"), Sgbm(mode="hh"), Sgbm(mode="hh4"), Bm()]
IDS = ["3way", "sgbm", "hh", "hh4", "bm"]
MODES = {"3way": cv2.STEREO_SGBM_MODE_SGBM_3WAY, "sgbm": cv2.STEREO_SGBM_MODE_SGBM, "hh": cv2.STEREO_SGBM_MODE_HH,
         "hh4": cv2.STEREO_SGBM_MODE_HH4}


def texture(rows: int, cols: int, seed: int = 1) -> np.ndarray:
    noise = cv2.GaussianBlur(np.random.default_rng(seed).uniform(0, 255, (rows, cols)).astype(np.float32), (0, 0), 1.0)
    return np.clip(4 * (noise - noise.mean()) + 128, 0, 255).astype(np.uint8)


def planted(shift: int, rows: int = 100, cols: int = 260, noise: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """The left view, and a right view in which everything lies `shift` px further left; both with their own noise."""
    seen, rng = texture(rows, cols + 100), np.random.default_rng(2)
    left, right = seen[:, :cols], seen[:, shift:cols + shift]
    return tuple(np.clip(image + rng.normal(0, noise, image.shape), 0, 255).astype(np.uint8) for image in (left, right))


def stepped(low: int, high: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A near block before a far wall, and the left view's true disparity (NaN where the right view does not see the wall)."""
    wall, block = texture(100, 400), texture(100, 400, seed=5)
    left, right = wall[:, :260].copy(), wall[:, low:260 + low].copy()
    left[30:70, 140:200] = block[30:70, 140:200]
    right[30:70, 140 - high:200 - high] = block[30:70, 140:200]
    true = np.full(left.shape, float(low))
    true[30:70, 140:200] = high
    true[30:70, 140 - (high - low):140] = np.nan
    return left, right, true


@pytest.mark.parametrize("matcher", MATCHERS, ids=IDS)
@pytest.mark.parametrize("shift", [2, 21, 52])
def test_a_planted_shift_is_found_in_both_views(matcher: Plain, shift: int):
    left, right = planted(shift)
    border = 8 if isinstance(matcher, Bm) else 2
    for found, inside in ((search(left, right, ND, matcher), np.s_[border:-border, ND + border:-border]),
                          (search_right(left, right, ND, matcher), np.s_[border:-border, border:-shift - border])):
        assert found.shape == left.shape
        assert found.dtype == np.float32
        assert np.nanmedian(np.abs(found[inside] - shift)) < 0.15
        assert np.isfinite(found[inside]).mean() > 0.9
        assert np.nanmin(found) >= 0
        assert np.nanmax(found) < ND


@pytest.mark.parametrize("matcher", MATCHERS, ids=IDS)
def test_the_right_view_is_searched_up_to_its_last_column(matcher: Plain):
    left, right = planted(5)
    tail = search_right(left, right, ND, matcher)[10:-10, -ND:-16]
    assert np.isfinite(tail).mean() > 0.8
    # and what would lie outside of the left view is nothing
    reach = np.arange(left.shape[1])[::-1]
    assert not (np.nan_to_num(search_right(left, right, ND, matcher)) > reach).any()


def test_what_the_right_view_does_not_see_is_mostly_nothing():
    left, right, true = stepped(10, 40)
    found = search(left, right, ND, Sgbm())
    hidden = np.isnan(true)
    hidden[:, :ND] = False
    # not all of it: OpenCV looks at the way back of the nearest whole pixel only
    assert np.isfinite(found[hidden]).mean() < 0.6
    assert (np.abs(found - true)[:, ND:] > 1).mean() < 0.04


def test_bm_measures_nothing_within_half_a_block_of_the_border():
    left, right = planted(20)
    found = np.isfinite(search(left, right, ND, Bm(block_px=15)))
    rows, cols = np.nonzero(found)
    assert (rows.min(), rows.max()) == (7, left.shape[0] - 8)
    assert cols.min() >= ND + 6
    assert cols.max() <= left.shape[1] - 8


# OpenCV's traps: what it does (a test fails when a new version does better), and that the search is safe from it


def opencv(mode: str, num_disparities: int, block: int = 5, low: int = 0, p2: int = 800) -> cv2.StereoSGBM:
    return cv2.StereoSGBM.create(low, num_disparities, block, 200, p2, 1, 31, 5, 0, 0, MODES[mode])


def test_bm_answers_a_narrow_image_with_memory_it_never_wrote_and_we_refuse():
    engine = cv2.StereoBM.create(64, 15)
    narrow = texture(60, 70), texture(60, 70, 2)
    raw = engine.compute(*narrow)
    # neither a disparity below 64 px nor its mark for nothing
    assert raw.max() >= 64 * 16
    for width in (1, 6, 14, 15):
        with pytest.raises(ImageError, match="too small for a matched block of 15 px"):
            search(texture(60, 64 + width), texture(60, 64 + width, 2), 64, Bm())
    assert np.nanmax(search(texture(60, 80), texture(60, 80, 2), 64, Bm()), initial=0) < 64


@pytest.mark.parametrize("mode", ["3way", "sgbm", "hh", "hh4"])
def test_sgbm_on_a_window_narrower_than_its_block_is_refused(mode: str):
    """opencv#25828: it read beyond its costs, differently each time.

    Version 4.14 raises an error for two modes up to half a block, says nothing in the two others, and asks for 18 exabytes
    where the margin fills the image. We want a whole block.
    """
    two_blocks_wide = texture(40, 64 + 2, 1), texture(40, 64 + 2, 2)
    if mode in ("sgbm", "hh"):
        with pytest.raises(cv2.error):
            opencv(mode, 64).compute(*two_blocks_wide)
    else:
        assert opencv(mode, 64).compute(*two_blocks_wide).shape == (40, 66)
    for width in (-4, 0, 1, 2, 5):
        with pytest.raises(ImageError, match="too small for a matched block of 5 px"):
            search(texture(40, 64 + width), texture(40, 64 + width, 2), 64, Sgbm(mode=mode))
    narrow = texture(40, 70), texture(40, 70, 2)
    first = search(*narrow, 64, Sgbm(mode=mode))
    for seed in range(5):
        # somebody else's freed memory lies where the costs will
        np.random.default_rng(seed).integers(0, 255, 300_000)
        assert np.array_equal(search(*narrow, 64, Sgbm(mode=mode)), first, equal_nan=True)


@pytest.mark.parametrize("low", [0, 40])
def test_nothing_found_is_one_below_the_smallest_disparity_in_sixteenths_and_nan_here(low: int):
    left, right = texture(60, 200), texture(60, 200, 2)
    assert opencv("3way", 64, low=low).compute(left, right).min() == (low - 1) * 16
    engine = cv2.StereoBM.create(64, 15)
    engine.setMinDisparity(low)
    assert engine.compute(left, right).min() == (low - 1) * 16
    for matcher in MATCHERS:
        found = search(left, right, ND, matcher)
        assert np.isnan(found).any()
        assert np.nanmin(found) >= 0


def test_the_right_matcher_negates_and_marks_nothing_below_that_and_we_give_positive_pixels():
    """opencv_contrib#2974: the WLS filter wants its right disparity negative; nothing found is far below, not above."""
    left, right = planted(20)
    raw = cv2.ximgproc.createRightMatcher(opencv("3way", 64)).compute(right, left)
    assert np.median(raw[:, :-64]) == pytest.approx(-20 * 16, abs=2)
    assert (raw[:, -60:] == -64 * 16).all(), "its last columns are lost"
    assert np.nanmedian(search_right(left, right, 64, Sgbm())) == pytest.approx(20, abs=0.15)


def test_the_right_matcher_of_bm_forgets_the_prefilter():
    left, right = planted(20, noise=6.0)
    engine = cv2.StereoBM.create(64, 15)
    engine.setPreFilterCap(20)
    forgetful = cv2.ximgproc.createRightMatcher(engine).compute(right, left)
    same = cv2.StereoBM.create(64, 15)
    for setting, number in (("MinDisparity", -63), ("UniquenessRatio", 0), ("TextureThreshold", 0), ("Disp12MaxDiff", 1000000)):
        getattr(same, f"set{setting}")(number)
    assert (forgetful == same.compute(right, left)).all()
    same.setPreFilterCap(20)
    assert (forgetful != same.compute(right, left)).any()
    # so the search keeps the default in both views: they agree
    ours = cv2.StereoBM.create(64, 15)
    assert ours.getPreFilterCap() == 31
    assert ours.getPreFilterType() == cv2.STEREO_BM_PREFILTER_XSOBEL


def test_blocks_above_eleven_are_refused():
    """opencv#5036 reports artefacts; on these textures version 4.14 shows none, but its documentation stops at 11, too."""
    assert (opencv("3way", 64, block=13).compute(*planted(20, noise=0.0))[:, 64:-2] == 320).mean() > 0.95
    with pytest.raises(ValidationError, match="block_px"):
        Sgbm(block_px=13)


@pytest.mark.parametrize("mode", ["3way", "sgbm", "hh", "hh4"])
def test_large_penalties_overflow_sixteen_bits_and_are_refused(mode: str):
    left, right = planted(20, noise=0.0)
    raw = opencv(mode, 64, p2=33000).compute(left, right)
    assert (np.abs(raw[:, 64:-2] - 320) > 16).mean() > 0.95
    with pytest.raises(ValidationError, match="p2"):
        Sgbm(mode=mode, p2=20001)
    found = search(left, right, 64, Sgbm(mode=mode, p2=20000))[:, 64:-2]
    assert (np.abs(found - 20) < 1).mean() > 0.95


def test_a_range_in_odd_numbers_is_refused():
    left, right = planted(20)
    with pytest.raises(cv2.error, match="divisible by 16"):
        cv2.StereoBM.create(24, 15).compute(left, right)
    # StereoSGBM takes what its documentation forbids
    assert np.median(opencv("3way", 24).compute(left, right)[:, 24:-4]) == pytest.approx(320, abs=2)
    for number in (0, -16, 24, MOST_DISPARITIES + 16):
        for matcher in MATCHERS:
            with pytest.raises(InputError, match="multiple of 16"):
                search(left, right, number, matcher)


def test_disparities_beyond_2047_px_wrap_in_opencv_but_a_shifted_right_image_never_gets_there():
    seen = texture(24, 2500)
    far_right = np.zeros_like(seen)
    far_right[:, :-2060] = seen[:, 2060:]
    raw = opencv("3way", 32, low=2048).compute(seen, far_right)
    assert np.median(raw[:, -50:]) == 2060 * 16 - 65536
    # as rectify does: the smallest disparity is in the images already
    shifted = np.roll(far_right, 2048, axis=1)
    found = search(seen[:, 2060 - 32:], shifted[:, 2060 - 32:], 32, Sgbm())
    assert np.nanmedian(found[:, 64:]) == 12


@pytest.mark.parametrize("matcher", MATCHERS, ids=IDS)
def test_threads_do_not_change_a_single_bit(matcher: Plain):
    left, right = planted(20, rows=160, cols=400, noise=8.0)
    threads = cv2.getNumThreads()
    results = []
    try:
        for count in (1, 2, 3):
            cv2.setNumThreads(count)
            results.append((search(left, right, ND, matcher).tobytes(), search_right(left, right, ND, matcher).tobytes()))
    finally:
        cv2.setNumThreads(threads)
    assert results[0] == results[1] == results[2]


PEAK = """
import sys
import cv2, numpy as np
left = np.random.default_rng(1).integers(0, 255, (400, 712), dtype=np.uint8)
engine = cv2.StereoSGBM.create(0, 112, 5, 200, 800, 1, 31, 5, 0, 0, int(sys.argv[1]))
def peak():
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM"))
before = peak()
engine.compute(left, np.roll(left, -20, 1))
print(peak() - before)
"""


@pytest.mark.parametrize(("mode", "whole_volume"), [("3way", False), ("sgbm", False), ("hh", True), ("hh4", True)])
def test_hh_holds_four_bytes_a_cost_and_too_large_a_volume_is_refused(mode: str, whole_volume: bool):
    kib = int(subprocess.run([sys.executable, "-c", PEAK, str(MODES[mode])], check=True, capture_output=True, text=True).stdout)
    share = 1024 * kib / (600 * 400 * 112)
    assert (3.5 < share < 5) if whole_volume else share < 1
    # a full frame, and everything from 0.5 m on
    frame = np.zeros((1216, 1936), np.uint8)
    if whole_volume:
        for direction in (search, search_right):
            with pytest.raises(InputError, match=r"mode hh4? would need 4\.\d GiB here: use mode 3way or sgbm"):
                direction(frame, frame, 496, Sgbm(mode=mode))
