"""What the cameras see: rays through distorted pixels, shaded once per change of the world; a shot adds exposure and noise."""

import threading
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int

from binpick import geometry
from binpick.data import Image, Light
from binpick.rig import Rig
from binpick.sim import drift, exam
from binpick.sim.drift import Drift
from binpick.sim.marks import Mark, painted
from binpick.sim.mesh import TABLE_ID, Caster, Hits, Rays, part_mesh
from binpick.sim.mirror import Mirrored, mirrored
from binpick.sim.projector import Projector
from binpick.sim.surface import Lit, Shading, ends, materials, radiance, shade
from binpick.sim.world import WorldScene

Radiance = Float32[np.ndarray, "h w"]
Pixels = Int[np.ndarray, "n"]
# pictures kept: two cameras, pattern on and off, this world and the last
KEPT = 8
# worlds under every light kept: of two cameras
LIT_KEPT = 2
# parts that stand out of the bin are drawn up to this height above the rim, metres
ABOVE_RIM_M = 0.02
NOISE_SEED = 90210
# 8 steps: each gains more than a digit; cv2's default of 5 leaves up to 0.05 px in the corners
UNDISTORT_UNTIL = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 8, 1e-6)


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One camera over the empty bin: its whole picture, and the rays and shading of the crop where anything can change.

    Rays are in frame `bin`, directions of length 1, and change from pixel to pixel, right and down, by about `pixel_steps`.
    `empty` holds the whole picture without (None) and with the pattern 0.
    """

    vignette: Radiance
    empty: dict[int | None, Radiance]
    crop: tuple[slice, slice]
    rays: Rays
    pixel_steps: Float32[np.ndarray, "2 3"]
    background: Shading


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """A crop of one world from one camera, for any picture of the projector; None: nothing in it is of metal."""

    lit: Lit
    metal: Mirrored | None


class Renderer:
    """Pictures of frozen scenes of one exam world through a rig. Threads may share it.

    `drifted`: what has moved since the rig was calibrated; `marks`: tags on the table.
    """

    def __init__(self, rig: Rig, world: str, optics: exam.Optics = exam.OPTICS, drifted: Drift = drift.NONE,
                 marks: tuple[Mark, ...] = ()) -> None:
        self._rig, self._world, self._optics, self._marks = rig, world, optics, marks
        self._T_camera_bin = exam.setup(world).T_camera_bin
        if drifted != drift.NONE:
            self._rig, self._T_camera_bin = drifted.rig(rig), geometry.inverse(drifted.T_was_rig) @ self._T_camera_bin
        self._projector = Projector(world, optics)
        self._lock = threading.Lock()
        self._views: dict[int, View] = {}
        self._kept: dict[tuple[str, int, int | None], Radiance] = {}
        self._seen: dict[tuple[str, int], Seen] = {}
        self._surrounds: dict[int, Lit] = {}
        self._caster: tuple[str, Caster] | None = None

    def expose(self, scene: WorldScene, camera_index: int, light: Light, shot: int) -> Image:
        """The 8-bit image of one shot; the same scene, light and shot number give the same image. Raises InputError."""
        o = self._optics
        gain = np.float32(10 ** (light.gain_db / 20))
        pattern = light.pattern if light.projector else None
        steps = self.radiance(scene, camera_index, pattern) * (gain * np.float32(light.exposure_us * o.steps_per_us))
        rng = np.random.Generator(np.random.SFC64((NOISE_SEED, scene.seed, camera_index, shot)))
        noise = rng.standard_normal(steps.shape, dtype=np.float32)
        # the variance of n electrons is n: in steps², steps * gain / electrons_per_step
        read = np.float32((o.read_noise_steps * gain) ** 2)
        noise *= cv2.sqrt(cv2.addWeighted(steps, float(gain / o.electrons_per_step), steps, 0.0, float(read)))
        steps += noise
        # rounds, and saturates above 255; convertScaleAbs would mirror what noise puts below 0
        image: Image = cv2.convertScaleAbs(cv2.max(steps, -o.black_level), beta=o.black_level)
        return image

    def radiance(self, scene: WorldScene, camera_index: int, pattern: int | None) -> Radiance:
        """The picture without exposure and noise, blurred and vignetted; read-only, kept for the next shot.

        `pattern` as `Light.pattern`; None: the projector is off. Raises InputError when the projector has no such pattern.
        """
        if scene.world != self._world:
            raise ValueError(f"this renderer looks into world {self._world}, not {scene.world}")
        key = (scene.digest, camera_index, pattern)
        with self._lock:
            if key not in self._kept:
                while len(self._kept) >= KEPT:
                    del self._kept[next(iter(self._kept))]
                self._kept[key] = self._draw(scene, camera_index, pattern)
            return self._kept[key]

    def _draw(self, scene: WorldScene, index: int, pattern: int | None) -> Radiance:
        if index not in self._views:
            self._views[index] = self._view(index)
        view = self._views[index]
        rows, columns = view.crop
        shape = (rows.stop - rows.start, columns.stop - columns.start)
        seen = self._look(view, scene, index)
        full = view.empty[pattern].copy() if pattern in view.empty else self._surround(index, pattern)
        crop = radiance(seen.lit, shape, self._projector, pattern, self._optics)
        if seen.metal:
            crop.reshape(-1)[seen.metal.pixels] += seen.metal.radiance(self._projector, pattern)
        full[view.crop] = crop
        picture: Radiance = cv2.GaussianBlur(full, (0, 0), self._optics.blur_sigma_px)
        picture *= view.vignette
        picture.setflags(write=False)
        return picture

    def _look(self, view: View, scene: WorldScene, index: int) -> Seen:
        key = (scene.digest, index)
        if key not in self._seen:
            while len(self._seen) >= LIT_KEPT:
                del self._seen[next(iter(self._seen))]
            self._seen[key] = self._with_parts(view, scene, self._cast(scene), self._silhouettes(scene, index, view.crop))
        return self._seen[key]

    def _surround(self, index: int, pattern: int | None) -> Radiance:
        """The whole picture of the empty bin under a pattern that few ask for: its light is worked out when first asked."""
        if index not in self._surrounds:
            nothing = WorldScene(self._world, (), 0, 0)
            rays = self._rays(index).reshape(-1, 6)
            caster = Caster(nothing)
            self._surrounds[index] = self._shaded(rays, caster.cast(rays), nothing).lit(nothing, caster, self._optics)
        width, height = self._rig.image_size_px
        return radiance(self._surrounds[index], (height, width), self._projector, pattern, self._optics)

    def _cast(self, scene: WorldScene) -> Caster:
        if self._caster is None or self._caster[0] != scene.digest:
            self._caster = (scene.digest, Caster(scene))
        return self._caster[1]

    def _with_parts(self, view: View, scene: WorldScene, caster: Caster, maybe: Pixels) -> Seen:
        """The background, shaded anew only where parts are, which is among the pixels `maybe`."""
        hits = caster.cast(view.rays[maybe])
        of_parts = np.flatnonzero(hits.part_id > 0)
        places, hits = maybe[of_parts], hits.take(of_parts)
        rays = view.rays[places]
        lit = view.background.with_points(places, self._shaded(rays, hits, scene)).lit(scene, caster, self._optics)
        if not any(exam.KINDS[part.kind].mirror for part in scene.parts):
            return Seen(lit, None)
        metal = mirrored(scene, caster, rays, hits, view.pixel_steps, self._projector, self._optics)
        return Seen(lit, replace(metal, pixels=places[metal.pixels]))

    def _silhouettes(self, scene: WorldScene, index: int, crop: tuple[slice, slice]) -> Pixels:
        """Pixels of the crop, counted row by row, that can show a part: the hulls of their corners, generously."""
        camera = self._rig.cameras[index]
        T_cam_bin = camera.T_camera_rig @ self._T_camera_bin
        mask = np.zeros((crop[0].stop - crop[0].start, crop[1].stop - crop[1].start), np.uint8)
        for part in scene.parts:
            corners = geometry.transform(T_cam_bin @ part.T_bin_part, part_mesh(part.kind).vertices)
            outline = _projected(corners, camera.K_px, camera.distortion_coefficients) - [crop[1].start, crop[0].start]
            cv2.fillConvexPoly(mask, cv2.convexHull(np.rint(outline).astype(np.int32)), 1)
        # hulls are rounded to whole pixels, and a distorted edge bulges by 0.2 px
        return np.flatnonzero(cv2.dilate(mask, np.ones((7, 7), np.uint8)))

    def _shaded(self, rays: Rays, hits: Hits, scene: WorldScene) -> Shading:
        points, normals = ends(rays, hits)
        table, index = materials(scene, self._optics), hits.part_id - TABLE_ID
        reflectance = table.reflectance[index]
        if self._marks:
            on_table = np.flatnonzero(index == 0)
            pixel_m = self._T_camera_bin[2, 3] / self._rig.cameras[0].K_px[0, 0]
            reflectance[on_table] = painted(self._marks, points[on_table], reflectance[on_table], pixel_m)
        return shade(points, normals, -rays[:, 3:], reflectance, table.gloss[index], self._optics.gloss_power,
                     self._projector, self._optics)

    def _rays(self, index: int) -> Float32[np.ndarray, "h w 6"]:
        camera = self._rig.cameras[index]
        T_cam_bin = camera.T_camera_rig @ self._T_camera_bin
        return _rays(camera.K_px, camera.distortion_coefficients, T_cam_bin, self._rig.image_size_px)

    def _view(self, index: int) -> View:
        setup, camera, size = exam.setup(self._world), self._rig.cameras[index], self._rig.image_size_px
        T_cam_bin = camera.T_camera_rig @ self._T_camera_bin
        rays = self._rays(index)
        nothing = WorldScene(self._world, (), 0, 0)
        caster = self._cast(nothing)
        everywhere = rays.reshape(-1, 6)
        shading = self._shaded(everywhere, caster.cast(everywhere), nothing)
        lit = shading.lit(nothing, caster, self._optics)
        empty = {pattern: radiance(lit, rays.shape[:2], self._projector, pattern, self._optics) for pattern in (None, 0)}
        corners = _outline(setup)
        crop = _crop(geometry.transform(T_cam_bin, corners), camera.K_px, camera.distortion_coefficients, size)
        inside = np.arange(size[0] * size[1]).reshape(size[1], size[0])[crop].ravel()
        steps = (T_cam_bin[:2, :3] / np.diag(camera.K_px)[:2, None]).astype(np.float32)
        return View(_vignette(size, self._optics), empty, crop, everywhere[inside], steps, shading.take(inside))


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
