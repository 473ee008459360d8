"""Pictures and the cloud of a finished cycle, for people: pure functions, drawn when somebody asks."""

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from binpick import geometry
from binpick.cycle import CycleInput, CycleResult
from binpick.data import Image, OrganisedCloud, Rectified
from binpick.geometry import Points, Transform
from binpick.message import PoseMessage, Triple
from binpick.result import GraspMessage, ReturnCode
from binpick.settings import SuctionTool, Tool

Picture = UInt8[np.ndarray, "h w 3"]
Colour = tuple[int, int, int]

NOT_MEASURED: Colour = (48, 46, 44)
INK: Colour = (244, 240, 236)
BANNER: dict[str, Colour] = {"poses": (84, 130, 34), "none": (30, 118, 186), "failed": (44, 44, 170)}
BIN: Colour = (196, 176, 84)
EXPECTED: Colour = (64, 96, 250)
SHADOW: Colour = (20, 20, 20)
BEST: Colour = (96, 220, 96)
OTHERS: Colour = (64, 176, 250)
RING = np.linspace(0, 2 * np.pi, 49)
BRIGHTER = np.round(255 * (np.arange(256) / 255) ** 0.65).astype(np.uint8)
"""For eyes: exposure is set for bright parts, and the bin around them is dark."""


def render(inputs: CycleInput, cycle: CycleResult, name: str) -> tuple[str, bytes]:
    """The media type and bytes of an artefact, for every cycle however far it came.

    cloud.ply: measured points only, float32 x y z in metres, frame `camera`. overlay.png, disparity.png and confidence.png show
    the rectified left window. left.png and right.png are the images as taken. Raises KeyError for another name.
    """
    return "image/png" if name.endswith(".png") else "application/octet-stream", DRAW[name](inputs, cycle)


def ply(cloud: OrganisedCloud | None) -> bytes:
    """Binary little-endian PLY of the measured points, float32 x y z in metres, frame `camera`."""
    points = np.empty((0, 3), np.float32) if cloud is None else cloud.xyz[np.isfinite(cloud.xyz).all(axis=2)]
    header = ("ply\nformat binary_little_endian 1.0\ncomment binpick: measured points, metres, frame camera\n"
              f"element vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\nend_header\n")
    return header.encode() + points.astype("<f4").tobytes()


def _left(inputs: CycleInput, _cycle: CycleResult) -> bytes:
    return _png(inputs.pair.left.image)


def _right(inputs: CycleInput, _cycle: CycleResult) -> bytes:
    return _png(inputs.pair.right.image)


def _cloud(_inputs: CycleInput, cycle: CycleResult) -> bytes:
    return ply(cycle.cloud)


def _disparity(inputs: CycleInput, cycle: CycleResult) -> bytes:
    """Near is red, far is blue, not measured is dark grey; the scale is that of this picture."""
    if cycle.depth is None or cycle.rectified is None or not cycle.depth.measured.any():
        return _png(_blank(inputs, cycle))
    disparity, measured, rectified = cycle.depth.disparity, cycle.depth.measured, cycle.rectified
    far, near = (float(value) for value in np.percentile(disparity[measured], (1, 99)))
    scaled = np.clip((np.nan_to_num(disparity) - far) / max(near - far, 1e-6), 0, 1)
    picture = cv2.applyColorMap((scaled * 255).astype(np.uint8), cv2.COLORMAP_TURBO)
    picture[~measured] = NOT_MEASURED
    z_mm = [round(1000 * rectified.focal_px * rectified.baseline_m / max(d, 1e-6)) for d in (near, far)]
    return _png(_captioned(picture, f"red {z_mm[0]} mm, blue {z_mm[1]} mm, grey not measured: "
                                    f"{measured.mean():.0%} of the window measured", NOT_MEASURED))


def _confidence(inputs: CycleInput, cycle: CycleResult) -> bytes:
    if cycle.depth is None:
        return _png(_blank(inputs, cycle))
    picture = cv2.applyColorMap(cycle.depth.confidence, cv2.COLORMAP_VIRIDIS)
    return _png(_captioned(picture, "yellow certain, violet not", NOT_MEASURED))


def _overlay(inputs: CycleInput, cycle: CycleResult) -> bytes:
    result = cycle.result
    if cycle.rectified is None:
        return _png(_captioned(_colour(inputs.pair.left.image), _sentence(result.return_code), _banner(result.return_code)))
    seen = cycle.shown if cycle.shown is not None else cycle.rectified.left[:, cycle.rectified.margin:]
    picture = _colour(cv2.LUT(seen, BRIGHTER))
    if cycle.segments is not None:
        picture = _tinted(picture, cycle.segments.parts)
    if result.bin is not None and result.bin.T_camera_bin is not None:
        _draw_bin(picture, cycle.rectified, _transform(result.bin.T_camera_bin), inputs.job.bin.inner_size_m, BIN)
    elif (T_camera_expected := _expected(inputs)) is not None:
        _draw_bin(picture, cycle.rectified, T_camera_expected, inputs.job.bin.inner_size_m, EXPECTED)
    T_camera_frame = {"camera": np.eye(4)}
    if result.bin is not None and result.bin.T_camera_bin is not None:
        T_camera_frame["bin"] = _transform(result.bin.T_camera_bin)
    if (T_base_camera := inputs.T_base_camera) is not None:
        T_camera_frame["base"] = geometry.inverse(T_base_camera)
    for grasp in reversed(result.grasps):  # the best one on top
        _draw_grasp(picture, cycle.rectified, T_camera_frame[grasp.frame], grasp, inputs.job.tool_numbered(grasp.tool.number))
    return _png(_captioned(picture, _sentence(result.return_code), _banner(result.return_code)))


def _tinted(picture: Picture, parts: np.ndarray) -> Picture:
    """Each part in a hue of its own; neighbours in label are far apart in hue (golden angle), outlines are drawn."""
    labels = cv2.resize(parts.astype(np.int16), (picture.shape[1], picture.shape[0]), interpolation=cv2.INTER_NEAREST)
    hues = (np.arange(int(labels.max()) + 1) * 137.508 / 2) % 180
    table = cv2.cvtColor(np.stack([hues, np.full_like(hues, 170), np.full_like(hues, 255)], -1)[None].astype(np.uint8),
                         cv2.COLOR_HSV2BGR)[0]
    on_part = labels > 0
    tint = table[labels]
    mixed = np.where(on_part[..., None], cv2.addWeighted(picture, 0.68, tint, 0.32, 0), (picture * 0.75).astype(np.uint8))
    edges = cv2.morphologyEx(labels, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    mixed[edges & on_part] = (0.35 * mixed + 0.65 * tint)[edges & on_part].astype(np.uint8)
    return np.ascontiguousarray(mixed)


def _expected(inputs: CycleInput) -> Transform | None:
    """Where the bin was looked for."""
    model, T_base_camera = inputs.job.bin, inputs.T_base_camera
    if model.pose.frame == "camera":
        return model.T_parent_bin
    return None if T_base_camera is None else geometry.inverse(T_base_camera) @ model.T_parent_bin


def _draw_bin(picture: Picture, rectified: Rectified, T_camera_bin: Transform, inner_size_m: Triple, colour: Colour) -> None:
    length, width, height = inner_size_m
    corners = geometry.box_corners(np.array([-length / 2, -width / 2, 0.0]), np.array([length / 2, width / 2, height]))
    pixels = _project(rectified, geometry.transform(T_camera_bin, corners))
    for first in range(8):
        for axis in (1, 2, 4):  # corners are numbered by bits: x 4, y 2, z 1
            if not first & axis:
                rim = first & 1 and axis != 1
                _line(picture, pixels[[first, first | axis]], colour, 2 if rim else 1)


def _draw_grasp(picture: Picture, rectified: Rectified, T_camera_frame: Transform, grasp: GraspMessage, tool: Tool) -> None:
    """What touches the part in its true size (lip, or open fingertips), the line it comes along, and its rank beside."""
    T_camera_tcp = T_camera_frame @ geometry.from_quaternion(np.array(grasp.position_m), np.array(grasp.quaternion_xyzw))
    outlines = [_project(rectified, geometry.transform(T_camera_tcp, outline)) for outline in _outlines(tool, grasp.open_m)]
    way = _project(rectified, geometry.transform(T_camera_tcp, np.array([[0, 0, -grasp.approach_m], [0, 0, 0.0]])))
    colour = BEST if grasp.rank == 1 else OTHERS
    scale = max(1.0, picture.shape[1] / 900)
    along = way[0] - way[1]
    length = float(np.linalg.norm(along))
    away = along / length if length > 1 else np.array([0.0, -1.0])
    beside = way[1] + away * max(length, float(np.ptp(np.concatenate(outlines), axis=0).max()) / 2 + 18 * scale)
    for ink, extra in ((SHADOW, 3), (colour, 0)):  # dark below bright: readable on any ground
        _line(picture, np.stack([beside, way[1]]), ink, round(scale) + extra)
        for outline in outlines:
            _line(picture, outline, ink, round(2 * scale) + extra)
    _badge(picture, beside, str(grasp.rank), colour, scale)


def _outlines(tool: Tool, open_m: float) -> list[np.ndarray]:
    """Closed lines in the plane of the TCP: the lip, or both open fingertips."""
    if isinstance(tool, SuctionTool):
        return [tool.cups[0].radius_m * np.stack([np.cos(RING), np.sin(RING), np.zeros_like(RING)], -1)]
    inner, outer, half = open_m / 2, open_m / 2 + tool.fingers.thickness_m, tool.fingers.pad_width_m / 2
    corners = np.array([[inner, -half, 0.0], [outer, -half, 0.0], [outer, half, 0.0], [inner, half, 0.0], [inner, -half, 0.0]])
    return [corners * [side, 1, 1] for side in (-1, 1)]


def _badge(picture: Picture, centre: Float[np.ndarray, "2"], text: str, colour: Colour, scale: float) -> None:
    at = (round(float(centre[0])), round(float(centre[1])))
    radius = round(13 * scale)
    cv2.circle(picture, at, radius + 2, SHADOW, -1, cv2.LINE_AA)
    cv2.circle(picture, at, radius, colour, -1, cv2.LINE_AA)
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_DUPLEX, 0.62 * scale, round(1.4 * scale))
    cv2.putText(picture, text, (at[0] - width // 2, at[1] + height // 2), cv2.FONT_HERSHEY_DUPLEX, 0.62 * scale, SHADOW,
                round(1.4 * scale), cv2.LINE_AA)


def _project(rectified: Rectified, points_camera: Points) -> Float[np.ndarray, "n 2"]:
    """Pixels of the window; points are kept 5 cm off the lens plane, where they would fly to infinity."""
    points = geometry.transform(geometry.inverse(rectified.T_camera_rect), points_camera)
    z = np.maximum(points[:, 2], 0.05)
    return np.stack([rectified.focal_px * points[:, 0] / z + rectified.cx_px - rectified.window.x,
                     rectified.focal_px * points[:, 1] / z + rectified.cy_px - rectified.window.y], -1)


def _line(picture: Picture, pixels: Float[np.ndarray, "n 2"], colour: Colour, thickness: int) -> None:
    """With 1/16 px positions; far outside is clipped to what OpenCV's integers hold."""
    fixed = np.round(np.clip(pixels, -30000, 30000) * 16).astype(np.int32)
    cv2.polylines(picture, [fixed.reshape(-1, 1, 2)], False, colour, thickness, cv2.LINE_AA, shift=4)


def _captioned(picture: Picture, text: str, ground: Colour) -> UInt8[np.ndarray, "h2 w 3"]:
    """The picture under a strip with the text in it, as large as fits."""
    scale, thick = picture.shape[1] / 1000, max(1, round(picture.shape[1] / 800))
    width = cv2.getTextSize(text, cv2.FONT_HERSHEY_DUPLEX, scale, thick)[0][0]
    scale = min(scale, scale * 0.95 * picture.shape[1] / max(width, 1))
    strip = np.full((round(picture.shape[1] * 0.055), picture.shape[1], 3), ground, np.uint8)
    height = cv2.getTextSize(text, cv2.FONT_HERSHEY_DUPLEX, scale, thick)[0][1]
    cv2.putText(strip, text, (round(0.022 * picture.shape[1]), (strip.shape[0] + height) // 2), cv2.FONT_HERSHEY_DUPLEX, scale,
                INK, thick, cv2.LINE_AA)
    return np.concatenate([strip, picture])


def _blank(inputs: CycleInput, cycle: CycleResult) -> UInt8[np.ndarray, "h w 3"]:
    """Nothing was measured, and the picture says so."""
    shape = inputs.pair.left.image.shape if cycle.rectified is None else (
        cycle.rectified.window.height, cycle.rectified.window.width)
    return _captioned(np.full((*shape, 3), NOT_MEASURED, np.uint8), "nothing was measured in this cycle", NOT_MEASURED)


def _sentence(code: ReturnCode) -> str:
    return f"{code.value}  {code.message}".encode("ascii", "replace").decode()  # OpenCV's letters are ASCII


def _banner(code: ReturnCode) -> Colour:
    return BANNER["poses" if code.code.carries_poses else "none" if code.value > 0 else "failed"]


def _colour(image: Image) -> Picture:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))


def _transform(pose: PoseMessage) -> Transform:
    return geometry.from_quaternion(np.array(pose.position_m), np.array(pose.quaternion_xyzw))


def _png(picture: np.ndarray) -> bytes:
    """Level 1: a third of the time for a tenth more bytes than OpenCV's own choice."""
    return cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


DRAW: dict[str, Callable[[CycleInput, CycleResult], bytes]] = {
    "cloud.ply": _cloud, "overlay.png": _overlay, "disparity.png": _disparity, "confidence.png": _confidence,
    "left.png": _left, "right.png": _right}
