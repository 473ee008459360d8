"""Transforms and orientations by their laws: groups, inverses, and every robot brand's way back."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from binpick import geometry, poses
from binpick.poses import PoseFormat

# float64 rounding of a handful of products of numbers up to 10
EXACT = 1e-12


@st.composite
def transforms(draw: st.DrawFn):
    numbers = [draw(st.floats(-10, 10)) for _ in range(3)]
    rotation = Rotation.random(rng=draw(st.integers(0, 2**32 - 1)))
    return geometry.make(rotation.as_matrix(), np.array(numbers))


@given(transforms(), transforms())
def test_inverse_of_a_product_is_the_product_of_inverses(T_a_b, T_b_c):
    assert np.allclose(geometry.inverse(T_a_b @ T_b_c), geometry.inverse(T_b_c) @ geometry.inverse(T_a_b), atol=EXACT)
    assert np.allclose(geometry.inverse(T_a_b) @ T_a_b, np.eye(4), atol=EXACT)
    assert geometry.is_rigid(T_a_b @ T_b_c)


@given(transforms(), st.integers(0, 2**32 - 1))
def test_points_go_there_and_back(T_a_b, seed):
    points = np.random.default_rng(seed).uniform(-1, 1, (4, 5, 3))
    there = geometry.transform(T_a_b, points)
    assert there.shape == points.shape
    assert np.allclose(geometry.transform(geometry.inverse(T_a_b), there), points, atol=1e-11)
    assert np.allclose(there[2, 3], (T_a_b @ [*points[2, 3], 1])[:3], atol=EXACT)


def test_nan_stays_nan_and_float32_stays_float32():
    points = np.array([[1, 2, 3], [np.nan, np.nan, np.nan]], dtype=np.float32)
    moved = geometry.transform(geometry.translation(1.0, 0.0, 0.0), points)
    assert moved.dtype == np.float32
    assert np.isnan(moved[1]).all()
    assert np.allclose(moved[0], [2, 2, 3])


@given(transforms())
def test_quaternions_are_canonical_and_lossless(T_a_b):
    q = geometry.quaternion(T_a_b)
    assert q[3] >= 0
    assert np.allclose(geometry.from_quaternion(T_a_b[:3, 3], q), T_a_b, atol=1e-12)


@pytest.mark.parametrize("pose_format", list(PoseFormat))
@given(st.integers(0, 2**32 - 1))
def test_every_orientation_comes_back(pose_format, seed):
    q = Rotation.random(rng=seed).as_quat(canonical=True)
    back = poses.decode(poses.encode(q, pose_format), pose_format)
    # 1e-7: the cosine of a half-angle near 1 keeps half the digits
    assert abs(back @ q) > 1 - 1e-7


def test_orientations_known_by_hand():
    # a quarter turn about z, then (in the turned frame) a half turn about x: the tool looks down
    q = (Rotation.from_euler("z", 90, degrees=True) * Rotation.from_euler("x", 180, degrees=True)).as_quat(canonical=True)
    assert np.allclose(poses.encode(q, PoseFormat.kuka_abc_deg), [90, 0, 180])
    assert np.allclose(poses.encode(q, PoseFormat.fanuc_wpr_deg), [180, 0, 90])
    rotvec = poses.encode(q, PoseFormat.ur_rxryrz_rad)
    assert np.isclose(np.linalg.norm(rotvec), np.pi)
    assert np.allclose(np.abs(rotvec), [np.pi / np.sqrt(2), np.pi / np.sqrt(2), 0])


@given(transforms())
def test_frames_of_axes_keep_z_and_lean_x_to_the_hint(T):
    z, hint = T[:3, 2], T[:3, 0]
    frame = geometry.frame_of_axes(z, hint, T[:3, 3])
    assert geometry.is_rigid(frame)
    assert np.allclose(frame[:3, 2], z)
    assert frame[:3, 0] @ hint > 0.99
    assert geometry.is_rigid(geometry.frame_of_axes(z, z, T[:3, 3]))


@pytest.mark.parametrize("broken", [np.full((4, 4), np.nan), np.diag([1.0, 1.0, -1.0, 1.0]), 2 * np.eye(4), np.zeros((4, 4))])
def test_what_is_not_rigid_is_seen(broken):
    assert not geometry.is_rigid(broken)
