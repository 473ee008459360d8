"""Planted scenes: exact depth of boxes in a bin, without images or matching."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

import staged
from binpick import geometry, settings
from binpick.cycle import CycleInput
from binpick.data import Depth, Frame, Rectified, StereoPair, Window
from binpick.geometry import Transform
from binpick.result import Request
from binpick.rig import Rig
from binpick.sim import exam
from binpick.sim.render import Renderer
from binpick.sim.world import ScenePart, WorldScene
from binpick.stereo import rectify

CELL = """
bin:
  inner_size_m: [0.30, 0.20, 0.10]
  pose: {frame: camera, position_m: [0.0, 0.0, 1.0], rotvec_rad: [3.14159265358979, 0, 0]}
recipes: [{number: 1, frame: bin}]
"""


@dataclass(frozen=True)
class Slab:
    """A box on the bin's floor: centre, full size, height of its top, and the tilt of that top about x."""

    x: float
    y: float
    length: float
    width: float
    top: float
    tilt: float = 0.0


@dataclass(frozen=True)
class Planted:
    """What the stages read, of a scene whose truth is known."""

    rig: Rig
    job: settings.Job
    depth: Depth
    rectified: Rectified
    T_camera_bin: Transform

    @property
    def T_bin_camera(self) -> Transform:
        return geometry.inverse(self.T_camera_bin)


def plain_rig() -> Rig:
    K = ((1740.0, 0.0, 968.0), (0.0, 1740.0, 608.0), (0.0, 0.0, 1.0))
    still = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    aside = ((1.0, 0.0, 0.0, -0.15), *still[1:])
    cameras = [{"name": n, "K": K, "distortion": (0.0,) * 5, "T_cam_rig": T} for n, T in (("left", still), ("right", aside))]
    return Rig.model_validate({"image_size_px": (1936, 1216), "cameras": cameras})


@pytest.fixture
def rig() -> Rig:
    return plain_rig()


@pytest.fixture
def job() -> settings.Job:
    return settings.resolve(settings.parse(CELL, "cell.yaml"))


@pytest.fixture
def plant(rig: Rig, job: settings.Job) -> Callable[..., Planted]:
    """plant(slabs, noise_px, seed, unseen=[(x, y, radius)]): exact disparity of slabs in the bin, with noise and holes."""

    def make(slabs: list[Slab], noise_px: float = 0.0, seed: int = 0,
             unseen: tuple[tuple[float, float, float], ...] = ()) -> Planted:
        T_camera_bin = job.bin.T_parent_bin
        rect = rectify.rectification(rig)
        low, high = np.array([-0.15, -0.10, 0.0]), np.array([0.15, 0.10, 0.14])
        view = rectify.window(rect, T_camera_bin, low, high)
        u, v = np.meshgrid(np.arange(view.width) + view.x - rect.cx_px, np.arange(view.height) + view.y - rect.cy_px)
        rays = np.stack([u / rect.focal_px, v / rect.focal_px, np.ones_like(u)], axis=-1)
        T_bin_rect = geometry.inverse(T_camera_bin) @ rect.T_camera_rect
        direction, origin = geometry.rotate(T_bin_rect, rays), T_bin_rect[:3, 3]
        depth = -origin[2] / direction[..., 2]
        for slab in slabs:
            normal = np.array([0.0, -np.sin(slab.tilt), np.cos(slab.tilt)])
            t = (normal @ (np.array([slab.x, slab.y, slab.top]) - origin)) / (direction @ normal)
            hit = origin + direction * t[..., None]
            inside = (np.abs(hit[..., 0] - slab.x) < slab.length / 2) & (np.abs(hit[..., 1] - slab.y) < slab.width / 2)
            depth = np.where(inside & (t < depth), t, depth)
        point = origin + direction * depth[..., None]
        # as the matcher's gate does: no pixel beside a step counts
        rough = (rect.focal_px * rect.baseline_m / depth).astype(np.float32)
        around = np.ones((5, 5), dtype=np.uint8)
        measured = cv2.dilate(rough, around) - cv2.erode(rough, around) < 2
        for x, y, radius in unseen:
            measured &= np.hypot(point[..., 0] - x, point[..., 1] - y) > radius
        disparity = (rect.focal_px * rect.baseline_m / depth).astype(np.float32)
        disparity += np.random.default_rng(seed).normal(0, noise_px, depth.shape).astype(np.float32)
        disparity[~measured] = np.nan
        blank = np.zeros((view.height, view.width + view.num_disparities), dtype=np.uint8)
        rectified = Rectified(left=blank, right=blank, window=view, margin=view.num_disparities, focal_px=rect.focal_px,
                              baseline_m=rect.baseline_m, cx_px=rect.cx_px, cy_px=rect.cy_px, T_camera_rect=rect.T_camera_rect)
        values = Depth(disparity=disparity, fill=lambda: np.nan_to_num(disparity), measured=measured,
                       confidence=np.full(depth.shape, 255, dtype=np.uint8),
                       sigma_px=np.where(measured, np.float32(max(noise_px, 0.05)), np.float32(np.nan)))
        return Planted(rig, job, values, rectified, T_camera_bin)

    return make


@pytest.fixture
def slab() -> type[Slab]:
    return Slab


@pytest.fixture
def window_type() -> type[Window]:
    return Window


@pytest.fixture(scope="session")
def photograph() -> Callable[..., CycleInput]:
    """photograph(parts, seed): parts (kind, T_bin_part) laid into the exam's small bin, by cameras with 2 for 3 px."""
    rig = staged.small_exam_rig()
    renderer, job = Renderer(rig, "B"), settings.resolve(exam.cell("B"))

    def take(parts: Sequence[tuple[str, Transform]] = (), seed: int = 1) -> CycleInput:
        scene = WorldScene("B", tuple(ScenePart(i, kind, T) for i, (kind, T) in enumerate(parts, start=1)), seed, 1)
        light = job.recipe.lights[0]
        left, right = (
            Frame(image=renderer.expose(scene, index, light, seed), camera=name, sequence=1, frame_id=1, timestamp_ns=0,
                  triggered_ns=0, received_ns=1, exposure_us=light.exposure_us, gain_db=light.gain_db)
            for index, name in enumerate(("left", "right")))
        pair = StereoPair(left, right, "2026-01-01T00:00:00Z", skew_us=0.0, sigma_us=0.0, proof="simulated")
        return CycleInput(1, pair, rig, job, Request.model_validate({"frame": "bin"}), simulated=True)

    return take


@pytest.fixture(scope="session")
def expecting() -> Callable[..., CycleInput]:
    """expecting(inputs, T_expected_bin, size): the same images; the bin is to be located, elsewhere, of another size."""

    def move(inputs: CycleInput, T_expected_bin: Transform, size: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> CycleInput:
        model = inputs.job.bin
        T_camera_expected = model.T_parent_bin @ geometry.inverse(T_expected_bin)
        x, y, z = (side * factor for side, factor in zip(model.inner_size_m, size, strict=True))
        pose = model.pose.model_copy(update={"position_m": tuple(T_camera_expected[:3, 3].tolist()),
                                             "quaternion_xyzw": tuple(geometry.quaternion(T_camera_expected).tolist())})
        bin_ = model.model_copy(update={"pose": pose, "locate": True, "inner_size_m": (x, y, z)})
        return replace(inputs, job=inputs.job.model_copy(update={"bin": bin_}))

    return move
