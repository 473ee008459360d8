"""The compiled search finds what OpenCV's MODE_SGBM_3WAY finds, in both views, whoever computes it."""

from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from binpick.settings.stereo import Sgbm
from binpick.stereo import semiglobal

ND, BORDER = 48, 8
SETTINGS = [Sgbm(block_px=3, p1=48, p2=280, uniqueness_percent=15), Sgbm(), Sgbm(p1=100, p2=400, uniqueness_percent=0),
            Sgbm(block_px=11, p1=400, p2=9000, uniqueness_percent=10)]
IDS = ["quality", "default", "all", "wide"]


@pytest.fixture(scope="module")
def views() -> tuple[np.ndarray, np.ndarray]:
    """A slanted wall with a block before it, both textured, seen with noise."""
    rng = np.random.default_rng(3)
    noise = cv2.GaussianBlur(rng.uniform(0, 255, (140, 420)).astype(np.float32), (0, 0), 1.0)
    wall = np.clip(4 * (noise - noise.mean()) + 128, 0, 255)
    v, u = np.mgrid[:140, :340].astype(np.float32)
    shift = 12 + 0.04 * u
    shift[40:90, 150:230] = 37.3
    left, right = wall[:, :340], cv2.remap(wall, u + shift, v, cv2.INTER_LINEAR)
    return tuple(np.clip(view + rng.normal(0, 3, view.shape), 0, 255).astype(np.uint8) for view in (left, right))


def opencv(matcher: Sgbm) -> cv2.StereoSGBM:
    return cv2.StereoSGBM.create(0, ND, matcher.block_px, matcher.p1, matcher.p2, 1, 31, matcher.uniqueness_percent, 0, 0,
                                 mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY)


def same(found: np.ndarray, theirs: np.ndarray) -> None:
    """But for the outermost columns, some of which OpenCV marks as beyond the range."""
    found, theirs = found[:, BORDER:-BORDER], theirs[:, BORDER:-BORDER]
    ours, known = found >= 0, (theirs >= 0) & (theirs < 16 * ND)
    both = ours & known
    assert both.mean() > 0.5
    assert (ours != known).mean() < 0.01
    assert (np.abs(found - theirs)[both] <= 1).mean() >= 0.99


@pytest.mark.parametrize("matcher", SETTINGS, ids=IDS)
def test_the_left_view_is_opencvs(matcher: Sgbm, views: tuple[np.ndarray, np.ndarray]) -> None:
    same(semiglobal.of_left(*views, ND, matcher), opencv(matcher).compute(*views)[:, ND:])


@pytest.mark.parametrize("matcher", SETTINGS, ids=IDS)
def test_the_right_view_is_opencvs(matcher: Sgbm, views: tuple[np.ndarray, np.ndarray]) -> None:
    left, right = views
    padded = [cv2.copyMakeBorder(view, 0, 0, 0, ND, cv2.BORDER_REPLICATE) for view in (right, left)]
    theirs = -cv2.ximgproc.createRightMatcher(opencv(matcher)).compute(*padded)[:, :left.shape[1]]
    # theirs counts what lies in the padding as well
    same(semiglobal.of_right(left, right, ND, matcher)[:, :-ND], theirs[:, :-ND])


@pytest.fixture
def threads() -> Iterator[None]:
    before = cv2.getNumThreads()
    yield
    cv2.setNumThreads(before)


def test_one_thread_or_two_find_the_same(views: tuple[np.ndarray, np.ndarray], threads: None) -> None:
    found = set()
    for count in (1, 2):
        cv2.setNumThreads(count)
        found.add((semiglobal.of_left(*views, ND, Sgbm()).tobytes(), semiglobal.of_right(*views, ND, Sgbm()).tobytes()))
    assert len(found) == 1


def test_a_surface_goes_on_where_strips_meet(monkeypatch: pytest.MonkeyPatch, views: tuple[np.ndarray, np.ndarray]) -> None:
    whole = semiglobal.of_left(*views, ND, Sgbm())
    monkeypatch.setattr(semiglobal, "STRIP_ROWS", 20)
    assert (np.abs(semiglobal.of_left(*views, ND, Sgbm()) - whole) > 1).mean() < 0.02
