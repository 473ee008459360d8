"""The order of the stages: one pure function from a cycle's input to its result."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace

import numpy as np
from jaxtyping import Float32

from binpick import geometry
from binpick.data import Depth, Grasp, HeightMap, OrganisedCloud, Rectified, Segments
from binpick.errors import Code, FlangePoseMissing, FrameUnavailable
from binpick.geometry import Transform
from binpick.grasp import clearance, fingers, gate, rank, suction
from binpick.message import BinMessage, FillCellMessage, PoseMessage, RimMessage
from binpick.result import (
    CycleInput,
    CycleResult,
    FrameName,
    Funnel,
    GraspMessage,
    Inputs,
    RecipeMessage,
    Request,
    Result,
    ReturnCode,
    Sigma,
    SyncMessage,
    ToolMessage,
)
from binpick.rig import Rig
from binpick.scene import bin as load_carrier
from binpick.scene import heightmap
from binpick.scene import segment as segmentation
from binpick.scene.location import Location, locate
from binpick.scene.surface import surface
from binpick.settings import Job, SuctionTool
from binpick.stereo import cloud, rectify
from binpick.stereo import depth as stereo

LEAST_MEASURED = 0.20
"""Below this share of measured pixels in the window there is no depth to speak of."""
MOST_LOOKED_AT = 80
"""So many of the best grasps get an exact look at what their tool would hit."""

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
    admit(inputs.rig, inputs.job, inputs.request)
    clock = _Clock(proceed)
    frames = _Frames.of(inputs)
    with clock.stage("rectify"):
        rect = rectify.rectification(inputs.rig)
        box = load_carrier.search_box(inputs.job.bin, inputs.job.recipe.limits.above_rim_m)
        view = rectify.visible(rect, inputs.rig, rectify.window(rect, frames.T_camera_bin, *box))
        shots = tuple(rectify.rectify(pair.left.image, pair.right.image, inputs.rig, view) for pair in inputs.pairs)
    with clock.stage("match"):
        rectified, depth = stereo.of_shots(shots, inputs.job.recipe.lights, inputs.job.recipe.stereo)
    with clock.stage("cloud"):
        points = cloud.reproject(depth, rectified)
    return _scene(inputs, frames, clock, rectified, depth, points)


def _scene(inputs: CycleInput, frames: "_Frames", clock: "_Clock", rectified: Rectified, depth: Depth,
           points: OrganisedCloud) -> CycleResult:
    """From depth to the answer."""
    job = inputs.job
    measured = float(depth.measured.mean())
    if job.bin.locate and measured >= LEAST_MEASURED:
        with clock.stage("locate"):
            frames = frames.located(locate(points.xyz, job.bin, frames.T_camera_bin))
        if frames.location is not None and frames.location.fault is not None:
            return CycleResult(_answer(inputs, frames, clock, frames.location.fault), rectified, depth, points)
    with clock.stage("bin"):
        grid = surface(depth, rectified, geometry.inverse(frames.T_camera_bin),
                       segmentation.box(job.bin, job.recipe.limits.above_rim_m))
        heights = heightmap.height_map(grid.xyz, job.bin)
        filled = load_carrier.filling(heights, job.bin, job.recipe.part)
    seen = CycleResult(_answer(inputs, frames, clock, Code.NO_DEPTH, filled), rectified, depth, points)
    if measured < LEAST_MEASURED:
        return seen
    with clock.stage("segment"):
        segments = segmentation.segment(grid, job.bin, job.recipe.part, job.recipe.segment)
    with clock.stage("grasp"):
        scene = clearance.obstacles(heights, job.bin)
        found, counts = _candidates(segments, grid.sigma_z_m, scene, job)
    with clock.stage("clearance"):
        kept, clear_counts = _clear(found, segments, heights, scene, inputs)
    counts = {"faces": int(segments.faces.max(initial=0)), "parts": len(segments.part_confidence), **counts, **clear_counts}
    messages, gate_counts = _publishable(kept, inputs, frames)
    counts |= gate_counts
    code = _code(filled, counts, messages)
    result = _answer(inputs, frames, clock, code, filled, messages if code.carries_poses else (), counts)
    return replace(seen, result=result, segments=segments)


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
        counts |= {reason: count + counts.get(reason, 0) for reason, count in reasons.items()}
    return grasps, counts


def _clear(found: list[Grasp], segments: Segments, heights: HeightMap, scene: clearance.Obstacles, inputs: CycleInput,
           ) -> tuple[list[Grasp], dict[str, int]]:
    """The best grasps whose tool touches nothing, in order, with their clearance."""
    job, wanted = inputs.job, inputs.request.max_grasps or inputs.job.recipe.max_grasps
    free: list[Grasp] = []
    for tool in job.tools:
        mine = [grasp for grasp in found if grasp.tool == tool.number]
        free += [grasp for grasp, hit in zip(mine, clearance.blocked(mine, tool, heights), strict=True) if not hit]
    collide, looked = len(found) - len(free), 0
    kept: list[Grasp] = []
    for grasp in rank.ordered(free, segments, *job.tools):
        if len(kept) == wanted or looked == MOST_LOOKED_AT:
            break
        if rank.adds(grasp, kept):
            looked += 1
            distance_m = clearance.clearance(grasp, job.tool_numbered(grasp.tool), scene)
            if distance_m < job.recipe.limits.margin_m:
                collide += 1
            else:
                kept.append(replace(grasp, clearance_m=distance_m))
    return kept, {"collide": collide, "clear": len(kept)}


def _publishable(kept: list[Grasp], inputs: CycleInput, frames: "_Frames") -> tuple[tuple[GraspMessage, ...], dict[str, int]]:
    """The grasps in the frame asked for, as they leave; what the last gate stops is counted by its objection.

    That the rig is unchanged needs no check: one frozen rig came with the images, and all was computed with it.
    """
    job = inputs.job
    T_frame_bin = frames.T_frame_bin(inputs.request.frame or job.recipe.frame)
    T_bin_frame = geometry.inverse(T_frame_bin)
    T_reach_frame = frames.T_reach_bin @ T_bin_frame
    messages: list[GraspMessage] = []
    stopped: dict[str, int] = {}
    fresh = all(frame.received_ns > frame.triggered_ns for pair in inputs.pairs for frame in (pair.left, pair.right))
    for grasp in kept:
        objection = gate.malformed(grasp) if fresh else "older_than_trigger"
        if not objection:
            message = _message(grasp, inputs, T_frame_bin, len(messages) + 1)
            objection = gate.objection(message, T_bin_frame, T_reach_frame, job.bin,
                                       job.tool_numbered(grasp.tool), job.recipe.limits)
        if objection:
            stopped[f"gate_{objection}"] = stopped.get(f"gate_{objection}", 0) + 1
        else:
            messages.append(message)
    return tuple(messages), {**stopped, "published": len(messages)}


def _message(grasp: Grasp, inputs: CycleInput, T_frame_bin: Transform, number: int) -> GraspMessage:
    tool = inputs.job.tool_numbered(grasp.tool)
    T_frame_tcp = T_frame_bin @ grasp.T_bin_tcp
    return GraspMessage(
        id=f"{inputs.cycle_id}-{number}", rank=number, tool=ToolMessage(number=tool.number, name=tool.name, kind=tool.kind),
        frame=inputs.request.frame or inputs.job.recipe.frame, **_pose(T_frame_tcp).model_dump(),
        T_frame_pregrasp=_pose(T_frame_tcp @ geometry.translation(0.0, 0.0, -tool.approach_m)), approach_m=tool.approach_m,
        lift_m=tool.lift_m, open_m=grasp.open_m, close_m=grasp.close_m, quality=grasp.quality, part_id=grasp.part_id,
        sigma=Sigma(xy_m=grasp.sigma_xy_m, z_m=grasp.sigma_z_m, tilt_rad=grasp.sigma_tilt_rad), clearance_m=grasp.clearance_m)


def _pose(T: Transform) -> PoseMessage:
    x, y, z = T[:3, 3].tolist()
    qx, qy, qz, qw = geometry.quaternion(T).tolist()
    return PoseMessage(position_m=(x, y, z), quaternion_xyzw=(qx, qy, qz, qw))


def _code(filled: load_carrier.Filling, counts: dict[str, int], messages: tuple[GraspMessage, ...]) -> Code:
    """The outcome of a measured scene; empty only when proved."""
    if messages:
        return Code.OVERFILLED if filled.overfilled else Code.OK
    if counts["clear"]:
        return Code.ALL_OUT_OF_REACH
    if counts["collide"] or counts.get("no_room") or counts.get("covered"):
        return Code.ALL_COLLIDE
    if filled.proved_empty:
        return Code.BIN_EMPTY
    return Code.NOTHING_GRASPABLE if filled.occupied else Code.BIN_UNKNOWN


REASONS = ("rim_not_on_one_part", "no_seal", "tilt", "outside_stroke", "not_parallel", "covered", "no_room",
           "collide")


def _answer(inputs: CycleInput, frames: "_Frames", clock: "_Clock", code: Code, filled: load_carrier.Filling | None = None,
            grasps: tuple[GraspMessage, ...] = (), counts: dict[str, int] | None = None) -> Result:
    pair, job = inputs.pair, inputs.job
    worst = max(inputs.pairs, key=lambda shot: abs(shot.skew_us))
    every = [frame for shot in inputs.pairs for frame in (shot.left, shot.right)]
    lost = {k: v for k, v in (counts or {}).items() if v and (k in REASONS or k.startswith("gate_"))}
    return Result(
        cycle_id=inputs.cycle_id, request=inputs.request, captured_at=pair.captured_at, simulated=inputs.simulated,
        return_code=ReturnCode.of(code, frames.location.message if frames.location is not None else ""),
        bin=_bin(job, frames, filled),
        grasps=grasps, funnel=Funnel(counts=counts or {}, dominating=max(lost, key=lambda k: lost[k]) if lost else ""),
        sync=SyncMessage(skew_us=worst.skew_us, sigma_us=worst.sigma_us, proof=worst.proof,
                         resends=sum(frame.resends for frame in every), missing=sum(frame.missing for frame in every)),
        timing_ms=clock.spent(),
        inputs=Inputs(rig_sha256=inputs.rig.sha256, settings_sha256=job.sha256,
                      frame_ids=(pair.left.frame_id, pair.right.frame_id),
                      recipe=RecipeMessage(number=job.recipe.number, name=job.recipe.name, sha256=job.recipe_sha256)))


def _bin(job: Job, frames: "_Frames", filled: load_carrier.Filling | None) -> BinMessage:
    """The bin in the answer. One that was to be located and was not has no pose: the expected one might be taken for it."""
    found = frames.location.fault is None if frames.location is not None else not job.bin.locate
    message = BinMessage(found=found, number=job.bin.number, T_camera_bin=_pose(frames.T_camera_bin) if found else None,
                         fill_level=None, coverage=None, rim=_rim(frames.location))
    if filled is None or not found:
        return message
    cells = tuple(FillCellMessage(**asdict(cell)) for cell in filled.cells)
    return message.model_copy(update={"fill_level": filled.level, "coverage": filled.coverage, "cells": cells})


def _rim(found: Location | None) -> RimMessage | None:
    if found is None:
        return None
    (a, b, c, d), (x, y, z) = found.seen.there.tolist(), found.T_expected_bin[:3, 3].tolist()
    return RimMessage(seen=(a, b, c, d), rms_m=found.seen.rms_m, shift_m=(x, y, z), yaw_rad=found.yaw_rad,
                      tilt_rad=found.tilt_rad)


@dataclass(frozen=True, slots=True)
class _Frames:
    """Where camera, bin and base stand to each other in this cycle; `location` is how the bin was located, if it was to be."""

    T_camera_bin: Transform
    T_base_camera: Transform | None
    location: Location | None = None

    @classmethod
    def of(cls, inputs: CycleInput) -> "_Frames":
        return cls(load_carrier.place(inputs.job.bin, inputs.T_base_camera), inputs.T_base_camera)

    def located(self, found: Location) -> "_Frames":
        """With the bin where its rim was found."""
        return replace(self, T_camera_bin=self.T_camera_bin @ found.T_expected_bin, location=found)

    def T_frame_bin(self, frame: FrameName) -> Transform:
        """Maps bin coordinates to the frame of that name; `admit` has proved that it exists."""
        if frame == "bin":
            return np.eye(4)
        if frame == "camera":
            return self.T_camera_bin
        if self.T_base_camera is None:
            raise FrameUnavailable('poses in "base" need a hand-eye calibration')
        T_base_bin: Transform = self.T_base_camera @ self.T_camera_bin
        return T_base_bin

    @property
    def T_reach_bin(self) -> Transform:
        """The reach box lives in the base where there is one, else in the camera's frame."""
        return self.T_frame_bin("camera" if self.T_base_camera is None else "base")


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
