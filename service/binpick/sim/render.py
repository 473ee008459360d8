"""What the cameras see: rays through distorted pixels, shaded once per change of the world; a shot adds exposure and noise."""

import threading
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int

from binpick import geometry
from binpick.data import Image, Light
from binpick.rig import Rig
from binpick.sim import exam
from binpick.sim.mesh import TABLE_ID, Caster, Hits, Rays, part_mesh
from binpick.sim.projector import Projector
from binpick.sim.surface import Shading, materials, radiance, shade
from binpick.sim.world import WorldScene

Radiance = Float32[np.ndarray, "h w"]
Pixels = Int[np.ndarray, "n"]
# pictures kept: two cameras, pattern on and off, this world and the last
KEPT = 8
# parts that stand out of the bin are drawn up to this height above the rim, metres
ABOVE_RIM_M = 0.02
NOISE_SEED = 90210
# 8 steps: each gains more than a digit; cv2's default of 5 leaves up to 0.05 px in the corners
UNDISTORT_UNTIL = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 8, 1e-6)


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One camera over the empty bin: its whole picture, and the rays and shading of the crop where anything can change.

    Rays are in frame `bin`, directions of length 1. `empty` holds the whole picture without and with the pattern.
    """

    vignette: Radiance
    empty: tuple[Radiance, Radiance]
    crop: tuple[slice, slice]
    rays: Rays
    background: Shading


class Renderer:
    """Pictures of frozen scenes of one exam world through a rig. Threads may share it."""

    def __init__(self, rig: Rig, world: str, optics: exam.Optics = exam.OPTICS) -> None:
        self._rig, self._world, self._optics = rig, world, optics
        self._projector = Projector(world, optics)
        self._lock = threading.Lock()
        self._views: dict[int, View] = {}
        self._kept: dict[tuple[str, int, bool], Radiance] = {}
        self._caster: tuple[str, Caster] | None = None

    def expose(self, scene: WorldScene, camera_index: int, light: Light, shot: int) -> Image:
        """The 8-bit image of one shot; the same scene, light and shot number give the same image."""
        o = self._optics
        gain = np.float32(10 ** (light.gain_db / 20))
        steps = self.radiance(scene, camera_index, light.projector) * (gain * np.float32(light.exposure_us * o.steps_per_us))
        rng = np.random.Generator(np.random.SFC64((NOISE_SEED, scene.seed, camera_index, shot)))
        noise = rng.standard_normal(steps.shape, dtype=np.float32)
        # the variance of n electrons is n: in steps², steps * gain / electrons_per_step
        read = np.float32((o.read_noise_steps * gain) ** 2)
        noise *= cv2.sqrt(cv2.addWeighted(steps, float(gain / o.electrons_per_step), steps, 0.0, float(read)))
        steps += noise
        # rounds, and saturates above 255; convertScaleAbs would mirror what noise puts below 0
        image: Image = cv2.convertScaleAbs(cv2.max(steps, -o.black_level), beta=o.black_level)
        return image

    def radiance(self, scene: WorldScene, camera_index: int, pattern: bool) -> Radiance:
        """The picture without exposure and noise, blurred and vignetted; read-only, kept for the next shot."""
        if scene.world != self._world:
            raise ValueError(f"this renderer looks into world {self._world}, not {scene.world}")
        key = (scene.digest, camera_index, pattern)
        with self._lock:
            if key not in self._kept:
                while len(self._kept) >= KEPT:
                    del self._kept[next(iter(self._kept))]
                self._kept[key] = self._draw(scene, camera_index, pattern)
            return self._kept[key]

    def _draw(self, scene: WorldScene, index: int, pattern: bool) -> Radiance:
        if index not in self._views:
            self._views[index] = self._view(index)
        view, caster = self._views[index], self._cast(scene)
        rows, columns = view.crop
        shape = (rows.stop - rows.start, columns.stop - columns.start)
        shading = self._with_parts(view, scene, caster, self._silhouettes(scene, index, view.crop))
        full = view.empty[pattern].copy()
        full[view.crop] = radiance(shading, shape, scene, caster, pattern, self._optics)
        picture: Radiance = cv2.GaussianBlur(full, (0, 0), self._optics.blur_sigma_px)
        picture *= view.vignette
        picture.setflags(write=False)
        return picture

    def _cast(self, scene: WorldScene) -> Caster:
        if self._caster is None or self._caster[0] != scene.digest:
            self._caster = (scene.digest, Caster(scene))
        return self._caster[1]

    def _with_parts(self, view: View, scene: WorldScene, caster: Caster, maybe: Pixels) -> Shading:
        """The background's shading, shaded anew only where parts are, which is among the pixels `maybe`."""
        hits = caster.cast(view.rays[maybe])
        of_parts = np.flatnonzero(hits.part_id > 0)
        seen = maybe[of_parts]
        parts = self._shaded(view.rays[seen], hits.take(of_parts), scene)
        b = view.background
        shading = Shading(b.albedo.copy(), b.ambient.copy(), b.projected.copy(), b.to_light.copy())
        shading.albedo[seen], shading.ambient[seen] = parts.albedo, parts.ambient
        shading.projected[seen], shading.to_light[seen] = parts.projected, parts.to_light
        return shading

    def _silhouettes(self, scene: WorldScene, index: int, crop: tuple[slice, slice]) -> Pixels:
        """Pixels of the crop, counted row by row, that can show a part: the hulls of their corners, generously."""
        camera = self._rig.cameras[index]
        T_cam_bin = camera.T_camera_rig @ exam.setup(self._world).T_camera_bin
        mask = np.zeros((crop[0].stop - crop[0].start, crop[1].stop - crop[1].start), np.uint8)
        for part in scene.parts:
            corners = geometry.transform(T_cam_bin @ part.T_bin_part, part_mesh(part.kind).vertices)
            outline = _projected(corners, camera.K_px, camera.distortion_coefficients) - [crop[1].start, crop[0].start]
            cv2.fillConvexPoly(mask, cv2.convexHull(np.rint(outline).astype(np.int32)), 1)
        # hulls are rounded to whole pixels, and a distorted edge bulges by 0.2 px
        return np.flatnonzero(cv2.dilate(mask, np.ones((7, 7), np.uint8)))

    def _shaded(self, rays: Rays, hits: Hits, scene: WorldScene) -> Shading:
        # what misses even the table is drawn as far table
        points = rays[:, :3] + rays[:, 3:] * np.minimum(hits.distance, 10.0)[:, None]
        away = np.einsum("ij,ij->i", hits.normal, rays[:, 3:]) > 0
        normals = np.where(away[:, None], -hits.normal, hits.normal)
        reflectance, gloss = (table[hits.part_id - TABLE_ID] for table in materials(scene, self._optics))
        return shade(points, normals, -rays[:, 3:], reflectance, gloss, self._projector, self._optics)

    def _view(self, index: int) -> View:
        setup, camera, size = exam.setup(self._world), self._rig.cameras[index], self._rig.image_size_px
        T_cam_bin = camera.T_camera_rig @ setup.T_camera_bin
        rays = _rays(camera.K_px, camera.distortion_coefficients, T_cam_bin, size)
        nothing = WorldScene(self._world, (), 0, 0)
        caster = self._cast(nothing)
        everywhere = rays.reshape(-1, 6)
        shading = self._shaded(everywhere, caster.cast(everywhere), nothing)
        dark, lit = (radiance(shading, rays.shape[:2], nothing, caster, pattern, self._optics) for pattern in (False, True))
        corners = _outline(setup)
        crop = _crop(geometry.transform(T_cam_bin, corners), camera.K_px, camera.distortion_coefficients, size)
        inside = np.arange(size[0] * size[1]).reshape(size[1], size[0])[crop].ravel()
        background = Shading(shading.albedo[inside], shading.ambient[inside], shading.projected[inside],
                             shading.to_light[inside])
        return View(_vignette(size, self._optics), (dark, lit), crop, everywhere[inside], background)


def _rays(K: Float[np.ndarray, "3 3"], distortion: Float[np.ndarray, "n"], T_cam_bin: geometry.Transform,
          size: tuple[int, int]) -> Float32[np.ndarray, "h w 6"]:
    """The ray of each pixel's centre in frame `bin`."""
    u, v = np.meshgrid(np.arange(size[0], dtype=np.float64), np.arange(size[1], dtype=np.float64))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    plane = cv2.undistortPointsIter(pixels, K, distortion, None, None, UNDISTORT_UNTIL).reshape(-1, 2)
    directions = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    T_bin_cam = geometry.inverse(T_cam_bin)
    rays = np.empty((size[1], size[0], 6), np.float32)
    rays[..., :3], rays[..., 3:] = T_bin_cam[:3, 3], geometry.rotate(T_bin_cam, directions).reshape(size[1], size[0], 3)
    return rays


def _vignette(size: tuple[int, int], optics: exam.Optics) -> Radiance:
    """1 in the middle, falling with the square of the distance to 1 − vignetting in the corners."""
    x, y = (np.linspace(-1, 1, n, dtype=np.float32) for n in size)
    return 1 - np.float32(optics.vignetting / 2) * (x[None, :] ** 2 + y[:, None] ** 2)


def _outline(setup: exam.Setup) -> Float[np.ndarray, "8 3"]:
    """The box in which anything can change."""
    (length, width, height), wall = setup.bin_size_m, setup.bin_wall_m
    x, y = length / 2 + wall, width / 2 + wall
    return geometry.box_corners(np.array([-x, -y, 0.0]), np.array([x, y, height + ABOVE_RIM_M]))


def _projected(points_cam: Float[np.ndarray, "n 3"], K: Float[np.ndarray, "3 3"], distortion: Float[np.ndarray, "k"],
               ) -> Float[np.ndarray, "n 2"]:
    """Where a camera sees points, px (x, y)."""
    pixels: Float[np.ndarray, "n 2"] = cv2.projectPoints(points_cam, np.zeros(3), np.zeros(3), K, distortion)[0].reshape(-1, 2)
    return pixels


def _crop(points_cam: Float[np.ndarray, "n 3"], K: Float[np.ndarray, "3 3"], distortion: Float[np.ndarray, "k"],
          size: tuple[int, int]) -> tuple[slice, slice]:
    """Rows and columns around the picture of some points."""
    seen = _projected(points_cam, K, distortion)
    low = np.maximum(np.floor(seen.min(axis=0)).astype(int) - 2, 0)
    high = np.minimum(np.ceil(seen.max(axis=0)).astype(int) + 3, size)
    return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))
