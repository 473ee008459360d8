"""Hand-eye: real robots' sets, the exam's rig before drawn boards, a wrong pose among twelve, and what is refused."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

import printed
from binpick import geometry
from binpick.data import Image
from binpick.errors import InputError
from binpick.geometry import Transform
from binpick.rig import Rig
from binpick.rigcheck import handeye, loop, places, sight
from binpick.rigcheck.board import Board, parse
from binpick.rigcheck.detection import Detection, Quality
from binpick.rigcheck.handeye import Sample
from binpick.sim import exam

DATA = Path(__file__).parents[2] / "../shared/data"
needs_data = pytest.mark.skipif(not (DATA / "handeye_visp_eye_in_hand").is_dir(),
                                reason="the hand-eye sets of ViSP do not lie in ../shared/data")
RIG = exam.rig("A")
BOARD = parse("charuco:9x6:0.025:0.018:5x5_100")
UNJUDGED = Quality(0.8, 150.0, 20.0, 0.2, (1, 1), 0.1, 0.1)
T_BASE_RIG = np.array(RIG.T_base_rig)


def placed(rotvec_deg: list[float], position_m: list[float]) -> Transform:
    return geometry.make(Rotation.from_rotvec(rotvec_deg, degrees=True).as_matrix(), np.array(position_m, dtype=float))


T_FLANGE_RIG = placed([3, -5, 88], [0.06, -0.09, 0.07])
T_FLANGE_BOARD = placed([4, 176, 20], [0.11, -0.05, 0.05])
T_BASE_BOARD = placed([178, 2, -20], [0.5, 0.1, 0.02])


def stands(rng: np.random.Generator, board: Board, count: int = 12, tilt_deg: float = 40.0) -> list[Transform]:
    """T_rig_board of a board held before the rig, tilted every way and turned."""
    middle, found = board.points_m.mean(0).astype(float), []
    for _ in range(count):
        towards = rng.uniform(0, 2 * np.pi)
        axis = np.array([np.cos(towards), np.sin(towards), 0])
        tilt = Rotation.from_rotvec(axis * rng.uniform(0.3, 1) * tilt_deg, degrees=True)
        R = (tilt * Rotation.from_euler("z", rng.uniform(-90, 90), degrees=True)).as_matrix()
        where = np.array([rng.uniform(-0.05, 0.19), rng.uniform(-0.1, 0.1), rng.uniform(0.75, 0.95)])
        found.append(geometry.make(R, where - R @ middle))
    return found


def flange(T_rig_board: Transform, mounting: str) -> Transform:
    if mounting == "base":
        return T_BASE_RIG @ T_rig_board @ geometry.inverse(T_FLANGE_BOARD)
    return T_BASE_BOARD @ geometry.inverse(T_rig_board) @ geometry.inverse(T_FLANGE_RIG)


def robot(T: Transform, rng: np.random.Generator) -> Transform:
    """Off by 0.1 mm along each axis and 0.02 degrees about each."""
    return T @ geometry.make(Rotation.from_rotvec(rng.normal(0, np.radians(0.02), 3)).as_matrix(), rng.normal(0, 0.0001, 3))


def corners(T_rig_board: Transform, board: Board, rng: np.random.Generator, noise_px: float = 0.05,
            rig: Rig = RIG) -> tuple[Detection | None, ...]:
    seen = []
    for camera in rig.cameras:
        T = camera.T_camera_rig @ T_rig_board
        px = cv2.projectPoints(board.points_m.astype(float), cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], camera.K_px,
                               camera.distortion_coefficients)[0][:, 0]
        px = (px + rng.normal(0, noise_px, px.shape)).astype(np.float32)
        inside = bool((px > 0).all() and (px < np.array(rig.image_size_px)).all())
        seen.append(Detection(board, rig.image_size_px, np.arange(len(px), dtype=np.int32), px, UNJUDGED) if inside else None)
    return tuple(seen)


def taken(seed: int, mounting: str, board: Board = BOARD, count: int = 12, tilt_deg: float = 40.0) -> list[Sample]:
    rng = np.random.default_rng(seed)
    return [Sample(str(number), robot(flange(T, mounting), rng), corners(T, board, rng))
            for number, T in enumerate(stands(rng, board, count, tilt_deg), start=1)]


def turned_deg(T_a: Transform, T_b: Transform) -> float:
    return float(np.degrees(Rotation.from_matrix(T_a[:3, :3].T @ T_b[:3, :3]).magnitude()))


def off(found: handeye.HandEye) -> tuple[float, float]:
    """The worse of the rig's own place and that of what lies 0.85 m before it, mm; and the angle, degrees."""
    true, T = (T_BASE_RIG, found.T_base_rig) if found.mounting == "base" else (T_FLANGE_RIG, found.T_flange_rig)
    ways = [np.linalg.norm(geometry.transform(T, point) - geometry.transform(true, point))
            for point in (np.zeros(3), np.array([0.0, 0.0, 0.85]))]
    return 1000 * float(max(ways)), turned_deg(T, true)


def visp(name: str, spec: str) -> tuple[list[Sample], Rig]:
    """Eight images of one camera beside a robot, which is the first of a rig here."""
    K = [[607.5931396484375, 0, 323.46282958984375], [0, 607.574951171875, 243.25529479980469], [0, 0, 1]]
    cameras = [{"name": side, "K": K, "distortion": (0.0,) * 5, "T_cam_rig": geometry.translation(x, 0.0, 0.0).tolist()}
               for side, x in (("left", 0.0), ("right", -0.15))]
    samples = []
    for number in range(1, 9):
        image = cv2.imread(str(DATA / name / f"franka_image-{number}.png"), cv2.IMREAD_GRAYSCALE)
        seen = sight.find(image, parse(spec))
        assert isinstance(seen, Detection)
        numbers = re.findall(r"\[(.*?)\]", (DATA / name / f"franka_pose_rPe_{number}.yaml").read_text())
        pose = np.array(numbers, dtype=float)
        samples.append(Sample(str(number), geometry.make(Rotation.from_rotvec(pose[3:]).as_matrix(), pose[:3]), (seen, None)))
    return samples, Rig.model_validate({"image_size_px": (640, 480), "cameras": cameras})


@needs_data
def test_a_camera_on_a_real_hand() -> None:
    samples, rig = visp("handeye_visp_eye_in_hand", "chessboard:9x6:0.0236")
    mounts, boards = [sample.T_base_flange for sample in samples], [places.places(sample.seen, rig)[0] for sample in samples]
    closed = loop.best(mounts, boards, loop.free)
    assert closed[:3, 3] == pytest.approx([0.0577, -0.0339, -0.0423], abs=0.0005)
    found = handeye.solve(samples, rig, "flange")
    assert found.T_flange_rig[:3, 3] == pytest.approx([0.0577, -0.0339, -0.0423], abs=0.0005)
    assert found.T_base_rig is None
    assert found.rms_m <= 0.0055
    assert found.outliers == {}


@needs_data
def test_a_tag_on_a_real_hand() -> None:
    samples, rig = visp("handeye_visp_eye_to_hand", "apriltag:36h11:0.048")
    found = handeye.solve(samples, rig, "base")
    assert found.rms_m <= 0.005
    assert found.T_flange_rig is None
    with pytest.raises(InputError, match=r"With the rig mounted the other way.* they agree to 1\.\d mm"):
        handeye.solve(samples, rig, "flange")


@pytest.mark.skipif(not (DATA / "handeye_rct_10x10").is_dir(), reason="the hand-eye set of RCT does not lie in ../shared/data")
def test_rough_data_with_dots_that_have_four_ends() -> None:
    K = [[542.324, 0, 320.474], [0, 543.515, 226.039], [0, 0, 1]]
    cameras = [{"name": side, "K": K, "distortion": (0.0,) * 5, "T_cam_rig": geometry.translation(x, 0.0, 0.0).tolist()}
               for side, x in (("left", 0.0), ("right", -0.15))]
    samples = []
    for number in range(15):
        seen = sight.find(cv2.imread(str(DATA / f"handeye_rct_10x10/images/{number}.png"), cv2.IMREAD_GRAYSCALE),
                          parse("circles:10x10:0.0254"))
        pose = yaml.safe_load((DATA / f"handeye_rct_10x10/poses/{number}.yaml").read_text())
        T = geometry.from_quaternion(np.array([pose[k] for k in ("x", "y", "z")]),
                                     np.array([pose[k] for k in ("qx", "qy", "qz", "qw")]))
        assert isinstance(seen, Detection)
        samples.append(Sample(str(number), T, (seen, None)))
    found = handeye.solve(samples, Rig.model_validate({"image_size_px": (640, 480), "cameras": cameras}), "flange")
    assert found.rms_m < 0.008    # other tools: 13.6 mm
    assert found.outliers == {}


@pytest.mark.parametrize("mounting", ["base", "flange"])
@pytest.mark.parametrize("seed", [1, 2])
def test_twelve_samples_of_the_exams_rig(mounting: str, seed: int) -> None:
    found = handeye.solve(taken(seed, mounting), RIG, mounting)
    way_mm, turn_deg = off(found)
    assert way_mm <= 0.3
    assert turn_deg <= 0.05
    assert found.outliers == {}
    assert 0.02 < 1000 * found.sigma_m < 0.4
    assert found.rms_m < 0.0007


def photograph(T_rig_board: Transform, camera: int, board: Board, rng: np.random.Generator) -> Image:
    """A camera's image of the drawn chessboard, through its lens, three rays each way for a pixel; blurred, with noise."""
    drawn, side = printed.chessboard(board.columns, board.rows), printed.SIDE_PX
    lens = RIG.cameras[camera]
    T = lens.T_camera_rig @ T_rig_board
    outline = np.array([[x, y, 0.0] for x in (-2, board.columns + 1) for y in (-2, board.rows + 1)]) * board.square_m
    px = cv2.projectPoints(outline, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], lens.K_px, lens.distortion_coefficients)[0][:, 0]
    low, high = np.floor(px.min(0)).astype(int) - 8, np.ceil(px.max(0)).astype(int) + 8
    u, v = np.meshgrid(*(np.arange(a, b, dtype=float) for a, b in zip(low, high, strict=True)))
    rays = cv2.undistortPoints(np.stack([u, v], -1).reshape(-1, 1, 2), lens.K_px, lens.distortion_coefficients)[:, 0]
    on_board = np.column_stack([rays, np.ones(len(rays))]) @ np.linalg.inv(T[:3, [0, 1, 3]]).T
    at = (on_board[:, :2] / on_board[:, 2:] / board.square_m * side + 2 * side - 0.5).astype(np.float32).reshape(*u.shape, 2)
    at = cv2.resize(at, None, fx=3, fy=3, interpolation=cv2.INTER_LINEAR)
    fine = cv2.remap(drawn, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=120)
    patch = cv2.resize(cv2.GaussianBlur(fine, None, 2.1), None, fx=1 / 3, fy=1 / 3, interpolation=cv2.INTER_AREA)
    whole = np.full(RIG.image_size_px[::-1], 120.0)
    whole[low[1]:high[1], low[0]:high[0]] = patch
    return np.clip(whole + rng.normal(0, 2, whole.shape), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def photographed() -> Callable[[str], list[Sample]]:
    """photographed(mounting): twelve stands of the robot, the board found in the images of both cameras."""
    board, rng = parse("chessboard:9x6:0.025"), np.random.default_rng(4)
    boards = stands(rng, board)
    seen = []
    for T in boards:
        found = [sight.find(photograph(T, camera, board, rng), board) for camera in (0, 1)]
        assert all(isinstance(each, Detection) for each in found)
        seen.append(tuple(found))
    return lambda mounting: [Sample(str(number), robot(flange(T, mounting), np.random.default_rng(number)), each)
                             for number, (T, each) in enumerate(zip(boards, seen, strict=True), start=1)]


@pytest.mark.parametrize("mounting", ["base", "flange"])
def test_drawn_boards_through_the_exams_cameras(photographed: Callable[[str], list[Sample]], mounting: str) -> None:
    samples = photographed(mounting)
    found = handeye.solve(samples, RIG, mounting)
    way_mm, turn_deg = off(found)
    assert way_mm <= 0.3
    assert turn_deg <= 0.05
    assert found.outliers == {}
    wrong = replace(samples[6], T_base_flange=samples[6].T_base_flange @ placed([0, 0, 0], [0.004, 0, 0]))
    without = handeye.solve([*samples[:6], wrong, *samples[7:]], RIG, mounting)
    assert set(without.outliers) == {"7"}
    assert off(without)[0] <= 0.3


@pytest.mark.parametrize(("mounting", "change"), [
    ("base", placed([0, 0, 0], [0.003, 0.001, 0])), ("base", placed([0, 1.5, 0], [0, 0, 0])),
    ("flange", placed([0, 0.7, 0], [0, 0, 0])), ("flange", placed([120, 0, 0], [0.2, 0, 0]))])
def test_one_wrong_pose_among_twelve_is_named(mounting: str, change: Transform) -> None:
    samples = taken(5, mounting)
    wrong = replace(samples[8], T_base_flange=samples[8].T_base_flange @ change)
    found = handeye.solve([*samples[:8], wrong, *samples[9:]], RIG, mounting)
    assert set(found.outliers) == {"9"}
    assert "the pose is wrong, or the robot or the board moved" in found.outliers["9"]
    without = handeye.solve([*samples[:8], *samples[9:]], RIG, mounting)
    for T, known in ((found.T_base_rig, without.T_base_rig), (found.T_flange_rig, without.T_flange_rig)):
        assert (T is None) == (known is None)
        assert T is None or pytest.approx(known, abs=1e-7) == T


def test_a_pose_that_belongs_to_another_sample_is_said_so() -> None:
    samples = taken(6, "base")
    samples[2] = replace(samples[2], seen=samples[9].seen)
    samples[5] = replace(samples[5], seen=(None, None))
    found = handeye.solve(samples, RIG, "base")
    assert set(found.outliers) == {"3", "6"}
    assert "the pose of 10 would fit it" in found.outliers["3"]
    assert found.outliers["6"] == "no camera sees the board"
    assert set(found.residuals) == {sample.name for sample in samples} - {"6"}


def test_a_board_numbered_from_either_end() -> None:
    board = parse("circles:9x7:0.02:0.012")
    samples, rng = taken(7, "flange", board), np.random.default_rng(0)
    turned = [replace(sample, seen=tuple(None if each is None else replace(each, corners_px=each.corners_px[board.turns[0]])
                                         for each in sample.seen)) if rng.uniform() < 0.5 else sample for sample in samples]
    found = handeye.solve(turned, RIG, "flange")
    assert off(found)[0] <= 0.3
    assert found.outliers == {}
    assert found.rms_px < 2


def four_axes(mounting: str, count: int = 10) -> tuple[list[Sample], float]:
    """A robot that turns about z and moves; the board lies nearly flat before a rig that looks down, or stands on it."""
    rng, samples = np.random.default_rng(8), []
    T_flange_board, T_flange_rig = placed([178, 3, 0], [0.03, 0.04, -0.02]), placed([180, 0, 30], [0.05, 0.02, 0.05])
    T_base_board = placed([2, -1, 10], [0.4, 0.05, 0.013])
    for number in range(count):
        turn = placed([0, 0, rng.uniform(-70, 70)], [0, 0, 0])
        if mounting == "base":
            over = geometry.transform(T_BASE_RIG, np.array([0.07, 0.0, 0.85]))
            T = geometry.translation(*(over + rng.uniform(-0.08, 0.08, 3) * [1, 1, 0.5])) @ turn
            T_rig_board = geometry.inverse(T_BASE_RIG) @ T @ T_flange_board
        else:
            T = geometry.translation(*(np.array([0.4, 0.1, 0.95]) + rng.uniform(-0.06, 0.06, 3))) @ turn
            T_rig_board = geometry.inverse(T @ T_flange_rig) @ T_base_board
        samples.append(Sample(str(number), robot(T, rng), corners(T_rig_board, BOARD, rng)))
    return samples, float((T_flange_board if mounting == "base" else T_base_board)[2, 3])


@pytest.mark.parametrize("mounting", ["base", "flange"])
def test_a_robot_with_four_axes_is_told_the_height(mounting: str) -> None:
    samples, z_m = four_axes(mounting)
    assert sum(any(sample.seen) for sample in samples) >= 8
    with pytest.raises(InputError, match=r"about its z .* only by 0\.\d about other axes: add samples tilted .* x and y"):
        handeye.solve(samples, RIG, mounting)
    found = handeye.solve(samples, RIG, mounting, z_m)
    true = T_BASE_RIG if mounting == "base" else placed([180, 0, 30], [0.05, 0.02, 0.05])
    T = found.T_base_rig if mounting == "base" else found.T_flange_rig
    there = np.array([0.0, 0.0, 0.85])
    assert geometry.transform(T, there) == pytest.approx(geometry.transform(true, there), abs=0.0005)
    assert turned_deg(T, true) < 0.1
    assert found.T_carrier_board[2, 3] == pytest.approx(z_m, abs=1e-9)


def test_what_is_missing_is_named() -> None:
    samples = taken(9, "base")
    with pytest.raises(InputError, match="seen in 4 samples, 5 are needed"):
        handeye.solve(samples[:4], RIG, "base")
    with pytest.raises(InputError, match="such poses tell the height; leave z out"):
        handeye.solve(samples, RIG, "base", 0.1)
    with pytest.raises(InputError, match="different boards"):
        handeye.solve([*samples, *taken(9, "base", parse("charuco:8x6:0.025"), 1)], RIG, "base")
    still = [replace(sample, T_base_flange=geometry.translation(0.01 * k, 0.0, 0.0)) for k, sample in enumerate(samples)]
    with pytest.raises(InputError, match="hardly turned"):
        handeye.solve(still, RIG, "base")
    rng = np.random.default_rng(0)
    strewn = [replace(sample, T_base_flange=sample.T_base_flange @ placed([0, 0, 0], rng.normal(0, 0.05, 3)))
              for sample in samples]
    with pytest.raises(InputError, match="Check that each pose belongs to its images"):
        handeye.solve(strewn, RIG, "base")


def test_the_wrong_mounting_that_agrees_to_some_millimetres() -> None:
    """A board tilted this way and that about one stand, and never turned in its plane: enough samples fit both ways."""
    rng, middle, samples = np.random.default_rng(1), BOARD.points_m.mean(0).astype(float), []
    tilts = [(0, 0), (25, 0), (-25, 0), (0, 25), (0, -25), (28, 5), (-28, 5), (5, 28), (5, -28), (0, 0)]
    places = [(0.07, 0, 0.85), (-0.02, -0.09, 0.82), (0.17, -0.09, 0.84), (-0.03, 0.1, 0.8), (0.18, 0.1, 0.8),
              (0.07, -0.1, 0.78), (0.07, 0.1, 0.78), (-0.02, 0, 0.8), (0.17, 0, 0.8), (0.07, 0, 0.75)]
    for number, (tilt, where) in enumerate(zip(tilts, places, strict=True), start=1):
        R = Rotation.from_euler("xy", tilt, degrees=True).as_matrix()
        T = geometry.make(R, np.array(where) - R @ middle)
        samples.append(Sample(str(number), robot(flange(T, "base"), rng), corners(T, BOARD, rng)))
    assert handeye.solve(samples, RIG, "base").rms_m < 0.001
    with pytest.raises(InputError, match=r"With the rig mounted the other way.* they agree to 0\.\d mm"):
        handeye.solve(samples, RIG, "flange")


def test_the_same_samples_give_the_same_bytes() -> None:
    first, again = (handeye.solve(taken(10, "flange"), RIG, "flange") for _ in range(2))
    assert first.T_flange_rig.tobytes() == again.T_flange_rig.tobytes()
    assert first.residuals == again.residuals
