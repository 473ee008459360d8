"""The order of the stages: one pure function from a cycle's input to its result."""

import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from jaxtyping import Float32

from binpick import geometry, watchdog
from binpick.answer import answer, code_of, part_messages, publishable
from binpick.cycle import CycleInput, CycleResult
from binpick.data import Depth, Grasp, HeightMap, Image, Light, OrganisedCloud, PartPose, Rectified, Segments
from binpick.errors import Code, FlangePoseMissing, FrameUnavailable
from binpick.frames import Frames
from binpick.geometry import Transform, Vector
from binpick.grasp import (
    admission,
    cad,
    clearance,
    fingers,
    memory,
    rank,
    shape,
    sight,
    sigma,
    suction,
    taught,
    verification,
    wrist,
)
from binpick.result import Request
from binpick.rig import Rig
from binpick.scene import bin as load_carrier
from binpick.scene import heightmap
from binpick.scene import segment as segmentation
from binpick.scene.location import locate
from binpick.scene.surface import Surface, surface
from binpick.settings import Job, SuctionTool
from binpick.stereo import cloud, rectify
from binpick.stereo import depth as stereo

LEAST_MEASURED = 0.20
"""Below this share of measured pixels in the window there is no depth to speak of."""
MOST_LOOKED_AT = 80
"""So many of the best grasps get an exact look at what their tool would hit."""
POSE_M = 0.0025
"""Parts may seem to lie this deep in the bin's floor or walls."""

Proceed = Callable[[], None]


def admit(rig: Rig, job: Job, request: Request) -> None:
    """Refuses a request whose answer could not exist. Raises FrameUnavailable, FlangePoseMissing."""
    needs_base = (request.frame or job.recipe.frame) == "base" or job.bin.pose.frame == "base"
    if rig.T_flange_rig is not None and needs_base and request.T_base_flange is None:
        raise FlangePoseMissing("the cameras ride on the flange: send T_base_flange with the request")
    if rig.T_base_rig is None and rig.T_flange_rig is None and needs_base:
        raise FrameUnavailable(
            'the rig has no hand-eye calibration, so poses in "base" do not exist: ask for frame "camera" or "bin"')


def run(inputs: CycleInput, proceed: Proceed = lambda: None) -> CycleResult:
    """The cycle. `proceed` is called between stages and may raise to end it (time limit, abort).

    Raises InputError for images that do not belong to the rig; a bad scene is a return code.
    """
    return poses(inputs, grasps(inputs, proceed), proceed)


def poses(inputs: CycleInput, cycle: CycleResult, proceed: Proceed = lambda: None) -> CycleResult:
    """The same cycle with its parts' poses, if the recipe has a mesh and they were not needed for its grasps.

    A code without grasps has no poses of parts either: there are poses, or there is a reason.
    """
    mesh, segments = inputs.job.recipe.mesh, cycle.segments
    wanted = mesh is not None and not mesh.grasps and cycle.result.return_code.code.carries_poses
    if not wanted or segments is None or cycle.rectified is None or cycle.T_camera_bin is None:
        return cycle
    clock = _Clock(proceed)
    frames = replace(Frames.of(inputs), T_camera_bin=cycle.T_camera_bin)
    with clock.stage("pose"):
        ranked = (grasp.part_id for grasp in cycle.result.grasps)
        parts = _located(inputs, cycle.T_camera_bin, cycle.rectified, segments, ranked, proceed)
    messages = part_messages(parts, inputs, frames)
    return _later(replace(cycle, result=cycle.result.model_copy(update={"parts": messages})), clock)


def grasps(inputs: CycleInput, proceed: Proceed = lambda: None) -> CycleResult:
    """The cycle up to its grasps, which do not wait for poses that they do not need. Raises like `run`."""
    admit(inputs.rig, inputs.job, inputs.request)
    clock = _Clock(proceed)
    frames = Frames.of(inputs)
    with clock.stage("rectify"):
        rig = watchdog.rig(inputs)
        rect = rectify.rectification(rig)
        box = load_carrier.search_box(inputs.job.bin, inputs.job.recipe.limits.above_rim_m)
        view = rectify.visible(rect, rig, rectify.window(rect, frames.T_camera_bin, *box))
        shots = tuple(rectify.rectify(pair.left.image, pair.right.image, rig, view) for pair in inputs.pairs)
    with ThreadPoolExecutor(1, thread_name_prefix="binpick-watchdog") as beside:
        looking = beside.submit(watchdog.look, inputs, rig, shots[0])
        if inputs.verify is not None:
            return _watched(inputs, rig, CycleResult(answer(inputs, frames, clock.spent(), Code.OK)), looking, proceed)
        with clock.stage("match"):
            rectified, depth = stereo.of_shots(shots, inputs.lights, inputs.job.recipe.stereo)
        cycle = _scene(inputs, frames, clock, rectified, depth, partial(cloud.reproject, depth, rectified))
        return _watched(inputs, rig, replace(cycle, shown=_shown(shots, inputs.lights)), looking, proceed)


def _watched(inputs: CycleInput, rig: Rig, cycle: CycleResult, looking: Future[watchdog.Look | None], proceed: Proceed,
             ) -> CycleResult:
    """The cycle after the watchdog's word, which has long been found when the grasps are."""
    if inputs.guard is None:
        return cycle
    clock = _Clock(proceed)
    with clock.stage("calibration"):
        cycle = watchdog.judged(inputs, rig, cycle, looking.result())
    return _later(cycle, clock)


def _later(cycle: CycleResult, clock: "_Clock") -> CycleResult:
    """With the times of stages that came after its answer."""
    was, spent = cycle.result.timing_ms, clock.spent()
    times = {**was, **spent, "compute": round(was["compute"] + spent["compute"], 3)}
    return replace(cycle, result=cycle.result.model_copy(update={"timing_ms": times}))


def _shown(shots: tuple[Rectified, ...], lights: tuple[Light, ...]) -> Image | None:
    """The window of the left view in the first shot without the pattern, unless all are."""
    plain = [shot for shot, light in zip(shots, lights, strict=True) if not light.projector]
    return plain[0].left[:, plain[0].margin:] if plain and lights[0].projector else None


def _scene(inputs: CycleInput, frames: Frames, clock: "_Clock", rectified: Rectified, depth: Depth,
           points: Callable[[], OrganisedCloud]) -> CycleResult:
    """From depth to the answer."""
    job = inputs.job
    measured = float(depth.measured.mean())
    if job.bin.locate and measured >= LEAST_MEASURED:
        with clock.stage("locate"):
            frames = frames.located(locate(points().xyz, job.bin, frames.T_camera_bin))
        if frames.location is not None and frames.location.fault is not None:
            return CycleResult(answer(inputs, frames, clock.spent(), frames.location.fault), rectified, depth, points)
    with clock.stage("bin"):
        grid = surface(depth, rectified, geometry.inverse(frames.T_camera_bin),
                       segmentation.box(job.bin, job.recipe.limits.above_rim_m))
    if measured < LEAST_MEASURED:
        _, filled, _ = _contents(grid, job)
        return CycleResult(answer(inputs, frames, clock.spent(), Code.NO_DEPTH, filled), rectified, depth, points,
                           T_camera_bin=frames.T_camera_bin)
    with clock.stage("segment"), ThreadPoolExecutor(1, thread_name_prefix="binpick-contents") as beside:
        contents = beside.submit(_contents, grid, job)
        segments = segmentation.segment(grid, job.bin, job.recipe.part, job.recipe.segment)
        heights, filled, scene = contents.result()
    with clock.stage("memory"):
        verdicts = verification.verified(inputs.memory, heights)
        inputs = replace(inputs, memory=memory.standing(inputs.memory, heights, inputs.pair.captured_at, verdicts))
    found, counts, parts = _offered(inputs, frames, clock, rectified, segments, grid.sigma_z_m, scene)
    with clock.stage("clearance"):
        kept, clear_counts = _clear(found, segments, heights, scene, inputs)
    messages, gate_counts = publishable(kept, inputs, frames)
    counts = {"faces": int(segments.faces.max(initial=0)), "parts": len(segments.part_confidence), **counts, **clear_counts,
              **gate_counts}
    code = code_of(filled, counts, messages)
    published = messages if code.carries_poses else ()
    with clock.stage("remember"):
        T_bin_frame = geometry.inverse(frames.T_frame_bin(inputs.request.frame or job.recipe.frame))
        after = memory.looked(inputs, published, T_bin_frame, heights, segments)
    result = answer(inputs, frames, clock.spent(), code, filled, published, counts)
    result = result.model_copy(update={"parts": part_messages(parts, inputs, frames) if code.carries_poses else ()})
    return CycleResult(result, rectified, depth, points, segments, verdicts, after, frames.T_camera_bin)


def _contents(grid: Surface, job: Job) -> tuple[HeightMap, load_carrier.Filling, clearance.Obstacles]:
    """What the bin's surface says without its parts being told apart."""
    heights = heightmap.height_map(grid.xyz, job.bin, grid.eyes)
    return heights, load_carrier.filling(heights, job.bin, job.recipe.part), clearance.obstacles(heights, job.bin)


def _offered(inputs: CycleInput, frames: Frames, clock: "_Clock", rectified: Rectified, segments: Segments,
             sigma_z_m: Float32[np.ndarray, "h w"], scene: clearance.Obstacles,
             ) -> tuple[list[Grasp], dict[str, int], tuple[PartPose, ...]]:
    """What the tools could grip and the limits let through, taught grasps included, and the poses that those needed."""
    job = inputs.job
    parts: tuple[PartPose, ...] = ()
    with clock.stage("grasp"):
        found, counts = _candidates(segments, sigma_z_m, scene, job)
    if job.recipe.mesh is not None and job.recipe.mesh.grasps:
        with clock.stage("pose"):
            ranked = (grasp.part_id for grasp in rank.ordered(found, segments, *job.tools))
            parts = _located(inputs, frames.T_camera_bin, rectified, segments, ranked, clock.proceed)
            more, reasons = taught.candidates(parts, job.recipe.mesh, job.tools, segments, scene)
            found, counts = found + more, _summed(counts, reasons)
    if (inputs.request.frame or job.recipe.frame) == "base":
        found = sigma.calibrated(found, inputs.rig, frames.T_camera_bin)
    found, limited = admission.admitted(found, job)
    return found, {**counts, **limited}, parts


def _candidates(segments: Segments, sigma_z_m: Float32[np.ndarray, "h w"], scene: clearance.Obstacles, job: Job,
                ) -> tuple[list[Grasp], dict[str, int]]:
    """What any of the recipe's tools could grip, and how many tries fell out for which reason."""
    grasps: list[Grasp] = []
    counts: dict[str, int] = {}
    for tool in job.tools:
        if isinstance(tool, SuctionTool):
            found, reasons = suction.candidates(segments, tool, sigma_z_m)
        else:
            found, reasons = fingers.candidates(segments, tool, sigma_z_m, scene, job.recipe.limits.margin_m)
        grasps += found
        counts = _summed(counts, reasons)
    return grasps, counts


def _summed(counts: dict[str, int], more: dict[str, int]) -> dict[str, int]:
    return counts | {reason: count + counts.get(reason, 0) for reason, count in more.items()}


def _located(inputs: CycleInput, T_camera_bin: Transform, rectified: Rectified, segments: Segments, ranked: Iterable[int],
             proceed: Proceed) -> tuple[PartPose, ...]:
    """The poses of the recipe's number of parts: those with grasps in their order, then the surest and highest."""
    mesh = inputs.job.recipe.mesh
    assert mesh is not None
    height = {label: round(float(points[:, 2].mean()), 3) for label, points in segments.part_points.items()}
    rest = sorted(height, key=lambda label: (-segments.part_confidence[label] * height[label], label))
    seen = sight.Sight.of(segments, rectified, geometry.inverse(T_camera_bin))
    model, order = shape.load(mesh), dict.fromkeys([*ranked, *rest])
    return cad.locate(model, seen, segments, _each(order, proceed), mesh.poses, _room(inputs.job))


def _each(order: Iterable[int], proceed: Proceed) -> Iterator[int]:
    """The same, but that it is asked before each whether to go on: a part takes a tenth of a second."""
    for label in order:
        proceed()
        yield label


def _room(job: Job) -> tuple[Vector, Vector]:
    """The corners of the bin's inside, as far out as poses err."""
    length, width, _ = job.bin.inner_size_m
    side = np.array([length / 2, width / 2]) + POSE_M
    return np.array([*-side, -POSE_M]), np.array([*side, np.inf])


def _clear(found: list[Grasp], segments: Segments, heights: HeightMap, scene: clearance.Obstacles, inputs: CycleInput,
           ) -> tuple[list[Grasp], dict[str, int]]:
    """The best grasps whose tool touches nothing, in order, with their clearance."""
    job, wanted = inputs.job, inputs.request.max_grasps or inputs.job.recipe.max_grasps
    free: list[Grasp] = []
    for tool in job.tools:
        mine = [wrist.equivalents(grasp, tool) for grasp in found if grasp.tool == tool.number]
        whose = [number for number, ways in enumerate(mine) for _ in ways]
        hits = clearance.blocked([turned for ways in mine for turned in ways], tool, heights).tolist()
        some = {number for number, hit in zip(whose, hits, strict=True) if not hit}
        free += [ways[0] for number, ways in enumerate(mine) if number in some]
    collide, looked = len(found) - len(free), 0
    kept: list[Grasp] = []
    ordered, blocked = memory.weighed(rank.ordered(free, segments, *job.tools), inputs.memory)
    for grasp in ordered:
        if len(kept) == wanted or looked == MOST_LOOKED_AT:
            break
        if rank.adds(grasp, kept):
            looked += 1
            tool = job.tool_numbered(grasp.tool)
            ways = (replace(turned, clearance_m=clearance.clearance(turned, tool, scene))
                    for turned in wrist.equivalents(grasp, tool))
            if (clear := next((way for way in ways if way.clearance_m >= job.recipe.limits.margin_m), None)) is None:
                collide += 1
            else:
                kept.append(clear)
    return kept, {"collide": collide, "history": blocked, "clear": len(kept)}


@dataclass(slots=True)
class _Clock:
    """Times the stages, and asks between them whether to go on."""

    proceed: Proceed
    stages: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Times one stage under its name."""
        self.proceed()
        began = time.perf_counter()
        yield
        self.stages[name] = round((time.perf_counter() - began) * 1000, 3)

    def spent(self) -> dict[str, float]:
        """Milliseconds per stage, and their sum as `compute`."""
        return {**self.stages, "compute": round(sum(self.stages.values()), 3)}
