"""The geometry of two views by its laws, over random cameras and points."""

from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from binpick import geometry
from binpick.errors import InputError
from binpick.geometry import epipolar, rectification, triangulation

SIZE = (1936, 1216)


@dataclass(frozen=True)
class Pair:
    """Two cameras, points before both, and where they are seen."""

    K_left: np.ndarray
    K_right: np.ndarray
    T_right_left: np.ndarray
    points: np.ndarray
    left_px: np.ndarray
    right_px: np.ndarray


def rays(K: np.ndarray, points_px: np.ndarray) -> np.ndarray:
    return ((points_px - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T)


def project(P: np.ndarray, points: np.ndarray) -> np.ndarray:
    seen = np.column_stack([points, np.ones(len(points))]) @ P.T
    return seen[:, :2] / seen[:, 2:]


@st.composite
def pairs(draw: st.DrawFn) -> Pair:
    """A rig such as people build: up to 0.2 rad turned to each other, the baseline mostly along x."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    K_left, K_right = (np.array([[f, 0, rng.uniform(900, 1036)], [0, rng.uniform(0.99, 1.01) * f, rng.uniform(560, 660)],
                                 [0, 0, 1]]) for f in rng.uniform(1500, 3500, 2))
    R = Rotation.from_rotvec(rng.uniform(-0.2, 0.2, 3)).as_matrix()
    centre = np.array([rng.uniform(0.1, 0.3), *rng.uniform(-0.03, 0.03, 2)])
    T = geometry.make(R, -R @ centre)
    points = np.column_stack([rng.uniform(-0.3, 0.3, (40, 2)), rng.uniform(0.7, 1.3, 40)])
    return Pair(K_left, K_right, T, points, project(K_left @ np.eye(3, 4), points), project(K_right @ T[:3], points))


@given(pairs())
def test_partners_lie_on_their_lines(pair: Pair) -> None:
    F = epipolar.fundamental(epipolar.essential(pair.T_right_left), pair.K_left, pair.K_right)
    assert np.abs(epipolar.distances(F, pair.left_px, pair.right_px)).max() < 1e-6
    assert np.abs(epipolar.distances(F.T, pair.right_px, pair.left_px)).max() < 1e-6
    aside = epipolar.lines(F, pair.left_px)[:, :2] * 3
    assert np.allclose(epipolar.distances(F, pair.left_px, pair.right_px + aside), 3, atol=1e-6)
    theirs = cv2.computeCorrespondEpilines(pair.left_px.reshape(-1, 1, 2), 1, F)[:, 0]
    assert np.allclose(epipolar.lines(F, pair.left_px), theirs, rtol=1e-4, atol=1e-4)


@given(pairs())
def test_the_epipole_is_the_other_cameras_image(pair: Pair) -> None:
    F = epipolar.fundamental(epipolar.essential(pair.T_right_left), pair.K_left, pair.K_right)
    left, right = epipolar.epipoles(F)
    T_left_right = geometry.inverse(pair.T_right_left)
    for epipole, seen in ((left, pair.K_left @ T_left_right[:3, 3]), (right, pair.K_right @ pair.T_right_left[:3, 3])):
        assert np.abs(np.cross(epipole, seen / np.linalg.norm(seen))).max() < 1e-6
    # every line of the right image goes through its epipole
    assert np.abs(epipolar.lines(F, pair.left_px) @ right).max() < 1e-6


@given(pairs())
def test_eight_points_tell_the_cameras_step_but_for_its_length(pair: Pair) -> None:
    F = epipolar.eight_point(pair.left_px, pair.right_px)
    assert np.linalg.matrix_rank(F, tol=1e-12) == 2
    assert np.abs(epipolar.distances(F, pair.left_px, pair.right_px)).max() < 1e-4
    E = epipolar.from_fundamental(F, pair.K_left, pair.K_right)
    step = epipolar.step(E, rays(pair.K_left, pair.left_px), rays(pair.K_right, pair.right_px))
    t = pair.T_right_left[:3, 3]
    assert np.allclose(step[:3, :3], pair.T_right_left[:3, :3], atol=1e-5)
    assert np.allclose(step[:3, 3], t / np.linalg.norm(t), atol=1e-5)


@given(pairs())
def test_eight_points_with_noise_agree_with_opencv(pair: Pair) -> None:
    noise = np.random.default_rng(0).normal(0, 0.2, (2, *pair.left_px.shape))
    left, right = pair.left_px + noise[0], pair.right_px + noise[1]
    ours = epipolar.eight_point(left, right)
    theirs, _ = cv2.findFundamentalMat(left, right, cv2.FM_8POINT)
    # OpenCV takes the eigenvectors of the squared equations, which keep half of the digits
    off, their_off = (np.abs(epipolar.distances(F, left, right)) for F in (ours, theirs))
    assert np.abs(off - their_off).max() < 1e-3


@given(pairs())
def test_four_steps_have_one_e_and_one_sees_the_points_in_front(pair: Pair) -> None:
    E = epipolar.essential(pair.T_right_left)
    unit = E / np.linalg.norm(E)
    four = epipolar.steps(E)
    assert len(four) == 4
    for T in four:
        assert geometry.is_rigid(T)
        again = epipolar.essential(T) / np.sqrt(2)
        assert min(np.abs(again - unit).max(), np.abs(again + unit).max()) < 1e-9
    for i in range(4):
        assert all(np.abs(four[i] - four[j]).max() > 1e-3 for j in range(i))
    chosen = epipolar.step(E, rays(pair.K_left, pair.left_px), rays(pair.K_right, pair.right_px))
    assert np.allclose(chosen[:3, :3], pair.T_right_left[:3, :3], atol=1e-9)


def test_too_few_or_flat_points_are_refused() -> None:
    rng = np.random.default_rng(1)
    K = np.array([[1740.0, 0, 968], [0, 1740, 608], [0, 0, 1]])
    T = geometry.make(np.eye(3), np.array([-0.15, 0.0, 0.0]))
    flat = np.column_stack([rng.uniform(-0.3, 0.3, (30, 2)), np.ones(30)])
    left, right = project(K @ np.eye(3, 4), flat), project(K @ T[:3], flat)
    with pytest.raises(InputError, match="one plane"):
        epipolar.eight_point(left, right)
    with pytest.raises(InputError, match="7 matches"):
        epipolar.eight_point(left[:7], right[:7])
    with pytest.raises(InputError, match="one point"):
        epipolar.eight_point(left[[0] * 9], right[[0] * 9])
    with pytest.raises(InputError, match="not of one rigid scene"):
        epipolar.step(epipolar.essential(T), rng.normal(0, 0.3, (200, 2)), rng.normal(0, 0.3, (200, 2)))


@pytest.mark.parametrize("method", ["fusiello", "opencv"])
@given(pair=pairs())
def test_rectified_partners_lie_in_one_row(method: str, pair: Pair) -> None:
    arguments = (pair.K_left, pair.K_right, pair.T_right_left)
    made = rectification.fusiello(*arguments) if method == "fusiello" else rectification.opencv(*arguments, SIZE)
    for R in (made.R_left, made.R_right):
        assert geometry.is_rigid(geometry.make(R, np.zeros(3)), 1e-9)
    # the turns undo the cameras' own, and both see along the same axes
    assert np.allclose(made.R_right @ pair.T_right_left[:3, :3], made.R_left, atol=1e-9)
    H_left, H_right = made.homographies(pair.K_left, pair.K_right)
    left, right = (cv2.perspectiveTransform(px[None], H)[0] for px, H in ((pair.left_px, H_left), (pair.right_px, H_right)))
    assert np.abs(left[:, 1] - right[:, 1]).max() < 1e-6
    # the projections say the same as the homographies, and depth is f b / d
    rectified = pair.points @ made.R_left.T
    assert np.allclose(project(made.P_left, rectified), left, atol=1e-6)
    assert np.allclose(project(made.P_right, rectified), right, atol=1e-6)
    baseline = np.linalg.norm(pair.T_right_left[:3, 3])
    assert np.allclose(made.P_left[0, 0] * baseline / (left[:, 0] - right[:, 0]), rectified[:, 2], rtol=1e-9)
    assert np.allclose(triangulation.triangulate(made.P_left, made.P_right, left, right), rectified, atol=1e-6)


@given(pairs())
def test_the_turn_from_the_epipole_sends_it_to_infinity_along_x(pair: Pair) -> None:
    R_left, R_right = rectification.from_epipole(pair.T_right_left)
    left, right = epipolar.epipoles(epipolar.essential(pair.T_right_left))
    for R, epipole in ((R_left, left), (R_right, right)):
        assert np.allclose(np.abs(R @ epipole), [1, 0, 0], atol=1e-9)
    # of all turns that do so, this one leaves the old optical axis in the plane of the new x and z
    assert abs(R_left[1] @ [0, 0, 1]) < 1e-12
    assert R_left[2, 2] > 0.9


def test_cameras_behind_each_other_cannot_be_rectified() -> None:
    with pytest.raises(InputError, match="behind each other"):
        rectification.from_epipole(geometry.translation(0.0, 0.0, -0.2))


@settings(max_examples=50)
@given(pairs())
def test_triangulation_undoes_projection(pair: Pair) -> None:
    P_left, P_right = pair.K_left @ np.eye(3, 4), pair.K_right @ pair.T_right_left[:3]
    assert np.allclose(triangulation.triangulate(P_left, P_right, pair.left_px, pair.right_px), pair.points, atol=1e-6)


def test_parallel_rays_meet_nowhere() -> None:
    P_right = np.column_stack([np.eye(3), [-0.1, 0.0, 0.0]])
    both = np.array([[0.1, 0.2], [0.3, 0.1]])
    apart = np.array([[0.0, 0.0], [0.05, 0.0]])
    points = triangulation.triangulate(np.eye(3, 4), P_right, both, both - apart)
    assert np.isnan(points[0]).all()
    assert points[1, 2] == pytest.approx(2)
    verged = triangulation.verged(both, both - apart, 0.1, 0.0, 0.0)
    assert np.isnan(verged[0]).all()
    assert np.allclose(verged[1], [0.6, 0.2, 2])


@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(0.05, 0.5), st.integers(0, 2**32 - 1))
def test_a_verged_pairs_angles_tell_the_point(yaw_left: float, yaw_right: float, baseline: float, seed: int) -> None:
    points = np.random.default_rng(seed).uniform([-0.3, -0.3, 0.7], [0.3, 0.3, 1.5], (20, 3))
    seen = []
    for yaw, x in ((yaw_left, 0.0), (yaw_right, baseline)):
        local = (points - [x, 0, 0]) @ Rotation.from_euler("y", yaw).as_matrix()
        seen.append(local[:, :2] / local[:, 2:])
    assert np.allclose(triangulation.verged(seen[0], seen[1], baseline, yaw_left, yaw_right), points, atol=1e-9)
    # the general way gives the same
    T_left, T_right = (geometry.make(Rotation.from_euler("y", -yaw).as_matrix(), np.zeros(3))
                       @ geometry.translation(-x, 0.0, 0.0) for yaw, x in ((yaw_left, 0.0), (yaw_right, baseline)))
    assert np.allclose(triangulation.triangulate(T_left[:3], T_right[:3], seen[0], seen[1]), points, atol=1e-6)
