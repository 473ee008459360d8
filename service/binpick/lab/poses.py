"""Poses against the truth: how far the parts that were given one are off, and how many of those in plain view have one."""

import itertools
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
from jaxtyping import Float64
from rich.table import Table

from binpick import geometry, pipeline
from binpick.cycle import CycleInput, CycleResult
from binpick.geometry import Transform
from binpick.grasp import shape
from binpick.grasp.shape import Shape
from binpick.lab import exam, parts
from binpick.lab.exam import Paper
from binpick.result import PartMessage
from binpick.settings.mesh import Mesh
from binpick.sim import exam as frozen
from binpick.sim.mesh import part_mesh

BINS = (*frozen.MIXTURES["mixed"], "mixed")
"""Bins of one kind each, by its mesh; and mixed ones, by every mesh: there most parts are of another kind."""
WITHIN_MM = (1, 2, 3)
LEVELS = ((0.85, 1.01), (0.7, 0.85), (0.5, 0.7))
"""How much of a part is seen, from and to; the first two together are what must be found."""
GOOD_M = 0.002
Figures = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Given:
    """A pose in the result: its score, and how far the nearest true part of that kind is.

    `adds_m` is the mean distance of the surface to the true one (ADD-S of dense points, Hinterstoisser 2012), `mssd_m` the
    largest distance of a point from where it should be (MSSD, Hodan 2020); inf when there is no such part.
    """

    part_id: int
    score: float
    adds_m: float
    mssd_m: float


@dataclass(frozen=True, slots=True)
class Sheet:
    """One bin by one mesh: its poses, the visibility of each part of that kind, and the time of one pose alone."""

    bin: str
    kind: str
    seed: int
    given: tuple[Given, ...]
    visibility: dict[int, float]
    first_ms: float


def sit(world: str, seeds: Iterable[int], count: int) -> Iterator[Sheet]:
    """All bins of `count` parts, by each mesh that is tried on them. Raises InputError for an unknown world."""
    with tempfile.TemporaryDirectory() as folder:
        files = {kind: written(Path(folder), kind) for kind in frozen.MIXTURES["mixed"]}
        for seed, bin_ in itertools.product(seeds, BINS):
            paper = exam.paper(world, seed, kinds=bin_, parts=count)
            yield from sheets(exam.for_tool(paper, "suction", "two_finger"), bin_, files)  # no grasps, no poses


def sheets(paper: Paper, bin_: str, files: dict[str, Path]) -> Iterator[Sheet]:
    """One bin, rendered and segmented once."""
    cycle = pipeline.grasps(paper.inputs)
    if cycle.rectified is None:
        raise RuntimeError("a cycle of the exam always has a window")
    view = cycle.rectified.window
    seen = parts.visibility(paper, paper.truth(view), view)
    for kind in files if bin_ == "mixed" else (bin_,):
        of_kind = {part.part_id: seen.get(part.part_id, 0.0) for part in paper.scene.parts if part.kind == kind}
        given, first_ms = _given(paper, cycle, kind, files[kind])
        yield Sheet(bin_, kind, paper.scene.seed, given, of_kind, first_ms)


def written(folder: Path, kind: str) -> Path:
    """A kind's mesh as a CAD system exports it: STL, mm."""
    mesh = part_mesh(kind)
    stl = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(mesh.vertices * 1000),
                                    o3d.utility.Vector3iVector(mesh.triangles.astype(np.int32)))
    stl.compute_triangle_normals()
    o3d.io.write_triangle_mesh(folder / f"{kind}.stl", stl)
    return folder / f"{kind}.stl"


def by_mesh(inputs: CycleInput, mesh: Mesh) -> CycleInput:
    """The same frames for a recipe with a mesh."""
    return replace(inputs, job=inputs.job.model_copy(update={"recipe": inputs.job.recipe.model_copy(update={"mesh": mesh})}))


def _given(paper: Paper, cycle: CycleResult, kind: str, file: Path) -> tuple[tuple[Given, ...], float]:
    all_of_them = Mesh(file=file, unit="mm", poses=100)
    model = shape.load(all_of_them)
    first = pipeline.poses(by_mesh(paper.inputs, all_of_them.model_copy(update={"poses": 1})), cycle)
    found = pipeline.poses(by_mesh(paper.inputs, all_of_them), cycle).result.parts
    true = {part.part_id: part.T_bin_part for part in paper.scene.parts if part.kind == kind}
    given = tuple(judged(part, true, model) for part in found if part.T_frame_part is not None)
    return given, first.result.timing_ms.get("pose", float("nan"))


def judged(part: PartMessage, true: dict[int, Transform], model: Shape) -> Given:
    """A pose in frame `bin` against the true parts of its kind: the one that it is nearest to."""
    pose = part.T_frame_part
    if pose is None or part.frame != "bin":
        raise ValueError("the exam's papers are answered in the bin's frame, and only poses are judged")
    T_bin_part = geometry.from_quaternion(np.array(pose.position_m), np.array(pose.quaternion_xyzw))
    offs = [(adds_m(T_bin_part, T, model), i) for i, T in true.items()]
    if not offs:
        return Given(0, part.score, float("inf"), float("inf"))
    nearest, i = min(offs)
    return Given(i, part.score, nearest, mssd_m(T_bin_part, true[i], model))


def adds_m(T_bin_found: Transform, T_bin_true: Transform, model: Shape) -> float:
    """The mean distance of the found part's surface to the true one's."""
    T = _about(model, geometry.inverse(T_bin_true) @ T_bin_found)
    distance, _ = model.field.at(geometry.transform(T, model.points))
    return float(np.abs(distance).mean())


def mssd_m(T_bin_found: Transform, T_bin_true: Transform, model: Shape) -> float:
    """The largest distance of a point from where it should be, the part's symmetries allowed."""
    T = _about(model, geometry.inverse(T_bin_true) @ T_bin_found)
    found = geometry.transform(T, model.points.astype(np.float64))
    alike: Float64[np.ndarray, "s n 3"] = model.points[None] @ model.symmetry.sampled.transpose(0, 2, 1)
    return float(np.linalg.norm(alike - found, axis=2).max(axis=1).min())


def _about(model: Shape, T: Transform) -> Transform:
    """A motion of the mesh's frame as one about the shape's centre."""
    return np.asarray(geometry.translation(*-model.centre) @ T @ geometry.translation(*model.centre))


def figures(world: str, count: int, done: Sequence[Sheet]) -> Figures:
    """All figures of a run: per kind of part over bins of that kind, the mixed bins, and both together."""
    groups = {bin_: [sheet for sheet in done if sheet.bin == bin_] for bin_ in BINS}
    groups["all"] = list(done)
    return {"exam_sha256": frozen.sha256(), "world": world, "parts": count, "seeds": sorted({sheet.seed for sheet in done}),
            "bins": {name: row(group) for name, group in groups.items() if group}}


def row(done: Sequence[Sheet]) -> Figures:
    """Some bins pooled. A part counts as found when some pose is within `GOOD_M` of it."""
    given = [pose for sheet in done for pose in sheet.given]
    found = [{pose.part_id for pose in sheet.given if pose.adds_m <= GOOD_M} for sheet in done]
    shares = [(visibility, i in good) for sheet, good in zip(done, found, strict=True)
              for i, visibility in sheet.visibility.items()]
    timed = [sheet.first_ms for sheet in done if np.isfinite(sheet.first_ms)]

    def recall(low: float, high: float) -> Figures:
        asked = [was for visibility, was in shares if low <= visibility < high]
        return _share(sum(asked), len(asked))

    return {
        "poses": len(given),
        "within_mm": {str(mm): _share(sum(1000 * pose.adds_m <= mm for pose in given), len(given)) for mm in WITHIN_MM},
        "every_point_within_4_mm": _share(sum(pose.mssd_m <= 0.004 for pose in given), len(given)),
        "recall": {f"{low:.2f}": recall(low, high) for low, high in LEVELS} | {"plain": recall(LEVELS[1][0], LEVELS[0][1])},
        "first_ms": round(float(np.median(timed)), 1) if timed else None,
    }


def _share(good: int, of: int) -> Figures:
    low, high = exam.wilson(good, of)
    return {"good": good, "of": of, "share": round(good / of, 3) if of else None, "interval": [round(low, 3), round(high, 3)]}


def table(run: Figures) -> Table:
    """A run of `binpick bench pose`."""
    seen = [f"found, seen {share}" for share in ("85 %", "70 to 85 %", "50 to 70 %", "70 % and more")]
    title = (f"Exam world {run['world']}, {run['parts']} parts, seeds {run['seeds'][0]} to {run['seeds'][-1]}, "
             f"tables {run['exam_sha256'][:12]}")
    head = Table("bin", "poses", *(f"ADD-S ≤ {mm} mm" for mm in WITHIN_MM), "all within 4 mm", *seen, "first, ms",
                 title=title, title_justify="left")
    for name, each in run["bins"].items():
        shares = [*each["within_mm"].values(), each["every_point_within_4_mm"], *each["recall"].values()]
        first = "-" if each["first_ms"] is None else f"{each['first_ms']:.0f}"
        head.add_row(name, str(each["poses"]), *(_of(share) for share in shares), first)
    return head


def _of(share: Figures) -> str:
    return "-" if share["share"] is None else f"{share['good']}/{share['of']} ({share['share']:.0%})"
