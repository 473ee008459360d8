"""Drift against the truth: simulated rigs that are off by known turns and shifts, found in how many cycles, and how well."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rich.table import Table

from binpick import settings
from binpick.data import Image, Light, Rectified
from binpick.lab.regions import regions
from binpick.rig import Rig
from binpick.rigcheck import correction, drift, marks, rows
from binpick.rigcheck.drift import Level, Watch
from binpick.rigcheck.marks import Reference, Sighting
from binpick.scene import bin as load_carrier
from binpick.sim import exam
from binpick.sim import marks as tags
from binpick.sim.drift import NONE, Drift
from binpick.sim.render import Renderer
from binpick.sim.truth import truth
from binpick.sim.world import World, WorldScene
from binpick.stereo import depth, rectify

PITCH_PX = (0.15, 0.25, 0.4, 0.9, 1.1, 3.0, 6.0)
ROLL_PX = (1.5,)
"""At the image's sides."""
YAW_DEG = (0.01, 0.02, 0.05)
SHIFT_MM = {1: (0.86, 0.26, -0.43), 2: (-0.65, 1.63, 0.97), 5: (1.97, -2.37, 3.94)}
"""Of the mount: 1, 2 and 5 mm, each along another line."""
CALM = 12
"""Cycles after which a verdict has settled: a trial ends."""
STORED = 5
"""Cycles that the marks' reference is of."""
PARTS = 25


Errors = dict[str, float | None]


@dataclass(frozen=True, slots=True)
class Trial:
    """One rig that is off; `by_marks`: marks are watched beside the rows."""

    name: str
    drifted: Drift
    by_marks: bool = False
    corrected: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Cell:
    """One simulated cell: its rig file, what lies in its bin, the cameras as they truly are, and what light."""

    rig: Rig
    scene: WorldScene
    renderer: Renderer
    light: Light

    def expose(self, shot: int) -> tuple[Image, Image]:
        """Both images of one cycle; another shot has other noise."""
        left, right = (self.renderer.expose(self.scene, index, self.light, shot) for index in (0, 1))
        return left, right


def trials(world: str) -> tuple[Trial, ...]:
    """What the bench asks of a world: turns of the second camera in px of its image or degrees, shifts of the mount in mm."""
    focal_px = exam.setup(world).right.focal_px[1]
    pitched = (Trial(f"pitch {px:g} px", Drift(pitch_rad=px / focal_px), corrected=px in (0.4, 1.1, 3.0)) for px in PITCH_PX)
    rolled = (Trial(f"roll {px:g} px", Drift(roll_rad=px / (exam.IMAGE_SIZE_PX[0] / 2)), corrected=True) for px in ROLL_PX)
    yawed = (Trial(f"yaw {deg:g} deg", Drift(yaw_rad=float(np.radians(deg))), by_marks=True, corrected=True) for deg in YAW_DEG)
    shifted = (Trial(f"mount {mm} mm", Drift(shift_m=(x / 1000, y / 1000, z / 1000)), by_marks=True)
               for mm, (x, y, z) in SHIFT_MM.items())
    return (*pitched, *rolled, *yawed, *shifted)


def sit(world: str, seed: int, light: Light, chosen: Sequence[Trial],
        tick: Callable[[], None] = lambda: None) -> Iterator[dict[str, Any]]:
    """Each trial on one bin. Raises InputError for an unknown world."""
    scene = World(world, "mixed", PARTS, seed).scene()
    calm = cell(world, scene, light, NONE)
    reference = stored(calm)
    undrifted = depth_error(calm.rig, calm, shot=90)
    for trial in chosen:
        yield run(trial, cell(world, scene, light, trial.drifted), reference, undrifted, tick)


def cell(world: str, scene: WorldScene, light: Light, drifted: Drift) -> Cell:
    """A cell with tags around its bin."""
    rig = exam.rig(world)
    return Cell(rig, scene, Renderer(rig, world, drifted=drifted, marks=tags.layout(world)), light)


def stored(calm: Cell) -> Reference:
    """The marks at commissioning."""
    return marks.store([sighting(calm.expose(shot)) for shot in range(STORED)], calm.rig, tags.FAMILY)


def sighting(images: tuple[Image, Image]) -> Sighting:
    """The tags in both images."""
    return marks.detect(images[0], tags.FAMILY), marks.detect(images[1], tags.FAMILY)


def rectified(rig: Rig, world: str, images: tuple[Image, Image]) -> Rectified:
    """The bin's window as the pipeline cuts it, where the rig file has it."""
    job = settings.resolve(exam.cell(world))
    rect = rectify.rectification(rig)
    box = load_carrier.search_box(job.bin, job.recipe.limits.above_rim_m)
    view = rectify.visible(rect, rig, rectify.window(rect, job.bin.T_parent_bin, *box))
    return rectify.rectify(*images, rig, view)


def looked(watch: Watch, at: Cell, shot: int, reference: Reference | None) -> Watch:
    """The watch after one more cycle."""
    images = at.expose(shot)
    seen = rows.check(rectified(at.rig, at.scene.world, images))
    return drift.step(watch, seen, marks.compare(reference, [sighting(images)], at.rig) if reference is not None else None)


def run(trial: Trial, at: Cell, reference: Reference, undrifted: Errors,
        tick: Callable[[], None] = lambda: None) -> dict[str, Any]:
    """One trial's row: when it was found, what was told, and the truth beside it."""
    watch, found = Watch(), {Level.WARN: 0, Level.FAULT: 0}
    for cycle in range(1, CALM + 1):
        watch = looked(watch, at, 100 + cycle, reference if trial.by_marks else None)
        for level in (Level.WARN, Level.FAULT):
            if not found[level] and watch.level in (level, Level.FAULT):
                found[level] = cycle
        tick()
    focal_px = exam.setup(at.scene.world).right.focal_px[1]
    row: dict[str, Any] = {
        "trial": trial.name, "world": at.scene.world, "seed": at.scene.seed, "pattern": at.light.projector,
        "level": watch.level.value, "warned_after": found[Level.WARN] or None, "fault_after": found[Level.FAULT] or None,
        "row_px": _px(watch.row_px), "off_px": _px(watch.off_px),
        "pitch_px": _px(watch.rotation_rad[0] * focal_px), "true_pitch_px": _px(trial.drifted.pitch_rad * focal_px)}
    if trial.by_marks:
        row |= {"shift_mm": _mm(watch.shift_m), "shift_off_mm": _mm(shift_error(watch, trial.drifted)),
                "depth_mm": _mm(watch.depth_m), "true_depth_mm": _mm(true_depth_error(at.rig, trial.drifted, reference))}
    if trial.corrected:
        row |= {"undrifted": undrifted, "uncorrected": depth_error(at.rig, at, shot=90)}
        if not trial.by_marks:
            row["by_rows"] = depth_error(correction.applied(at.rig, watch.rotation_rad)[0], at, shot=90)
        row["by_marks"] = depth_error(correction.applied(at.rig, turn_by_marks(at, reference))[0], at, shot=90)
    return row


def turn_by_marks(at: Cell, reference: Reference) -> tuple[float, float, float]:
    """The second camera's turn as some cycles of marks tell it."""
    told = [marks.compare(reference, [sighting(at.expose(70 + shot))], at.rig).rotation_rad for shot in range(drift.FEWEST)]
    pitch, yaw, roll = np.median(told, axis=0).tolist()
    return pitch, yaw, roll


def shift_error(watch: Watch, drifted: Drift) -> float:
    """How far the mount's shift is off, as a vector: the median of what the last cycles' marks told."""
    told = np.median([check.shift_m for _, check in watch.marks[-drift.RECENT:]], axis=0)
    return float(np.linalg.norm(told - np.array(drifted.shift_m)))


def true_depth_error(rig: Rig, drifted: Drift, reference: Reference) -> float:
    """What depths in the marks' middle err by when the rig file is believed: seen by the true cameras, placed by the file's."""
    middle = np.mean([np.mean(corners, axis=0) for corners in reference.marks.values()], axis=0)
    T_now, T_then = (each.cameras[1].T_camera_rig for each in (drifted.rig(rig), rig))
    ray = T_now[:3, :3] @ middle + T_now[:3, 3]
    # the point at depth z on the left camera's ray that the file's right camera has on the ray truly seen
    R, t, n = T_then[:3, :3] @ middle / middle[2], T_then[:3, 3], ray / ray[2]
    return float((n[0] * t[2] - t[0]) / (R[0] - n[0] * R[2]) - middle[2])


def depth_error(rig: Rig, at: Cell, shot: int) -> Errors:
    """Of depth on parts, the median error, and the share of their pixels measured, when the cameras are believed to be `rig`.

    The left camera must stand where it stood: the truth is cast from it.
    """
    pair = rectified(rig, at.scene.world, at.expose(shot))
    job = settings.resolve(exam.cell(at.scene.world))
    _, measured = depth.of_shots((pair,), (at.light,), job.recipe.stereo)
    true = truth(at.scene, pair.T_camera_rect, pair.focal_px, pair.cx_px, pair.cy_px, pair.baseline_m, pair.window)
    asked = regions(true, {part.part_id: part.kind for part in at.scene.parts}).parts & true.visible_both
    z, true_z = (pair.focal_px * pair.baseline_m / disparity[asked] for disparity in (measured.disparity, true.disparity))
    off = np.abs(z - true_z)[np.isfinite(z)]
    median_m = float(np.median(off)) if off.size else float("nan")
    return {"depth_error_mm": _mm(median_m), "measured": round(off.size / int(asked.sum()), 3)}


def calm(world: str, seeds: Sequence[int], light: Light, cycles: int,
         tick: Callable[[], None] = lambda: None) -> dict[str, Any]:
    """So many cycles of a rig that has not drifted, over bins of these seeds one after the other, with marks and rows."""
    watch, reference, levels, offs = Watch(), None, [], []
    for number, seed in enumerate(seeds):
        at = cell(world, World(world, "mixed", PARTS, seed).scene(), light, NONE)
        reference = reference or stored(at)
        share = range(number * cycles // len(seeds), (number + 1) * cycles // len(seeds))
        for cycle in share:
            watch = looked(watch, at, 1000 + cycle, reference)
            levels.append(watch.level)
            offs.append((abs(watch.row_px), abs(watch.depth_m), watch.shift_m))
            tick()
    worst = np.nanmax(np.array(offs), axis=0)
    return {"world": world, "seeds": list(seeds), "pattern": light.projector, "cycles": len(levels),
            "warnings": sum(level is not Level.OK for level in levels), "largest_row_px": _px(worst[0]),
            "largest_depth_mm": _mm(worst[1]), "largest_shift_mm": _mm(worst[2])}


def sit_all(chosen: Mapping[str, Sequence[Trial]], seeds: Sequence[int], lit: Light, cycles: int,
            tick: Callable[[], None] = lambda: None) -> dict[str, Any]:
    """The trials of each world, on the first bin, and so many cycles without drift over all bins."""
    found = [row for world, trials_of in chosen.items() if trials_of for row in sit(world, seeds[0], lit, trials_of, tick)]
    still = [calm(world, seeds, lit, cycles, tick) for world in chosen] if cycles else []
    return {"exam_sha256": exam.sha256(), "trials": found, "calm": still}


def tables(run: dict[str, Any]) -> tuple[Table, Table]:
    """A run of `binpick bench drift` for people."""
    found = Table("world", "drift", "level", "warns, faults after", "pitch px, true", "depth off mm, true", "shift mm, off by",
                  "error of depth mm: undrifted, as it is, corrected by rows, by marks", title="Drift of simulated rigs")
    for row in run["trials"]:
        kinds = ("undrifted", "uncorrected", "by_rows", "by_marks") if "by_marks" in row else ()
        errors = [_depth(row.get(kind)) for kind in kinds]
        found.add_row(row["world"], row["trial"], row["level"], _two(row, "warned_after", "fault_after"),
                      _two(row, "pitch_px", "true_pitch_px"), _two(row, "depth_mm", "true_depth_mm"),
                      _two(row, "shift_mm", "shift_off_mm"), ", ".join(errors))
    still = Table("world", "cycles without drift", "that warn", "largest row px", "largest depth mm", "largest shift mm")
    for row in run["calm"]:
        still.add_row(row["world"], str(row["cycles"]), str(row["warnings"]), str(row["largest_row_px"]),
                      str(row["largest_depth_mm"]), str(row["largest_shift_mm"]))
    return found, still


def _depth(errors: Errors | None) -> str:
    return "-" if errors is None or errors["depth_error_mm"] is None else f"{errors['depth_error_mm']:.3f}"


def _two(row: dict[str, Any], first: str, second: str) -> str:
    return ", ".join("-" if row.get(name) is None else f"{row[name]:g}" for name in (first, second))


def light(pattern: bool) -> Light:
    """The exam's usual one."""
    return replace(settings.resolve(exam.cell("A")).recipe.lights[0], projector=pattern)


def _px(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None


def _mm(metres: float) -> float | None:
    return round(1000 * float(metres), 4) if np.isfinite(metres) else None
