"""Drift is told from pairs and tags whose truth is known: by how much, in which sense, when, and when not."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from binpick import geometry
from binpick.data import Image, Rectified, Window
from binpick.errors import InputError
from binpick.geometry import rectification
from binpick.rig import Rig
from binpick.rigcheck import carrier, correction, drift, marks, rows, sighting
from binpick.rigcheck.carrier import CarrierCheck
from binpick.rigcheck.drift import Level, Watch
from binpick.rigcheck.marks import MarksCheck, Reference, Sighting
from binpick.rigcheck.rows import Rows
from binpick.sim import exam
from binpick.sim.drift import NONE, Drift
from binpick.sim.projector import Projector
from binpick.stereo import rectify

MIDDLEBURY = Path(__file__).parents[2] / "../shared/data/middlebury_v3q"
RIG = exam.rig("A")
FOCAL_PX = 1740.0
CALM = Rows(row_px=0.01, sigma_px=0.01, points=120, off_px=0.01, pitch_rad=0.0, roll_rad=0.0, sigma_pitch_rad=1e-5,
            sigma_roll_rad=1e-5)
STILL = MarksCheck(marks=4, shift_m=(0.0, 0.0, 0.0), turn_rad=(0.0, 0.0, 0.0), rotation_rad=(0.0, 0.0, 0.0), depth_m=0.0,
                   sigma_shift_m=2e-5, sigma_turn_rad=1e-5, sigma_rotation_rad=(1e-5,) * 3, sigma_depth_m=5e-5, residual_px=0.1)


def scattered(count: int = 300) -> np.ndarray:
    """Points of a full bin in the rig's frame."""
    rng = np.random.default_rng(4)
    return rng.uniform((-0.2, -0.2, 0.85), (0.4, 0.2, 1.0), (count, 3))


def partners(rig: Rig, true: Rig, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the rectified views of a rig file show points that other cameras truly see, px from the principal point."""
    left, right = rig.cameras[:2]
    turned = rectification.opencv(left.K_px, right.K_px, right.T_camera_rig, rig.image_size_px)
    seen = []
    for index, R in enumerate((turned.R_left, turned.R_right)):
        rays = geometry.transform(true.cameras[index].T_camera_rig, points) @ R.T
        seen.append((FOCAL_PX * rays[:, :2] / rays[:, 2:]).astype(np.float32))
    return seen[0], seen[1]


def textured(dy_px: float, seed: int = 1) -> Rectified:
    """A pair of a slanted surface of dots whose right view lies dy_px lower."""
    rng = np.random.default_rng(seed)
    height, width, margin, smallest = 300, 420, 64, 200
    picture = cv2.GaussianBlur(rng.uniform(0, 255, (height + 40, width + 240)).astype(np.float32), (0, 0), 1.4)
    picture = cv2.normalize(picture, None, 20, 230, cv2.NORM_MINMAX)
    u, v = np.meshgrid(np.arange(width + margin, dtype=np.float32), np.arange(height, dtype=np.float32))
    disparity = 20 + 0.05 * v

    def shot(shift: np.ndarray, down_px: float) -> Image:
        seen = cv2.remap(picture, u + 60 + shift.astype(np.float32), v + 20 - np.float32(down_px), cv2.INTER_CUBIC)
        return np.clip(seen + rng.normal(0, 2, seen.shape), 0, 255).astype(np.uint8)

    return Rectified(shot(0 * disparity, 0), shot(disparity, dy_px), Window(500, 400, width, height, smallest, margin), margin,
                     FOCAL_PX, 0.15, 970.0, 606.0, np.eye(4))


@pytest.mark.parametrize("dy_px", [-6.375, -0.40625, 0.0, 0.15625, 1.09375, 3.0, 6.0])     # remap draws 1/32 px
def test_rows_of_a_pair_are_found_far_off_and_to_a_fraction(dy_px: float) -> None:
    seen = rows.check(textured(dy_px))
    assert seen.points > 80
    assert seen.row_px == pytest.approx(dy_px, abs=0.03)
    assert seen.sigma_px < 0.03
    assert seen.off_px == pytest.approx(abs(dy_px), abs=0.06)


def test_rows_are_the_same_however_many_threads_count_them() -> None:
    pair, before = textured(0.3), cv2.getNumThreads()
    try:
        cv2.setNumThreads(1)
        alone = rows.check(pair)
        cv2.setNumThreads(2)
        assert rows.check(pair) == alone == rows.check(pair)
    finally:
        cv2.setNumThreads(before)


def test_nothing_to_see_is_a_reason_and_no_number() -> None:
    pair = textured(0.0)
    blank = replace(pair, left=np.full_like(pair.left, 90), right=np.full_like(pair.right, 90))
    seen = rows.check(blank)
    assert "places" in seen.reason
    assert np.isnan([seen.row_px, seen.off_px, seen.pitch_rad]).all()
    tiny = replace(pair, left=pair.left[:20].copy(), right=pair.right[:20].copy(), window=replace(pair.window, height=20))
    assert rows.check(tiny).reason


@pytest.mark.skipif(not MIDDLEBURY.is_dir(), reason="Middlebury's scenes do not lie in ../shared/data")
@pytest.mark.parametrize("scene", ["Motorcycle", "Adirondack", "Piano", "Recycle"])
def test_rows_of_real_pairs_are_off_by_what_their_makers_say(scene: str) -> None:
    """`dyavg` of a calib.txt is the mean size of the pair's row errors."""
    said = dict(re.findall(r"(\w+)\s*=\s*\[?\s*([\d.]+)", (MIDDLEBURY / scene / "calib.txt").read_text()))
    left, right = (cv2.imread(str(MIDDLEBURY / scene / f"im{camera}.png"), cv2.IMREAD_GRAYSCALE) for camera in (0, 1))
    focal_px = float(said["cam0"])

    def seen(moved: int) -> Rows:
        pair = rectify.whole(left, np.roll(right, moved, 0), 0, int(said["ndisp"]))
        return rows.check(replace(pair, focal_px=focal_px, cx_px=left.shape[1] / 2, cy_px=left.shape[0] / 2))

    still = seen(0)
    assert still.off_px == pytest.approx(float(said["dyavg"]), abs=0.11)
    for moved in (-6, 3):
        assert seen(moved).row_px == pytest.approx(still.row_px + moved, abs=0.05)


@pytest.mark.parametrize("turn", [Drift(pitch_rad=0.4 / FOCAL_PX), Drift(pitch_rad=-3.0 / FOCAL_PX), Drift(roll_rad=0.001),
                                  Drift(pitch_rad=-0.0005, roll_rad=-0.0008)], ids=str)
def test_rows_tell_pitch_and_roll_also_among_wrong_partners(turn: Drift) -> None:
    left, right = partners(RIG, turn.rig(RIG), scattered())
    rng = np.random.default_rng(2)
    right[:, 1] += rng.normal(0, 0.1, len(right)).astype(np.float32)
    right[:90, 1] += rng.uniform(-8, 8, 90).astype(np.float32)
    seen = rows.fit(left, right, FOCAL_PX)
    assert seen.pitch_rad == pytest.approx(turn.pitch_rad, abs=0.03 / FOCAL_PX + 0.02 * abs(turn.roll_rad))
    assert seen.roll_rad == pytest.approx(turn.roll_rad, abs=0.2 / FOCAL_PX + 0.02 * abs(turn.pitch_rad))


def test_rows_do_not_tell_yaw_and_say_so() -> None:
    left, right = partners(RIG, Drift(yaw_rad=float(np.radians(0.05))).rig(RIG), scattered())
    assert rows.fit(left, right, FOCAL_PX).off_px < 0.1      # 1.5 px of disparity
    assert "yaw" in drift.unseen(marks=False)[0]
    assert not any("yaw" in each for each in drift.unseen(marks=True))
    assert drift.unseen(marks=False, located=True) != drift.unseen(marks=False)


def test_a_corrected_rig_has_its_rows_back() -> None:
    turn = Drift(pitch_rad=0.0011, yaw_rad=0.0002, roll_rad=-0.0006)
    true, told = turn.rig(RIG), (0.0011, 0.0002, -0.0006)
    now = correction.corrected(RIG, told)
    left, right = partners(now, true, scattered())
    assert np.abs(right[:, 1] - left[:, 1]).max() < 0.05
    assert np.allclose(now.cameras[1].T_camera_rig, true.cameras[1].T_camera_rig, atol=3e-5)     # other axes, by half a degree
    assert np.allclose(correction.turned(now, (-0.0011, -0.0002, 0.0006)).cameras[1].T_camera_rig,
                       RIG.cameras[1].T_camera_rig, atol=1e-6)


def test_corrections_add_up_are_recorded_and_bounded() -> None:
    once, first = correction.applied(RIG, (0.0006, 0.0, 0.0))
    twice, second = correction.applied(RIG, (0.0004, 0.0001, 0.0), first)
    assert second.rotation_rad == pytest.approx((0.001, 0.0001, 0.0))
    assert (first.number, second.number) == (1, 2)
    assert (first.rig_sha256, first.corrected_sha256) == (RIG.sha256, once.sha256)
    assert second.corrected_sha256 == twice.sha256 != once.sha256
    with pytest.raises(InputError, match="calibrate it again"):
        correction.applied(RIG, (0.0012, 0.0, 0.0), second)
    with pytest.raises(InputError, match="not known"):
        correction.corrected(RIG, (float("nan"), 0.0, 0.0))
    with pytest.raises(InputError, match="another rig file"):
        correction.applied(once, (0.0, 0.0, 0.0), first)


TAGS = {number: geometry.translation(x, y, 1.0 + 0.02 * (number % 2))
        for number, (x, y) in enumerate(((-0.25, -0.25), (0.4, -0.25), (0.4, 0.25), (-0.25, 0.25), (0.1, 0.28)))}


def tagged(drifted: Drift = NONE, noise_px: float = 0.1, seed: int = 1, hidden: tuple[int, ...] = ()) -> Sighting:
    """Where the cameras truly see the tags' corners."""
    rng, true, half = np.random.default_rng(seed), drifted.rig(RIG), 0.02
    square = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]])
    seen = []
    for camera in true.cameras:
        T = camera.T_camera_rig @ geometry.inverse(drifted.T_was_rig)
        seen.append({number: (cv2.projectPoints(geometry.transform(T @ place, square), np.zeros(3), np.zeros(3), camera.K_px,
                                                camera.distortion_coefficients)[0].reshape(4, 2)
                              + rng.normal(0, noise_px, (4, 2))).astype(np.float32)
                     for number, place in TAGS.items() if number not in hidden})
    return seen[0], seen[1]


@pytest.fixture(scope="module")
def reference() -> Reference:
    return marks.store([tagged(seed=seed) for seed in range(10, 15)], RIG, "apriltag_36h11")


@pytest.mark.parametrize("drifted", [
    Drift(), Drift(yaw_rad=float(np.radians(0.01))), Drift(pitch_rad=0.001, yaw_rad=-0.0003, roll_rad=0.0005),
    Drift(shift_m=(0.001, 0.0, 0.0)), Drift(shift_m=(-0.001, 0.003, 0.004), yaw_rad=0.0002)], ids=str)
def test_marks_tell_the_mount_from_the_cameras_turn(reference: Reference, drifted: Drift) -> None:
    seen = marks.compare(reference, [tagged(drifted, seed=seed) for seed in range(3)], RIG)
    assert seen.marks == 5
    assert np.allclose(seen.shift_m, drifted.shift_m, atol=1e-4)
    assert np.allclose(seen.rotation_rad, (drifted.pitch_rad, drifted.yaw_rad, drifted.roll_rad), atol=8e-5)
    # nearer by z² yaw / baseline
    assert seen.depth_m == pytest.approx(-(1.01**2) * drifted.yaw_rad / 0.15, abs=4e-4)
    assert seen.sigma_depth_m < 3e-4
    assert seen.residual_px < 0.2


def test_a_turned_mount_is_told_where_it_matters(reference: Reference) -> None:
    turned = Drift(turn_rad=(0.0, 0.002, 0.001))
    seen = marks.compare(reference, [tagged(turned)], RIG)
    assert np.allclose(seen.turn_rad, turned.turn_rad, atol=4e-4)
    assert seen.shift_m[0] == pytest.approx(0.002 * 1.0, abs=4e-4)


def test_one_mark_that_was_moved_does_not_mislead(reference: Reference) -> None:
    left, right = tagged()
    pushed = tuple({**view, 2: view[2] + np.float32([3.0, -2.0])} for view in (left, right))
    seen = marks.compare(reference, [(pushed[0], pushed[1])], RIG)
    assert np.linalg.norm(seen.shift_m) < 3e-4
    assert abs(seen.depth_m) < 5e-4


def test_too_few_marks_are_a_reason(reference: Reference) -> None:
    seen = marks.compare(reference, [tagged(hidden=(0, 3, 4))], RIG)
    assert seen.missing == (0, 3, 4)
    assert "2 of 5" in seen.reason
    assert np.isnan(seen.depth_m)
    assert marks.compare(reference, [({}, {})], RIG).marks == 0
    with pytest.raises(InputError, match="2 marks"):
        marks.store([tagged(hidden=(0, 3, 4))], RIG, "apriltag_36h11")


def test_a_reference_is_a_file(reference: Reference) -> None:
    assert reference.rig_sha256 == RIG.sha256
    assert Reference.model_validate_json(reference.model_dump_json()) == reference
    corners = np.array(reference.marks[2])
    assert np.allclose(corners.mean(0), TAGS[2][:3, 3], atol=1e-3)


def page(dots: bool) -> tuple[Image, np.ndarray]:
    """A tag on grey, turned and foreshortened, perhaps under a pattern of dots, and its true corners."""
    tag = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11), 7, 640)
    paper = cv2.copyMakeBorder(tag, 160, 160, 160, 160, cv2.BORDER_CONSTANT, value=255).astype(np.float32) * 0.7 + 12
    corners = np.array([[151.3, 120.6], [231.8, 133.2], [220.1, 214.7], [140.4, 202.9]])
    # edges of the raster's cells, not their middles
    H, _ = cv2.findHomography(np.array([[160, 160], [800, 160], [800, 800], [160, 800]]) - 0.5, corners)
    fine = np.diag([4.0, 4.0, 1.0]) @ np.array([[1, 0, 0.375], [0, 1, 0.375], [0, 0, 1]])
    image = cv2.warpPerspective(paper, fine @ H, (1280, 1280), flags=cv2.INTER_AREA, borderValue=70)
    image = cv2.GaussianBlur(cv2.resize(image, (320, 320), interpolation=cv2.INTER_AREA), (0, 0), 0.8)
    rng = np.random.default_rng(3)
    if dots:
        image *= cv2.resize(Projector("B").picture(0)[:640, :640], (320, 320), interpolation=cv2.INTER_AREA)
    return np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8), corners


@pytest.mark.parametrize(("dots", "within_px"), [(False, 0.12), (True, 0.7)])
def test_a_tags_corners_are_where_its_sides_meet(dots: bool, within_px: float) -> None:
    image, corners = page(dots)
    seen = sighting.detect(image, "apriltag_36h11")
    assert list(seen) == [7]
    assert np.abs(seen[7] - corners).max() < within_px
    assert not sighting.detect(image, "4x4_50")


def test_tags_are_the_same_however_many_threads_look() -> None:
    image, before = page(dots=True)[0], cv2.getNumThreads()
    try:
        cv2.setNumThreads(1)
        alone = sighting.detect(image, "apriltag_36h11")
        cv2.setNumThreads(2)
        assert {number: corners.tobytes() for number, corners in sighting.detect(image, "apriltag_36h11").items()} == {
            number: corners.tobytes() for number, corners in alone.items()}
    finally:
        cv2.setNumThreads(before)


def test_a_family_that_there_is_not() -> None:
    with pytest.raises(InputError, match="apriltag_36h11"):
        sighting.detect(np.zeros((64, 64), np.uint8), "apriltag")


def after(readings: list[Rows | None], marked: MarksCheck | None = None, bin_: CarrierCheck | None = None) -> Watch:
    watch = Watch()
    for reading in readings:
        watch = drift.step(watch, reading, marked, carrier=bin_)
    return watch


@pytest.mark.parametrize(("off_px", "level"), [(0.15, Level.OK), (0.25, Level.OK), (0.31, Level.WARN), (0.9, Level.WARN),
                                               (1.01, Level.FAULT), (6.0, Level.FAULT)])
def test_the_verdict_goes_by_rows(off_px: float, level: Level) -> None:
    watch = after([replace(CALM, row_px=-off_px, off_px=off_px)] * 6)
    assert watch.level is level
    assert watch.row_px == -off_px
    assert f"{off_px:.2f} px" in watch.sentence


def test_a_warning_waits_for_some_cycles_and_one_bin_does_not_make_it() -> None:
    bad = replace(CALM, row_px=0.9, off_px=0.9)
    assert after([bad] * 4).level is Level.OK
    assert "few" in after([bad] * 4).sentence
    assert after([*[CALM] * 8, bad, bad]).level is Level.OK
    assert after([bad] * 5).level is Level.WARN
    assert after([*[CALM] * 20, *[bad] * 5]).level is Level.WARN
    assert after([*[bad] * 20, *[CALM] * 5]).level is Level.OK


def test_what_is_beyond_doubt_stops_its_own_cycle() -> None:
    bad = replace(CALM, row_px=2.0, off_px=2.0)
    knocked = after([*[CALM] * 20, bad])
    assert knocked.level is Level.FAULT
    assert "in this cycle" in knocked.sentence.lower()
    assert after([*[CALM] * 20, bad, CALM]).level is Level.OK
    unsure = replace(CALM, row_px=1.2, off_px=1.2, sigma_px=0.05)
    assert after([*[CALM] * 20, unsure]).level is Level.OK
    assert after([*[CALM] * 20, *[bad] * 5]).level is Level.FAULT


def test_vague_and_missing_readings_count_for_nothing() -> None:
    vague = replace(CALM, row_px=2.0, off_px=2.0, sigma_px=0.2)
    watch = after([*[CALM] * 6, *[vague, None, Rows(reason="dark")] * 10])
    assert watch.level is Level.OK
    assert watch.cycles == 36
    assert len(watch.rows) == 6


def test_what_was_read_long_ago_says_nothing_of_now() -> None:
    dark = Rows(reason="dark")
    assert "No drift" in after([*[CALM] * 9, *[dark] * 40]).sentence
    gone = after([*[CALM] * 9, *[dark] * 50])
    assert "Nothing has told in 50 cycles" in gone.sentence
    assert np.isnan(gone.off_px)
    warned = after([*[replace(CALM, off_px=0.5)] * 9, *[dark] * 60])
    assert warned.level is Level.WARN, "that nothing is seen any more makes nothing better"


def test_a_trend_is_told_before_it_warns() -> None:
    watch = after([replace(CALM, row_px=0.002 * cycle, off_px=0.002 * cycle) for cycle in range(80)])
    assert watch.level is Level.OK
    assert watch.trend_px == pytest.approx(0.2, rel=0.01)
    assert len(watch.rows) == drift.KEPT
    assert np.isnan(after([CALM] * 15).trend_px)


@pytest.mark.parametrize(("marked", "level", "says"), [
    (replace(STILL, depth_m=-0.0011), Level.WARN, "-1.1 mm"), (replace(STILL, depth_m=-0.0059), Level.FAULT, "calibrate again"),
    (replace(STILL, shift_m=(0.0006, 0.0006, -0.0006)), Level.WARN, "mount"), (STILL, Level.OK, "No drift"),
    (replace(STILL, shift_m=(0.0, 0.005, 0.0)), Level.FAULT, "5.0 mm")])
def test_marks_tell_what_rows_do_not(marked: MarksCheck, level: Level, says: str) -> None:
    watch = after([CALM] * 6, marked)
    assert watch.level is level
    assert says in watch.sentence
    assert after([CALM] * 6, MarksCheck(reason="none")).level is Level.OK


def test_the_turn_to_correct_is_the_marks_where_there_are_some() -> None:
    pitched = replace(CALM, pitch_rad=0.0004, roll_rad=0.0001)
    assert after([pitched] * 6).rotation_rad == (0.0004, 0.0, 0.0001)
    assert after([pitched] * 6, replace(STILL, rotation_rad=(0.0004, 0.0002, 0.0))).rotation_rad == (0.0004, 0.0002, 0.0)


def test_a_bin_that_stands_higher_only_warns() -> None:
    tilted = geometry.make(Rotation.from_rotvec([0.01, 0, 0.1]).as_matrix(), np.array([0.02, 0.0, 0.006]))
    seen = carrier.check(tilted)
    assert seen.shift_m == 0.006
    assert seen.tilt_rad == pytest.approx(0.01, rel=1e-3)
    assert after([CALM] * 6, bin_=seen).level is Level.WARN
    assert after([CALM] * 6, bin_=CarrierCheck(-0.05, 0.0)).level is Level.WARN
    assert after([CALM] * 6, bin_=CarrierCheck(0.002, 0.0)).level is Level.OK
