"""What a solution may be trusted for: planted lenses, uncertainties, three cameras, and rigs that cannot be are refused."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from binpick import geometry, rig
from binpick.errors import InputError
from binpick.rigcheck import board as boards
from binpick_calib import bundle, lens, plausible, solve, views

BOARD = boards.Board(9, 6, 0.025)
SIZE = (640, 480)
K = np.array([[620.0, 0, 322], [0, 620, 238], [0, 0, 1]])
T_RIGHT = geometry.make(Rotation.from_euler("xyz", [0.4, -8, 0.8], degrees=True).as_matrix(), np.array([-0.12, 0.001, 0.012]))
T_THIRD = geometry.make(Rotation.from_euler("xyz", [9, 3, 0], degrees=True).as_matrix(), np.array([-0.05, 0.11, 0.01]))
BARREL = (-0.28, 0.09)


def seen(distortion: tuple[float, ...] = BARREL, steps: tuple[geometry.Transform, ...] = (np.eye(4), T_RIGHT), number: int = 14,
         noise_px: float = 0.05, seed: int = 1, tilt_deg: float = 30) -> views.Views:
    """Corners of a board held every way in front of the cameras, with the detector's noise."""
    random = np.random.default_rng(seed)
    used = []
    for view in range(1, number + 1):
        turns = [random.uniform(-20, 20), *random.uniform(-tilt_deg, tilt_deg, 2)]
        R = Rotation.from_euler("zyx", turns, degrees=True).as_matrix()
        middle = np.array([0.05 + random.uniform(-0.11, 0.11), random.uniform(-0.08, 0.08), random.uniform(0.42, 0.55)])
        T_left_board = geometry.make(R, middle - R @ BOARD.points_m.mean(0).astype(float))
        corners = []
        for step in steps:
            six = step @ T_left_board
            terms = np.array(distortion + (0.0,) * max(0, 4 - len(distortion)))
            px = cv2.projectPoints(BOARD.points_m, cv2.Rodrigues(six[:3, :3])[0], six[:3, 3], K, terms)[0][:, 0]
            corners.append((px + random.normal(0, noise_px, px.shape)).astype(np.float32))
        names = tuple(f"{side}{view:02d}.png" for side in views.sides(len(steps)))
        used.append(views.View(view, names, tuple(corners), (np.nan,) * len(steps)))
    return views.Views(SIZE, tuple(used), {})


def changed(all_views: views.Views, change: np.ndarray) -> views.Views:
    """Every corner through an affine map of the image."""
    return replace(all_views, used=tuple(
        replace(v, corners_px=tuple((px @ change[:, :2].T + change[:, 2]).astype(np.float32) for px in v.corners_px))
        for v in all_views.used))


@pytest.mark.parametrize(("distortion", "model"), [
    ((-0.28, 0, 0, 0), "k1"), ((-0.28, 0.09, 0, 0), "k1 k2"), ((-0.28, 0.09, 0.003, -0.002), "k1 k2 p1 p2"),
    ((-0.28, 0.25, 0.003, -0.002, -0.35), "k1 k2 p1 p2 k3")])
def test_terms_stay_only_with_evidence(distortion: tuple[float, ...], model: str) -> None:
    solution = solve.solve(seen(distortion, number=10), BOARD, "2026-01-01")
    assert solution.quality.distortion_model == model
    assert solution.quality.rms_px == pytest.approx(0.05 * np.sqrt(2), rel=0.1)
    planted = np.zeros(5)
    planted[:len(distortion)] = distortion
    # what was left out is 0; what stays is what was planted within four deviations
    for term, value, told in zip(("k1", "k2", "p1", "p2", "k3"), planted, solution.rig.cameras[0].distortion, strict=True):
        assert told == pytest.approx(value, abs=4 * (solution.quality.sigma or {}).get(f"left.{term}", 0) + 1e-9)


def test_a_wide_lens_gets_the_rational_model() -> None:
    wide = (0.9, 0.3, 0.0005, -0.0005, 0.02, 1.25, 0.55, 0.09)
    solution = solve.solve(seen(wide, noise_px=0.02), BOARD, "2026-01-01")
    assert solution.quality.distortion_model in ("k1 k2 p1 p2 k3", "rational")
    assert solution.quality.rms_px == pytest.approx(0.02 * np.sqrt(2), rel=0.1)


def test_deviations_are_told_and_hold() -> None:
    solution = solve.solve(seen(number=9, seed=4), BOARD, "2026-01-01")
    sigma = solution.quality.sigma or {}
    left, right = solution.rig.cameras
    assert abs(left.K[0][0] - 620) < 3 * sigma["left.fx_px"] < 3
    off_m = np.linalg.norm(right.T_camera_rig[:3, 3]) - np.linalg.norm(T_RIGHT[:3, 3])
    assert abs(off_m) < 3 * sigma["right.distance_m"] < 0.001
    assert "left.k3" not in sigma


def shared_error(all_views: views.Views, amount_px: float, random: np.random.Generator) -> views.Views:
    """With what the corners of an image have wrong in common: a smooth bend, another one in each image."""
    x, y = (BOARD.points_m[:, :2] / np.ptp(BOARD.points_m[:, :2], axis=0) - 0.5).T
    bend = np.column_stack([np.ones(54), x, y, x * x, y * y, x * y])
    return replace(all_views, used=tuple(replace(v, corners_px=tuple(
        (px + bend @ random.normal(0, amount_px, (6, 2))).astype(np.float32) for px in v.corners_px)) for v in all_views.used))


@pytest.mark.parametrize("amount_px", [0.0, 0.1])
def test_the_truth_lies_within_the_deviations_as_often_as_it_should(amount_px: float) -> None:
    truth = bundle.Lens(np.array([620, 620, 322, 238, *BARREL, *np.zeros(6)]))
    along = T_RIGHT[:3, 3] / np.linalg.norm(T_RIGHT[:3, 3])
    directions = np.zeros((8, 30))
    directions[range(7), [0, 2, 3, 4, 12, 14, 16]] = 1      # fx, cx, cy and k1 of the left, fx, cx, k1 of the right lens
    directions[7, 27:] = along                                # and the baseline
    planted = directions @ np.concatenate([truth.values, truth.values, bundle.pose(T_RIGHT)])
    off, by_corners = [], []
    for seed in range(30):
        drawn = shared_error(seen(number=10, seed=100 + seed), amount_px, np.random.default_rng(seed))
        corners = [solve.seen_by(v, camera, BOARD) for v in drawn.used for camera in (0, 1)]
        places = {s.view: bundle.place(truth, s) for s in corners if s.camera == 0}
        fitted = bundle.adjust(corners, (truth, truth), (np.eye(4), T_RIGHT), places, (0, 1))
        assert fitted.covariance is not None
        found = directions @ np.concatenate([*(own.values for own in fitted.lenses), bundle.pose(fitted.T_cam_rig[1])])
        off.append((found - planted) / fitted.covariance.deviations(directions))
        by_corners.append((found - planted) / np.sqrt(np.diag(directions @ fitted.covariance.scatter @ directions.T)))
    assert 0.6 < np.mean(np.abs(off) < 1) < 0.85
    assert np.mean(np.abs(off) < 2) > 0.92
    # corners taken for witnesses of their own promise too much as soon as they err together
    assert (np.mean(np.abs(by_corners) < 2) > 0.9) == (amount_px == 0)


def test_three_cameras_one_of_them_not_always_there() -> None:
    all_views = seen(steps=(np.eye(4), T_RIGHT, T_THIRD))
    unseen = np.full_like(BOARD.points_m[:, :2], np.nan)
    half = all_views.used[3].corners_px[1].copy()
    half[20:] = np.nan
    used = [replace(v, corners_px=(*v.corners_px[:2], unseen)) if v.number in (2, 5) else v for v in all_views.used]
    used[3] = replace(used[3], corners_px=(used[3].corners_px[0], half, used[3].corners_px[2]))
    used[7] = replace(used[7], corners_px=(*used[7].corners_px[:2], used[7].corners_px[2] + np.float32([4, 3])))
    solution = solve.solve(replace(all_views, used=tuple(used)), BOARD, "2026-01-01")
    assert [camera.name for camera in solution.rig.cameras] == ["left", "right", "camera3"]
    for camera, planted in zip(solution.rig.cameras[1:], (T_RIGHT, T_THIRD), strict=True):
        assert camera.T_camera_rig == pytest.approx(planted, abs=0.0015)
    assert list(solution.quality.rejected) == ["left08.png, camera308.png"]
    assert np.isnan(solution.per_view_px[8][2])
    assert np.isfinite(solution.per_view_px[8][1])


def test_a_board_of_which_too_little_is_seen() -> None:
    view = seen(number=1).used[0]
    scrap = view.corners_px[1].copy()
    scrap[5:] = np.nan
    kept, rejected = views.screen([replace(view, corners_px=(view.corners_px[0], scrap))])
    assert kept == ()
    assert rejected == {"right01.png": "half seen: 5 of 54 corners"}


def test_one_view_misread() -> None:
    all_views = seen()
    bent = all_views.used[4].corners_px[0] + np.random.default_rng(3).normal(0, 1.5, (54, 2)).astype(np.float32)
    used = [replace(v, corners_px=(bent, v.corners_px[1])) if v.number == 5 else v for v in all_views.used]
    solution = solve.solve(replace(all_views, used=tuple(used)), BOARD, "2026-01-01")
    assert list(solution.quality.rejected) == ["left05.png, right05.png"]
    assert "the corners of its first image lie" in solution.quality.rejected["left05.png, right05.png"]


@pytest.mark.parametrize(("all_views", "said"), [
    (changed(seen(), np.array([[1, 0, 0], [0, 0.8, 0]])), "left: fx/fy is 1.2.*the image was squeezed"),
    (changed(seen(), np.array([[1, 0, -250], [0, 1, 0]])), "the principal point .* the image was cropped"),
    (seen(steps=(np.eye(4), geometry.translation(-0.01, 0.0, -0.12))), "a baseline along the optical axis gives no depth"),
    (seen(steps=(np.eye(4), geometry.translation(0.01, -0.12, 0.0))), "one above the other cannot be matched along rows"),
    (seen(tilt_deg=0.5), "left"),
])
def test_rigs_that_cannot_be_are_refused(all_views: views.Views, said: str) -> None:
    with pytest.raises(InputError, match=said):
        solve.solve(all_views, BOARD, "2026-01-01")


def test_absurd_distortion() -> None:
    sound = solve.solve(seen(number=6), BOARD, "2026-01-01").rig
    assert plausible.faults(sound) == []
    absurd = sound.model_copy(update={"cameras": (
        sound.cameras[0].model_copy(update={"distortion": (-0.28, 0.09, 0.0, 0.0, 25.0)}), sound.cameras[1])})
    assert any("left: k3 = 25 moves the corner of the image" in fault for fault in plausible.faults(absurd))
    assert lens.folds(K, np.array([-1.5, 0, 0, 0, 0.0]), SIZE)
    assert not lens.folds(K, np.array([-0.28, 0.09, 0, 0, 0.0]), SIZE)


def test_a_first_guess_does_not_run_away() -> None:
    # the board's vanishing points say 11420 px for the right lens of this set
    all_views = seen(number=10, noise_px=0.15, tilt_deg=20, seed=1014)
    solution = solve.solve(all_views, BOARD, "2026-01-01")
    assert solution.quality.rejected == {}
    assert [camera.K[0][0] for camera in solution.rig.cameras] == pytest.approx([620, 620], rel=0.02)


def test_same_views_same_bytes() -> None:
    all_views = seen(number=6)
    first = rig.dump(solve.solve(all_views, BOARD, "2026-01-01").rig)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        assert rig.dump(solve.solve(all_views, BOARD, "2026-01-01").rig) == first
    finally:
        cv2.setNumThreads(threads)
