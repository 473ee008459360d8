"""How bright a point of the world looks: pattern, ambient light and lamp on diffuse and glossy surfaces."""

import functools
from dataclasses import dataclass, fields

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int

from binpick.sim import exam
from binpick.sim.mesh import BIN_ID, TABLE_ID, Caster, Hits, Rays
from binpick.sim.projector import Projector, sample
from binpick.sim.world import WorldScene

Grid = Float32[np.ndarray, "h w"]
Values = Float32[np.ndarray, "n"]
Points = Float32[np.ndarray, "n 3"]
# rays towards the light start this far off the surface: float32 hits are good to some µm at 1 m
OFF_SURFACE_M = 2e-4
HEIGHT_CELL_M, HEIGHT_MARGIN_M, HEIGHT_SIGMA_M = 0.005, 0.1, 0.018
# one bounce of light is gathered from about this many px around, on an image 8 times smaller
BOUNCE_PX, BOUNCE_SHRINK = 28.0, 8
# what misses even the table is drawn as table this far away, metres
FAR_M = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Materials:
    """Of each id, counted from TABLE_ID: diffuse reflectance, strength of the gloss, reflectance as a mirror."""

    reflectance: Values
    gloss: Values
    mirror: Values


@dataclass(frozen=True, slots=True, eq=False)
class Lit:
    """Radiance of points towards the eye: from all around, and per brightness of the projector's picture.

    The latter is `glow` times `falloff` (by distance) times the picture's cell at `column`, `row`; `dots` are these cells of
    pattern 0, which is asked for most.
    """

    albedo: Values
    ambient: Values
    glow: Values
    falloff: Values
    column: Values
    row: Values
    dots: Values

    def direct(self, projector: Projector, pattern: int | None) -> Values:
        """Radiance by direct light alone under a pattern (None: the projector is off). Raises InputError."""
        if pattern is None:
            return self.ambient
        cells = self.dots if pattern == 0 else sample(projector.picture(pattern), self.column, self.row, cv2.BORDER_CONSTANT)
        direct: Values = self.ambient + self.glow * (cells * self.falloff)
        return direct


@dataclass(frozen=True, slots=True, eq=False)
class Shading(Lit):
    """The same before anything stands in the light.

    `to_light` are the rays (from just off the surface, ending after one ray length at the projector) that shadow it.
    """

    to_light: Rays

    def take(self, index: Int[np.ndarray, "m"]) -> "Shading":
        """Some of the points."""
        return Shading(**{field.name: getattr(self, field.name)[index] for field in fields(self)})

    def with_points(self, places: Int[np.ndarray, "m"], points: "Shading") -> "Shading":
        """A copy with other points at some places."""
        copies = {field.name: getattr(self, field.name).copy() for field in fields(self)}
        for name, values in copies.items():
            values[places] = getattr(points, name)
        return Shading(**copies)

    def lit(self, scene: WorldScene, caster: Caster, optics: exam.Optics) -> Lit:
        """The points in what light the scene leaves them."""
        return Lit(self.albedo, self.ambient * _openness(self.to_light, scene, caster, optics),
                   self.glow * ~caster.blocked(self.to_light, 0.0, 1.0), self.falloff, self.column, self.row,
                   self.dots)


def ends(rays: Rays, hits: Hits) -> tuple[Points, Points]:
    """Where rays of length 1 end, and the surface's normals on the side they come from."""
    points = rays[:, :3] + rays[:, 3:] * np.minimum(hits.distance, FAR_M)[:, None]
    away = np.einsum("ij,ij->i", hits.normal, rays[:, 3:]) > 0
    return points, np.where(away[:, None], -hits.normal, hits.normal)


def shade(points: Points, normals: Points, to_eye: Points, reflectance: Values, gloss: Values, gloss_power: int,
          projector: Projector, optics: exam.Optics) -> Shading:
    """Shades points of frame `bin`; normals look to the eye's side, `to_eye` has length 1."""
    albedo = reflectance * _texture(points, optics)
    lamp = np.array(optics.lamp_direction, np.float32) / np.float32(np.linalg.norm(optics.lamp_direction))
    around = np.float32(optics.ambient) * (np.float32(0.65) + np.float32(0.35) * normals[:, 2])
    ambient = albedo * (around + np.float32(optics.lamp) * np.maximum(normals @ lamp, 0))
    ambient += gloss * np.float32(optics.lamp) * _highlight(normals, to_eye + lamp, gloss_power)
    to_light = np.empty((len(points), 6), np.float32)
    to_light[:, :3] = points + normals * np.float32(OFF_SURFACE_M)
    to_light[:, 3:] = projector.position_m.astype(np.float32) - points
    square = _dot(to_light[:, 3:], to_light[:, 3:])
    direction = to_light[:, 3:] / np.sqrt(square)[:, None]
    facing = _dot(normals, direction)
    glow = albedo * facing + gloss * _highlight(normals, to_eye + direction, gloss_power)
    column, row = projector.place(points)
    dots = sample(projector.picture(0), column, row, cv2.BORDER_CONSTANT)
    return Shading(albedo, ambient, np.where(facing > 0, glow, np.float32(0)), np.float32(optics.projector) / square,
                   column, row, dots, to_light)


def radiance(lit: Lit, shape: tuple[int, int], projector: Projector, pattern: int | None, optics: exam.Optics) -> Grid:
    """What the points of a grid (not yet blurred) show under a pattern, with the light they hand on. Raises InputError."""
    direct: Grid = lit.direct(projector, pattern).reshape(shape)
    return direct + lit.albedo.reshape(shape) * (np.float32(optics.interreflection) * _bounced(direct))


def materials(scene: WorldScene, optics: exam.Optics) -> Materials:
    """No two parts of a kind are quite alike."""
    count = max([BIN_ID, *(p.part_id for p in scene.parts)]) - TABLE_ID + 1
    reflectance, gloss, mirror = np.full(count, optics.table_reflectance), np.zeros(count), np.zeros(count)
    reflectance[BIN_ID - TABLE_ID], gloss[BIN_ID - TABLE_ID] = optics.bin_reflectance, optics.bin_gloss
    for part in scene.parts:
        kind = exam.KINDS[part.kind]
        spread = np.random.default_rng((scene.seed, part.part_id)).uniform(-1, 1) * optics.reflectance_spread
        reflectance[part.part_id - TABLE_ID] = kind.reflectance * (1 + spread)
        gloss[part.part_id - TABLE_ID], mirror[part.part_id - TABLE_ID] = kind.gloss, kind.mirror
    return Materials(*(values.astype(np.float32) for values in (reflectance, gloss, mirror)))


def _openness(to_light: Rays, scene: WorldScene, caster: Caster, optics: exam.Optics) -> Values:
    """How much of the sky each point sees, 0 to 1: less, the further it lies below its surroundings."""
    height, origin = _height_map(scene, caster)
    u, v = ((to_light[:, i] - origin[i]) / np.float32(HEIGHT_CELL_M) for i in (0, 1))
    depth = np.maximum(sample(height, u, v, cv2.BORDER_REPLICATE) - to_light[:, 2], 0)
    openness: Values = cv2.exp(depth * np.float32(-1 / optics.occlusion_height_m)).ravel()
    return openness


def _height_map(scene: WorldScene, caster: Caster) -> tuple[Grid, Float32[np.ndarray, "2"]]:
    """The mean height around each place over the bin, metres, and the place of cell (0, 0)."""
    length, width, height = exam.setup(scene.world).bin_size_m
    origin = -np.array([length / 2 + HEIGHT_MARGIN_M, width / 2 + HEIGHT_MARGIN_M], np.float32)
    x, y = np.meshgrid(np.arange(origin[0], -origin[0], HEIGHT_CELL_M), np.arange(origin[1], -origin[1], HEIGHT_CELL_M))
    top = height + 0.5
    rays = np.zeros((x.size, 6), np.float32)
    rays[:, 0], rays[:, 1], rays[:, 2], rays[:, 5] = x.ravel(), y.ravel(), top, -1
    heights = (top - caster.cast(rays).distance).reshape(x.shape).astype(np.float32)
    return cv2.GaussianBlur(heights, (0, 0), HEIGHT_SIGMA_M / HEIGHT_CELL_M), origin


def _texture(points: Points, optics: exam.Optics) -> Values:
    """Faint unevenness around 1, fixed in space, alike for every camera."""
    pitch = np.float32(1 / optics.texture_pitch_m)
    # slanted, so that upright faces are not striped
    u = (points[:, 0] + np.float32(0.61) * points[:, 2]) * pitch
    v = (points[:, 1] + np.float32(0.73) * points[:, 2]) * pitch
    texture: Values = 1 + np.float32(optics.texture_contrast) * sample(_tile(), u, v, cv2.BORDER_WRAP)
    return texture


@functools.cache
def _tile() -> Grid:
    """A fine and a coarse random pattern that fits its own other side, standard deviation about 1."""
    rng, edge = np.random.default_rng(7), 32
    grains = []
    for sigma in (0.8, 6.0):
        wrapped = np.pad(rng.standard_normal((512, 512)).astype(np.float32), edge, mode="wrap")
        smooth = cv2.GaussianBlur(wrapped, (0, 0), sigma)[edge:-edge, edge:-edge]
        grains.append(smooth / smooth.std())
    tile: Grid = (grains[0] + grains[1]) / np.float32(np.sqrt(2))
    return tile


def _bounced(direct: Grid) -> Grid:
    """Light that surfaces nearby hand on: the blurred picture itself stands for what they send."""
    h, w = direct.shape
    small = cv2.resize(direct, (max(1, w // BOUNCE_SHRINK), max(1, h // BOUNCE_SHRINK)), interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(small, (0, 0), BOUNCE_PX / BOUNCE_SHRINK)
    bounced: Grid = cv2.resize(blurred, (w, h), interpolation=cv2.INTER_LINEAR)
    return bounced


def _highlight(normals: Points, halfway: Points, power: int) -> Values:
    """Blinn-Phong gloss of a halfway vector of any length; `power` is a power of two."""
    cosine = np.maximum(_dot(normals, halfway), 0) / np.sqrt(_dot(halfway, halfway))
    for _ in range(power.bit_length() - 1):
        cosine *= cosine
    highlight: Values = cosine
    return highlight


def _dot(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    product: Float[np.ndarray, "n"] = np.einsum("ij,ij->i", a, b)
    return product
