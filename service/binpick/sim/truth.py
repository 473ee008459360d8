"""What a perfect stereo pair would measure: rays through rectified pixels."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int32

from binpick import geometry
from binpick.data import Window
from binpick.geometry import Transform
from binpick.sim import exam
from binpick.sim.mesh import BIN_ID, Caster
from binpick.sim.world import WorldScene

# a surface shadows itself below this distance: float32 hits are good to some µm at 1 m
OFF_SURFACE_M = 2e-4


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The window's true disparity in px (NaN: nothing there), whose surface it is (0: bin or table), and what both see.

    `visible_both` asks whether anything stands between the point and the right camera, not whether its image ends before.
    """

    disparity: Float32[np.ndarray, "h w"]
    part_id: Int32[np.ndarray, "h w"]
    visible_both: Bool[np.ndarray, "h w"]


def truth(scene: WorldScene, T_camera_rect: Transform, focal_px: float, cx_px: float, cy_px: float, baseline_m: float,
          window: Window) -> Truth:
    """The truth for a rectified left view (its pixel (0, 0) the whole view's) with the right camera at x = baseline."""
    T_bin_rect = geometry.inverse(exam.setup(scene.world).T_camera_bin) @ T_camera_rect
    u, v = np.meshgrid(window.x + np.arange(window.width), window.y + np.arange(window.height))
    # z = 1: a ray's length is then depth along the optical axis
    rays_rect = np.stack([(u - cx_px) / focal_px, (v - cy_px) / focal_px, np.ones(u.shape)], axis=-1).reshape(-1, 3)
    rays = np.empty((len(rays_rect), 6), np.float32)
    rays[:, :3], rays[:, 3:] = T_bin_rect[:3, 3], geometry.rotate(T_bin_rect, rays_rect)
    caster = Caster(scene)
    hits = caster.cast(rays)
    found = np.isfinite(hits.distance)
    points = rays[:, :3] + rays[:, 3:] * np.where(found, hits.distance, 0)[:, None]
    to_right = geometry.transform(T_bin_rect, np.array([baseline_m, 0.0, 0.0])).astype(np.float32) - points
    start = OFF_SURFACE_M / np.linalg.norm(to_right, axis=1, keepdims=True)
    clear = ~caster.blocked(np.hstack([points + to_right * start, to_right]).astype(np.float32), 0.0, 1.0)
    disparity = np.where(found, focal_px * baseline_m / hits.distance, np.nan).astype(np.float32)
    part_id = np.maximum(hits.part_id, BIN_ID).astype(np.int32)
    return Truth(disparity.reshape(u.shape), part_id.reshape(u.shape), (found & clear).reshape(u.shape))
