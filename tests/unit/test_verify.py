"""Verification by a board: a rig that holds is good, and each way of being wrong is called by its name."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from binpick import geometry
from binpick.errors import InputError
from binpick.rig import Rig
from binpick.rigcheck import board as boards
from binpick.rigcheck.detection import Detection, Quality
from binpick.rigcheck.verdict import Verdict
from binpick.rigcheck.verify import verify

BOARD = boards.parse("charuco:11x8:0.025")
T_RIG_BOARD = geometry.make(Rotation.from_euler("xyz", [12, -18, 20], degrees=True).as_matrix(), np.array([-0.02, -0.12, 0.95]))


def look(rig: Rig, T_right_left: geometry.Transform, board: boards.Board = BOARD, T: geometry.Transform = T_RIG_BOARD,
         bend_m: float = 0.0, size: float = 1.0, noise_px: float = 0.05) -> tuple[Detection, Detection]:
    """What cameras that really stand so see of a board, bent about its y axis, with noise; the lenses are the rig's."""
    points = board.points_m.astype(float) * size
    across = 2 * (points[:, 0] - points[:, 0].mean()) / np.ptp(points[:, 0])
    points[:, 2] += bend_m * across**2
    noise = np.random.default_rng(7)
    seen = []
    for camera, T_cam_rig in zip(rig.cameras, (np.eye(4), T_right_left), strict=True):
        places = geometry.transform(T_cam_rig @ T, points)
        px = cv2.projectPoints(places, np.zeros(3), np.zeros(3), camera.K_px, camera.distortion_coefficients)[0][:, 0]
        px = (px + noise.normal(0, noise_px, px.shape)).astype(np.float32)
        quality = Quality(0.8, 150.0, 30.0, 0.2, (1, 1), 0.1, 0.05)
        seen.append(Detection(board, rig.image_size_px, np.arange(len(px), dtype=np.int32), px, quality))
    return seen[0], seen[1]


def turned(rig: Rig, pitch: float = 0.0, yaw: float = 0.0, roll: float = 0.0) -> geometry.Transform:
    """The step to the right camera after it turned in place by so many mrad, about its x, y and z."""
    T = rig.cameras[1].T_camera_rig
    return geometry.make(Rotation.from_rotvec(np.array([pitch, yaw, roll]) / 1000).as_matrix().T, np.zeros(3)) @ T


def test_a_good_rig_is_good(rig: Rig) -> None:
    told = verify(look(rig, rig.cameras[1].T_camera_rig), rig, T_RIG_BOARD)
    assert told.level == "ok"
    assert told.findings == ()
    assert told.rows.off_px < 0.03
    assert abs(told.scale_permille) < 0.3
    assert told.planarity_m < 0.0005
    assert told.offset_m < 0.0003
    assert told.sentence.startswith("Rows off by 0.0")
    assert told.sentence.endswith("The rig is good.")
    assert told.pose is not None
    assert np.array(told.pose) == pytest.approx(T_RIG_BOARD, abs=0.002)


@pytest.mark.parametrize(("px", "level"), [(0.4, "warn"), (1.2, "fault"), (-1.2, "fault")])
def test_pitch(rig: Rig, px: float, level: str) -> None:
    # looking down (positive about x) lifts what it sees by f times the angle: the row grows
    told = verify(look(rig, turned(rig, pitch=1000 * px / 1740)), rig)
    assert told.level == level
    assert told.rows.row_px == pytest.approx(px, abs=0.05)
    assert told.rows.pitch_rad == pytest.approx(px / 1740, rel=0.1)
    assert "the right camera has pitched by" in told.sentence
    assert len(told.findings) == 1


def test_roll_is_told_from_pitch(rig: Rig) -> None:
    told = verify(look(rig, turned(rig, roll=4.0), noise_px=0.03), rig)
    assert "rolled by +" in told.sentence
    assert told.rows.roll_rad == pytest.approx(0.004, rel=0.1)
    assert told.level in ("warn", "fault")


def test_scale(rig: Rig) -> None:
    shorter = geometry.translation(-0.15 / 1.005, 0.0, 0.0)
    told = verify(look(rig, shorter), rig)
    assert told.level == "fault"
    assert told.scale_permille == pytest.approx(5, abs=0.3)
    assert told.findings[0].startswith("the scale is off: distances come out 5.")
    assert "too large" in told.sentence
    assert "yaw" in told.sentence
    assert len(told.findings) == 1


def test_yaw_shows_as_scale(rig: Rig) -> None:
    told = verify(look(rig, turned(rig, yaw=0.5)), rig)     # 0.9 px of some 270
    assert told.level == "warn"
    assert abs(told.scale_permille) == pytest.approx(3.2, abs=0.5)


def test_a_bent_board_is_blamed_and_not_the_rig(rig: Rig) -> None:
    told = verify(look(rig, rig.cameras[1].T_camera_rig, bend_m=0.002), rig)
    assert told.level == "warn"
    assert told.bend_m == pytest.approx(0.002, abs=0.0003)
    assert told.findings[0].startswith("the board is bent by 2.")
    assert len(told.findings) == 1
    assert told.sentence.endswith("Verify with a flat one.")


def test_a_board_elsewhere(rig: Rig) -> None:
    moved = geometry.translation(0.003, 0.0, 0.002) @ T_RIG_BOARD
    told = verify(look(rig, rig.cameras[1].T_camera_rig, T=moved), rig, T_RIG_BOARD)
    assert told.level == "warn"
    assert told.offset_m == pytest.approx(0.0036, abs=0.0003)
    assert "from where it is expected" in told.sentence


def test_a_board_that_looks_the_same_after_a_turn_is_where_it_was(rig: Rig) -> None:
    dots = boards.parse("circles:9x7:0.02")
    left, right = look(rig, rig.cameras[1].T_camera_rig, dots)
    turn = dots.turns[0]
    again = tuple(replace(each, corners_px=np.ascontiguousarray(each.corners_px[turn])) for each in (left, right))
    told = verify(again, rig, T_RIG_BOARD)
    assert told.level == "ok"
    assert told.offset_m < 0.0005
    assert told.offset_rad < 0.004


def test_noise_alone_is_no_finding(rig: Rig) -> None:
    few = boards.parse("charuco:3x2:0.025")
    told = verify(look(rig, rig.cameras[1].T_camera_rig, few, noise_px=0.3), rig)
    assert told.level == "ok", told.sentence


def test_what_cannot_be_verified(rig: Rig) -> None:
    left, right = look(rig, rig.cameras[1].T_camera_rig)
    with pytest.raises(InputError, match="not seen by: right"):
        verify((left, None), rig)
    with pytest.raises(InputError, match="640x480 px, but the rig was calibrated at 1936x1216"):
        verify((replace(left, image_size_px=(640, 480)), right), rig)
    half = np.arange(44, dtype=np.int32)
    halves = (replace(left, ids=half, corners_px=left.corners_px[:44]),
              replace(right, ids=half + 44, corners_px=right.corners_px[44:]))
    with pytest.raises(InputError, match="only 0 of the same points"):
        verify(halves, rig)


def test_document_is_json(rig: Rig) -> None:
    told: Verdict = verify(look(rig, rig.cameras[1].T_camera_rig), rig)
    document = json.loads(json.dumps(told.document))
    assert document["offset_m"] is None
    assert document["level"] == "ok"
    assert abs(document["row_px"]) < 0.05


def test_images_that_are_no_pair_of_this_rig_are_no_verdict(rig: Rig) -> None:
    left, right = look(rig, rig.cameras[1].T_camera_rig)
    with pytest.raises(InputError, match="left and right are exchanged"):
        verify((right, left), rig)
    _, later = look(rig, rig.cameras[1].T_camera_rig, T=geometry.translation(0.0, 0.1, 0.0) @ T_RIG_BOARD)
    with pytest.raises(InputError, match="not of one moment"):
        verify((left, later), rig)
