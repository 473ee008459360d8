"""What bare metal shows beside its own faint colour: its surroundings, pattern and all, and glare, by one bounce of rays."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Int

from binpick.sim import exam
from binpick.sim.mesh import TABLE_ID, Caster, Hits, Rays, rounded
from binpick.sim.projector import Projector
from binpick.sim.surface import OFF_SURFACE_M, Lit, Points, Values, ends, materials, shade
from binpick.sim.world import WorldScene

# every pixel looks through six places of its own (columns and rows, px) ...
PLACES_PX = np.array([[-5, 1], [5, -1], [-3, -5], [3, 5], [-1, 3], [1, -3]], np.float32) / 12
# ... at six facets of the rough surface: their normals lean by these times the roughness (mean 0, spread 1 along every axis)
LEANS = np.sqrt(3, dtype=np.float32) * np.vstack([np.eye(3), -np.eye(3)]).astype(np.float32)
SAMPLES = len(LEANS)
# glare below this radiance is left out: a third of one grey level at the usual exposure
DIM = np.float32(1e-3)


@dataclass(frozen=True, slots=True, eq=False)
class Mirrored:
    """The light that metal pixels send on unchanged: `glare` of lamp and projector, and `share` of each thing reflected.

    `pixels` are places in the rays it was made of; every pixel has SAMPLES of the others, one after the other. Only the
    samples `glaring` have glare.
    """

    pixels: Int[np.ndarray, "n"]
    glaring: Int[np.ndarray, "k"]
    glare: Lit
    reflected: Lit
    share: Float32[np.ndarray, "m"]
    weight: Float32[np.ndarray, "m"]

    def radiance(self, projector: Projector, pattern: int | None) -> Values:
        """What the pixels show under a pattern (None: the projector is off). Raises InputError."""
        light = self.share * self.reflected.direct(projector, pattern)
        light[self.glaring] += self.glare.direct(projector, pattern)
        total: Values = (self.weight * light).reshape(-1, SAMPLES).sum(axis=1)
        return total


def mirrored(scene: WorldScene, caster: Caster, rays: Rays, hits: Hits, pixel_steps: Float32[np.ndarray, "2 3"],
             projector: Projector, optics: exam.Optics) -> Mirrored:
    """What the metal among `hits` mirrors; `pixel_steps` is how a ray's direction changes from pixel to pixel, right and down.

    Samples that miss their pixel's part have no weight.
    """
    mirror = materials(scene, optics).mirror
    pixels = np.flatnonzero(mirror[hits.part_id - TABLE_ID] > 0)
    looking = np.repeat(rays[pixels], SAMPLES, axis=0)
    looking[:, 3:] += np.tile(PLACES_PX @ pixel_steps, (len(pixels), 1))
    looking[:, 3:] /= np.linalg.norm(looking[:, 3:], axis=1, keepdims=True)
    seen = caster.cast(looking)
    part_id = np.repeat(hits.part_id[pixels], SAMPLES)
    same = seen.part_id == part_id
    points, normals = ends(looking, seen)
    normals = rounded(scene, points, replace(seen, normal=normals))
    nothing = np.zeros(len(points), np.float32)
    glare = shade(points, normals, -looking[:, 3:], nothing, nothing + np.float32(optics.metal_gloss),
                  optics.metal_gloss_power, projector, optics)
    glaring = np.flatnonzero((glare.glow > DIM) | (glare.ambient > DIM))
    leaning = normals + np.float32(optics.metal_roughness_rad) * np.tile(LEANS, (len(pixels), 1))
    bounced, cosine = _bounced(points, normals, leaning, looking[:, 3:])
    squarely = mirror[part_id - TABLE_ID]
    # Schlick 1994: every surface mirrors fully at grazing incidence
    share = squarely + (1 - squarely) * (1 - cosine) ** 5
    return Mirrored(pixels, glaring, glare.take(glaring).lit(scene, caster, optics),
                    _surroundings(scene, caster, bounced, projector, optics), share, _weights(same))


def _bounced(points: Points, normals: Points, leaning: Points, looking: Points) -> tuple[Rays, Values]:
    """The rays that mirror facets send on, never into the surface, and the cosine of the angle they were met at."""
    leaning = leaning / np.linalg.norm(leaning, axis=1, keepdims=True)
    against = np.einsum("ij,ij->i", leaning, looking)
    onward = looking - 2 * against[:, None] * leaning
    into = np.minimum(np.einsum("ij,ij->i", onward, normals), 0)
    onward -= 2 * into[:, None] * normals
    rays = np.hstack([points + normals * np.float32(OFF_SURFACE_M), onward / np.linalg.norm(onward, axis=1, keepdims=True)])
    return rays, np.clip(-against, 0, 1)


def _surroundings(scene: WorldScene, caster: Caster, rays: Rays, projector: Projector, optics: exam.Optics) -> Lit:
    """What mirrored rays see: things in their light; past them, or mirrored once more, the room's even brightness."""
    table, hits = materials(scene, optics), caster.cast(rays)
    index = hits.part_id - TABLE_ID
    points, normals = ends(rays, hits)
    shading = shade(points, normals, -rays[:, 3:], table.reflectance[index], table.gloss[index], optics.gloss_power, projector,
                    optics)
    lit = shading.lit(scene, caster, optics)
    room = np.float32(optics.surround)
    away = ~np.isfinite(hits.distance)
    ambient = np.where(away, room, lit.ambient + table.mirror[index] * room)
    return Lit(lit.albedo, ambient, np.where(away, np.float32(0), lit.glow), lit.falloff, lit.column, lit.row, lit.dots)


def _weights(same: Bool[np.ndarray, "n"]) -> Values:
    """Equal shares of 1 for the samples of a pixel that count."""
    count = np.maximum(same.reshape(-1, SAMPLES).sum(axis=1), 1)
    weights: Values = (same / np.repeat(count, SAMPLES)).astype(np.float32)
    return weights
