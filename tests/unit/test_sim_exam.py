"""The exam's tables make a sound rig and cell."""

import subprocess
import sys
from collections import Counter

import cv2
import numpy as np
import pytest

from binpick import geometry
from binpick.errors import InputError
from binpick.settings import resolve
from binpick.sim import exam


@pytest.mark.parametrize("world", ["A", "B"])
def test_both_cameras_see_the_whole_bin(world):
    rig, setup = exam.rig(world), exam.setup(world)
    length, width, height = setup.bin_size_m
    corners = geometry.box_corners(np.array([-length / 2, -width / 2, 0]), np.array([length / 2, width / 2, height]))
    for camera in rig.cameras:
        at = geometry.transform(camera.T_camera_rig @ setup.T_camera_bin, corners)
        pixels = cv2.projectPoints(at, np.zeros(3), np.zeros(3), camera.K_px, camera.distortion_coefficients)[0][:, 0]
        assert (pixels > 0).all()
        assert (pixels < np.array(rig.image_size_px) - 1).all()


@pytest.mark.parametrize("world", ["A", "B"])
def test_the_bin_stands_in_the_same_place_in_both_frames(world):
    rig = exam.rig(world)
    T_camera_bin = exam.cell(world).bins[0].T_parent_bin
    T_base_bin = exam.cell(world, "base").bins[0].T_parent_bin
    assert np.allclose(np.array(rig.T_base_rig) @ T_camera_bin, T_base_bin, atol=1e-9)


def test_the_robot_stands_askew():
    R = exam.setup("A").T_base_bin[:3, :3]
    assert np.degrees(np.arctan2(R[1, 0], R[0, 0])) == pytest.approx(37)
    assert np.degrees(np.arccos(R[2, 2])) == pytest.approx(3)


def test_the_recipes_speak_two_formats_in_the_robots_frame():
    cell = exam.cell("B", control="rest")
    assert cell.control == "rest"
    jobs = [resolve(cell, number).recipe for number in (1, 2)]
    assert [j.pose_format for j in jobs] == ["ur_rxryrz_rad", "quaternion_xyzw"]
    assert {j.frame for j in jobs} == {"base"}


def test_mixed_means_equal_shares():
    assert set(Counter(exam.kinds("mixed", 25)).values()) == {5}
    assert exam.kinds("bolt", 2) == ("bolt", "bolt")
    assert exam.kinds("block+tee", 3) == ("block", "tee", "block")
    assert exam.kinds("bolt+steel-bolt", 2) == ("bolt", "steel-bolt")


def test_metal_means_the_same_shapes_of_steel():
    mixed, metal = (exam.kinds(mixture, 25) for mixture in ("mixed", "metal"))
    assert not set(mixed) & set(metal)
    assert [exam.KINDS[kind].pieces for kind in mixed] == [exam.KINDS[kind].pieces for kind in metal]
    assert all(exam.KINDS[kind].mirror > 0 for kind in metal)
    assert not any(exam.KINDS[kind].mirror for kind in mixed)


def test_unknown_names_say_what_there_is():
    with pytest.raises(InputError, match="A, B"):
        exam.rig("C")
    with pytest.raises(InputError, match="block"):
        exam.kinds("brick", 1)
    with pytest.raises(InputError, match="'brick'"):
        exam.kinds("block+brick", 0)


def test_the_checksum_follows_the_tables(monkeypatch):
    before = exam.sha256()
    assert before == exam.sha256()
    monkeypatch.setattr(exam, "REPORT_SEEDS", (1,))
    assert exam.sha256() != before


def test_the_exam_needs_neither_physics_nor_rays():
    code = "import sys, binpick.sim.exam; sys.exit(bool({'mujoco', 'open3d'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
