"""Coverage of a set of views: what is missing is named, a useless view is refused with the reason."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from binpick import geometry
from binpick.rigcheck import board as boards
from binpick.rigcheck.coverage import RANGE, Coverage, Tilt, look
from binpick.rigcheck.detection import Detection, Quality

BOARD = boards.parse("chessboard:9x6:0.025")
SIZE = (1600, 1200)
K = np.array([[1500.0, 0, 800], [0, 1500, 600], [0, 0, 1]])
BASELINE_M = 0.10
Pair = tuple[Detection, Detection]


def seen(x: float = 0.0, y: float = 0.0, z: float = 0.8, tilt_deg: tuple[float, float] = (0, 0), turn_deg: float = 0.0) -> Pair:
    """A pair's detections of a board whose middle is there, turned about x, about y, and in its plane."""
    R = Rotation.from_euler("zxy", [turn_deg, *tilt_deg], degrees=True).as_matrix()
    T = geometry.make(R, np.array([x, y, z]) - R @ BOARD.points_m.mean(0).astype(float))
    ids = np.arange(len(BOARD.points_m), dtype=np.int32)
    found = []
    for shift in (0.0, BASELINE_M):
        places = geometry.transform(geometry.translation(-shift, 0.0, 0.0) @ T, BOARD.points_m.astype(float))
        px = cv2.projectPoints(places, np.zeros(3), np.zeros(3), K, None)[0][:, 0].astype(np.float32)
        found.append(Detection(BOARD, SIZE, ids, px, Quality(0.8, 150.0, 30.0, 0.0, (1, 1), 0.1, 0.05)))
    return found[0], found[1]


def full() -> Coverage:
    """Twelve views that show everything: four corners, edges and the middle, tilted every way, near and far."""
    covered = Coverage()
    places = [(x, y) for y in (-0.22, 0, 0.22) for x in (-0.24, 0.05, 0.33)]
    tilts = [(30, 0), (-30, 0), (0, 30), (0, -30)]
    for (x, y), tilt in zip(places, [*tilts, (0, 0), *tilts], strict=True):
        covered = covered.add(seen(x, y, tilt_deg=tilt))
    for z in (0.6, 0.7, 1.0):
        covered = covered.add(seen(0.05, 0, z))
    return covered


@pytest.mark.parametrize(("tilt_deg", "nearer"), [((0, 0), None), ((12, 0), None), ((30, 0), Tilt.UPPER),
                                                  ((-30, 0), Tilt.LOWER), ((0, 30), Tilt.RIGHT), ((0, -30), Tilt.LEFT)])
@pytest.mark.parametrize("turn_deg", [0, 90, 170])
def test_tilt_is_read_off_one_image(tilt_deg: tuple[float, float], nearer: Tilt | None, turn_deg: float) -> None:
    # about +x the lower side (y > 0) goes away; about +y the right side comes nearer
    left, _ = seen(tilt_deg=tilt_deg, turn_deg=turn_deg)
    assert look(left).tilt == nearer
    # the angle is that to the line of sight, which leaves the axis by a degree here
    assert np.hypot(*look(left).tilt_rad) == pytest.approx(np.radians(np.hypot(*tilt_deg)), abs=0.02)


def test_scale_is_focal_length_over_distance_however_tilted() -> None:
    assert look(seen(z=0.75)[0]).scale == pytest.approx(2000, rel=0.01)
    assert look(seen(z=0.75, tilt_deg=(30, 20))[0]).scale == pytest.approx(2000, rel=0.02)


def test_a_whole_set_is_enough() -> None:
    covered = full()
    assert covered.missing == []
    assert covered.enough
    assert covered.range > RANGE
    assert all(views > 0 for views in json.loads(json.dumps(covered.summary))["tilts"].values())


def test_what_is_missing_is_named() -> None:
    covered = full()
    right_corner = [view for view in covered.views if (5, 3) not in view[1].cells and (4, 3) not in view[1].cells]
    poorer = replace(covered, views=tuple(right_corner))
    assert "the lower right corner of the right image" in poorer.missing
    square = replace(covered, views=tuple(view for view in covered.views if view[0].tilt is not Tilt.UPPER))
    assert "the board tilted, its upper side nearer" in square.missing
    assert "2 more views: there are 10 of 12" in square.missing
    near = replace(covered, views=covered.views[:9])
    assert any(sentence.startswith("the board nearer or farther: the nearest view is 1.") for sentence in near.missing)
    nothing = Coverage()
    assert not nothing.enough
    assert len(nothing.missing) == 2 * 9 + 4 + 2


def test_the_border_that_one_camera_sees_alone_is_not_asked_for() -> None:
    covered = Coverage().add(seen(z=0.6))    # the board moves by 250 of 1600 px from image to image
    assert not covered.shared(0)[:, 0].any()
    assert covered.shared(0)[:, 1:].all()
    assert not covered.shared(1)[:, -1].any()
    assert covered.summary["cells"]["left"][0][0] is None


def test_a_useless_view_is_refused_with_the_reason() -> None:
    taken = seen(0.05, 0.0)
    covered = Coverage().add(taken)
    assert covered.useful(taken) == (False, "like view 1: move, tilt or turn the board")
    assert covered.useful((None, None)) == (False, "no camera sees the board")
    assert covered.useful((taken[0], None)) == (False, "the right camera does not see the board")
    other = seen(0.05, 0.22)
    assert covered.useful(other, taken) == (False, "the board moves: 412 px since the last frame")
    assert covered.useful(other, (None, None)) == (False, "the board has just come into view")
    assert covered.useful(other, other)[0]
    faint = (replace(other[0], quality=replace(other[0].quality, contrast=14.0)), other[1])
    assert covered.useful(faint)[1] == "too dark or too faint in the left image: 14 grey levels of contrast"
    soft = (other[0], replace(other[1], quality=replace(other[1].quality, blur_px=1.4)))
    assert full().useful(soft)[1] == "blurred in the right image: edges of 1.4 px, usually 0.8"


def test_a_useful_view_says_what_is_new() -> None:
    covered = Coverage().add(seen(0.05, 0.0))
    assert covered.useful(seen(0.33, 0.22))[1] == "new: the lower right corner of the left image"
    assert covered.useful(seen(0.05, 0.0, tilt_deg=(0, 30)))[1] == "new: the board tilted, its right side nearer"
    assert covered.useful(seen(0.05, 0.0, turn_deg=40)) == (True, "new")
    assert covered.useful(seen(0.05, 0.0, z=1.1)) == (True, "new: another distance")


def test_once_there_are_enough_views_only_what_is_missing_is_taken() -> None:
    covered = full()
    other = seen(0.02, 0.12, 0.9, tilt_deg=(0, 12), turn_deg=30)
    assert covered.useful(other) == (False, "nothing is missing")
    lacking = replace(covered, views=tuple(view for view in covered.views if view[0].tilt is not Tilt.UPPER), wanted=10)
    assert lacking.useful(other)[1].startswith("still missing: the ")
    assert lacking.useful(seen(tilt_deg=(30, 0)))[0]


def test_a_board_numbered_from_its_other_end_stands_still() -> None:
    even = boards.parse("chessboard:8x6:0.025")    # looks the same upside down
    now = tuple(replace(each, board=even, ids=each.ids[:48], corners_px=each.corners_px[:48]) for each in seen())
    turned = tuple(replace(each, corners_px=np.ascontiguousarray(each.corners_px[::-1])) for each in now)
    assert Coverage().useful(turned, now)[0]


def test_one_camera_and_three() -> None:
    left, right = seen()
    alone = Coverage(cameras=("left",))
    assert alone.useful((left,))[0]
    assert alone.add((left,)).shared(0).all()
    three = Coverage(cameras=("left", "right", "third"))
    assert three.useful((left, None, right))[0]
    assert three.useful((None, left, right))[1] == "the left camera does not see the board"
    assert three.add((left, None, right)).add((left, right, right)).summary["views"] == 2
