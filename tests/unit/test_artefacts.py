"""Pictures and cloud of hand-made cycles: a point is drawn where the pinhole model says, in whatever frame its pose came."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from binpick import artefacts, geometry
from binpick.cycle import CycleInput, CycleResult
from binpick.data import Depth, Frame, OrganisedCloud, Rectified, Segments, StereoPair, Window, frozen
from binpick.errors import Code
from binpick.geometry import Transform
from binpick.result import BinMessage, FrameName, GraspMessage, PoseMessage, Request, Result, ReturnCode, Sigma, ToolMessage
from binpick.rig import Rig
from binpick.settings import Bin, Job, Pose, Recipe, SuctionTool, TwoFingerTool

WIDTH, HEIGHT, MARGIN, FOCAL = 400, 300, 32, 500.0
STRIP = round(WIDTH * 0.055)
NAMES = ("cloud.ply", "overlay.png", "disparity.png", "confidence.png", "left.png", "right.png")
T_CAMERA_RECT = geometry.from_quaternion(np.zeros(3), np.array([0.02, -0.01, 0.03, 1.0]))
T_CAMERA_BIN = geometry.from_quaternion(np.array([0.01, -0.02, 1.0]), np.array([1.0, 0.03, 0.02, 0.01]))
T_BASE_RIG = geometry.from_quaternion(np.array([0.4, 0.1, 1.2]), np.array([0.9, 0.1, -0.3, 0.2]))


def rows(T: Transform) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in T.tolist())


def message(T: Transform) -> PoseMessage:
    return PoseMessage(position_m=tuple(T[:3, 3].tolist()), quaternion_xyzw=tuple(geometry.quaternion(T).tolist()))


def inputs(request: Request | None = None, **hand_eye: object) -> CycleInput:
    image = frozen(np.full((320, 440), 90, np.uint8))
    frames = [Frame(image, name, 1, 1, 1, 1, 2, 6000.0, 0.0) for name in ("left", "right")]
    rig = Rig.model_validate({"image_size_px": (440, 320), "cameras": [
        {"name": name, "K": ((FOCAL, 0, 220), (0, FOCAL, 160), (0, 0, 1)), "distortion": (0, 0, 0, 0),
         "T_cam_rig": rows(geometry.translation(x, 0.0, 0.0))} for name, x in (("left", 0.0), ("right", -0.15))], **hand_eye})
    job = Job(recipe=Recipe(), bin=Bin(inner_size_m=(0.4, 0.3, 0.1), pose=Pose(position_m=(0, 0, 1))), tools=(SuctionTool(),))
    pair = StereoPair(frames[0], frames[1], "2026-01-02T03:04:05.678Z", 0.0, 0.0, "none")
    return CycleInput(3, pair, rig, job, request or Request())


def cycle(code: Code = Code.OK, *grasps: GraspMessage) -> CycleResult:
    shape = (HEIGHT, WIDTH)
    measured = np.zeros(shape, bool)
    measured[100:200, 100:300] = True
    disparity = np.where(measured, np.linspace(70, 90, WIDTH, dtype=np.float32)[None], np.nan).astype(np.float32)
    window = Window(20, 10, WIDTH, HEIGHT, 64, 32)
    xyz = np.full((*shape, 3), np.nan, np.float32)
    xyz[measured] = np.random.default_rng(1).normal(size=(int(measured.sum()), 3)).astype(np.float32)
    padded = frozen(np.full((HEIGHT, WIDTH + MARGIN), 60, np.uint8))
    parts = np.zeros((HEIGHT // 2, WIDTH // 2), np.int32)
    parts[60:80, 60:90], parts[60:80, 100:140] = 1, 2
    half = np.zeros((*parts.shape, 3), np.float32)
    segments = Segments(xyz=half, normal=half, faces=parts, parts=parts, part_points={}, part_confidence={1: 1.0, 2: 1.0})
    result = Result(cycle_id=3, request=Request(), captured_at="2026-01-02T03:04:05.678Z", return_code=ReturnCode.of(code),
                    bin=BinMessage(found=True, number=1, T_camera_bin=message(T_CAMERA_BIN), fill_level=0.2, coverage=0.9),
                    grasps=grasps)
    return CycleResult(
        result, Rectified(padded, padded, window, MARGIN, FOCAL, 0.15, 220.0, 160.0, T_CAMERA_RECT),
        Depth(disparity, lambda: np.nan_to_num(disparity), (measured * 255).astype(np.uint8), measured,
              np.where(measured, np.float32(0.2), np.float32(np.nan))),
        lambda: OrganisedCloud(xyz, np.zeros(shape, np.float32), window), segments)


def grasp(T_frame_tcp: Transform, frame: FrameName, rank: int = 1) -> GraspMessage:
    return GraspMessage(
        id=f"3-{rank}", rank=rank, tool=ToolMessage(number=1, name="suction", kind="suction"), frame=frame, approach_m=0.08,
        T_frame_pregrasp=message(T_frame_tcp @ geometry.translation(0.0, 0.0, -0.08)), lift_m=0.1, open_m=0, close_m=0,
        quality=1, sigma=Sigma(xy_m=0, z_m=0, tilt_rad=0), clearance_m=0.01, part_id=1, **message(T_frame_tcp).model_dump())


def picture(body: bytes) -> np.ndarray:
    decoded = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    return decoded


def test_the_cloud_is_binary_ply_of_the_measured_points_alone() -> None:
    outcome = cycle()
    media, body = artefacts.render(inputs(), outcome, "cloud.ply")
    header, _, data = body.partition(b"end_header\n")
    assert media == "application/octet-stream"
    assert b"format binary_little_endian 1.0\n" in header
    assert b"element vertex 20000\n" in header
    points = np.frombuffer(data, "<f4").reshape(-1, 3)
    assert outcome.cloud is not None
    np.testing.assert_array_equal(points, outcome.cloud.xyz[100:200, 100:300].reshape(-1, 3))


def test_raw_images_are_unchanged() -> None:
    media, body = artefacts.render(inputs(), cycle(), "left.png")
    assert media == "image/png"
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_UNCHANGED),
                                  inputs().pair.left.image)


def test_what_was_not_measured_is_dark_grey_and_nowhere_else() -> None:
    shown = picture(artefacts.render(inputs(), cycle(), "disparity.png")[1])[STRIP:]
    grey = (shown == artefacts.NOT_MEASURED).all(axis=2)
    depth = cycle().depth
    assert depth is not None
    np.testing.assert_array_equal(grey, ~depth.measured)


def test_a_grasp_is_drawn_where_the_pinhole_model_puts_it() -> None:
    at_rect = np.array([0.03, -0.02, 0.9])
    T_camera_tcp = geometry.make(T_CAMERA_RECT[:3, :3], geometry.transform(T_CAMERA_RECT, at_rect))
    shown = picture(artefacts.render(inputs(), cycle(Code.OK, grasp(T_camera_tcp, "camera")), "overlay.png")[1])
    u, v = FOCAL * 0.03 / 0.9 + 220 - 20, FOCAL * -0.02 / 0.9 + 160 - 10 + STRIP
    radius_px = FOCAL * 0.007 / 0.9
    best = np.abs(shown.astype(int) - artefacts.BEST).max(axis=2) < 40
    lip = [best[round(v + radius_px * np.sin(a)), round(u + radius_px * np.cos(a))] for a in np.linspace(0, 6.28, 24)]
    assert np.mean(lip) > 0.8


def test_open_fingers_are_drawn_on_either_side() -> None:
    tool = TwoFingerTool(kind="two_finger")
    given = inputs()
    given = replace(given, job=given.job.model_copy(update={"tools": (tool,)}))
    pinch = grasp(geometry.make(T_CAMERA_RECT[:3, :3], geometry.transform(T_CAMERA_RECT, np.array([0.0, 0.0, 0.9]))), "camera")
    shown = picture(artefacts.render(given, cycle(Code.OK, pinch.model_copy(update={"open_m": 0.05})), "overlay.png")[1])
    best = np.abs(shown.astype(int) - artefacts.BEST).max(axis=2) < 40
    middle, inner_px = 160 - 10 + STRIP, FOCAL * 0.025 / 0.9
    assert all(best[middle - 1:middle + 2, round(220 - 20 + side * inner_px)].any() for side in (-1, 1))


@pytest.mark.parametrize("mounting", ["fixed", "flange"])
def test_the_same_grasp_looks_the_same_in_every_frame(mounting: str) -> None:
    T_camera_tcp = T_CAMERA_BIN @ geometry.from_quaternion(np.array([0.05, 0.02, 0.03]), np.array([1.0, 0.1, 0, 0]))
    T_base_flange = geometry.from_quaternion(np.array([0.1, 0.9, 0.5]), np.array([0.1, 0.2, 0.3, 1.0]))
    if mounting == "fixed":
        given = inputs(T_base_rig=rows(T_BASE_RIG))
    else:
        given = inputs(Request(T_base_flange=message(T_base_flange)),
                       T_flange_rig=rows(geometry.inverse(T_base_flange) @ T_BASE_RIG))
    shown = [picture(artefacts.render(given, cycle(Code.OK, grasp(T, frame)), "overlay.png")[1]).astype(int)
             for T, frame in ((T_camera_tcp, "camera"), (geometry.inverse(T_CAMERA_BIN) @ T_camera_tcp, "bin"),
                              (T_BASE_RIG @ T_camera_tcp, "base"))]
    # positions are drawn in sixteenths of a pixel: rounding there may shade an edge
    assert all((np.abs(other - shown[0]).max(axis=2) > 60).sum() <= 4 for other in shown[1:])


def test_a_bin_that_was_not_found_is_outlined_where_it_was_expected() -> None:
    outcome = cycle(Code.BIN_NOT_FOUND)
    assert outcome.result.bin is not None
    lost = outcome.result.bin.model_copy(update={"found": False, "T_camera_bin": None})
    image = picture(artefacts.render(inputs(), replace(outcome, result=outcome.result.model_copy(update={"bin": lost})),
                                     "overlay.png")[1])
    found = picture(artefacts.render(inputs(), outcome, "overlay.png")[1])
    for drawn, colour in ((image, artefacts.EXPECTED), (found, artefacts.BIN)):
        assert (np.abs(drawn.astype(int) - colour).max(axis=2) < 40).sum() > 200
    assert (np.abs(image.astype(int) - artefacts.BIN).max(axis=2) < 40).sum() < 20


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("code", [Code.OK, Code.BIN_EMPTY, Code.TIMEOUT])
def test_every_artefact_exists_however_far_the_cycle_came(name: str, code: Code) -> None:
    whole = cycle(code)
    stages = (whole, replace(whole, segments=None), replace(whole, segments=None, reprojected=None, depth=None),
              CycleResult(whole.result))
    for reached in stages:
        body = artefacts.render(inputs(), reached, name)[1]
        assert body.startswith(b"ply\n") if name.endswith("ply") else picture(body).size


def test_an_all_black_cycle_has_an_empty_cloud_and_says_that_nothing_was_measured() -> None:
    whole = cycle(Code.NO_DEPTH)
    assert whole.depth is not None
    cloud = whole.cloud
    assert cloud is not None
    nothing = np.zeros((HEIGHT, WIDTH), bool)
    blind = replace(
        whole, depth=replace(whole.depth, measured=nothing, disparity=np.full((HEIGHT, WIDTH), np.nan, np.float32)),
        reprojected=lambda: replace(cloud, xyz=np.full((HEIGHT, WIDTH, 3), np.nan, np.float32)))
    assert artefacts.render(inputs(), blind, "cloud.ply")[1].endswith(b"end_header\n")
    shown = picture(artefacts.render(inputs(), blind, "disparity.png")[1])[STRIP:]
    assert (shown == artefacts.NOT_MEASURED).all()


def test_the_banner_tells_success_from_an_answer_and_from_a_failure() -> None:
    banners = {tuple(picture(artefacts.render(inputs(), cycle(code), "overlay.png")[1])[1, 1])
               for code in (Code.OK, Code.BIN_EMPTY, Code.TIMEOUT)}
    assert banners == set(artefacts.BANNER.values())


def test_another_name_is_a_key_error() -> None:
    with pytest.raises(KeyError):
        artefacts.render(inputs(), cycle(), "passwd")
