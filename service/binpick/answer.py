"""What leaves a cycle: its grasps past the last gate, its code, and the result that says why."""

from dataclasses import asdict

from binpick import geometry
from binpick.cycle import CycleInput
from binpick.data import Grasp, Light, PartPose, StereoPair
from binpick.errors import Code
from binpick.frames import Frames
from binpick.geometry import Transform
from binpick.grasp import gate
from binpick.message import (
    BinMessage,
    FillCellMessage,
    PoseMessage,
    RecipeMessage,
    RimMessage,
    ShotMessage,
    SyncMessage,
)
from binpick.result import Funnel, GraspMessage, Inputs, PartMessage, Result, ReturnCode, Sigma, ToolMessage
from binpick.scene import bin as load_carrier
from binpick.scene.location import Location
from binpick.settings import Job

REASONS = ("rim_not_on_one_part", "no_seal", "tilt", "outside_stroke", "not_parallel", "covered", "no_room",
           "uncertain", "aslant", "wrist", "collide", "history")
"""Counts of tries that fell out; the largest dominates the funnel."""


def publishable(kept: list[Grasp], inputs: CycleInput, frames: Frames) -> tuple[tuple[GraspMessage, ...], dict[str, int]]:
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


def part_messages(parts: tuple[PartPose, ...], inputs: CycleInput, frames: Frames) -> tuple[PartMessage, ...]:
    """Parts in the frame asked for; one whose pose would not pass as a pose has none."""
    mesh = inputs.job.recipe.mesh
    if mesh is None:
        return ()
    frame = inputs.request.frame or inputs.job.recipe.frame
    T_frame_bin = frames.T_frame_bin(frame)
    poses = [part.T_bin_part if part.T_bin_part is not None and geometry.is_rigid(part.T_bin_part) else None for part in parts]
    return tuple(PartMessage(id=part.part_ids[0], part_ids=part.part_ids, label=mesh.file.stem, frame=frame, score=part.score,
                             T_frame_part=None if T is None else _pose(T_frame_bin @ T))
                 for part, T in zip(parts, poses, strict=True))


def _pose(T: Transform) -> PoseMessage:
    x, y, z = T[:3, 3].tolist()
    qx, qy, qz, qw = geometry.quaternion(T).tolist()
    return PoseMessage(position_m=(x, y, z), quaternion_xyzw=(qx, qy, qz, qw))


def code_of(filled: load_carrier.Filling, counts: dict[str, int], messages: tuple[GraspMessage, ...]) -> Code:
    """The outcome of a measured scene; empty only when proved."""
    if messages:
        return Code.OVERFILLED if filled.overfilled else Code.OK
    if counts["clear"]:
        return Code.ALL_OUT_OF_REACH
    if counts.get("history"):
        return Code.ALL_BLOCKED_BY_HISTORY
    if not counts["collide"] and counts["uncertain"]:
        return Code.ALL_UNCERTAIN
    if not counts["collide"] and counts["aslant"] + counts["wrist"]:
        return Code.ALL_OUT_OF_REACH
    if counts["collide"] or counts.get("no_room") or counts.get("covered"):
        return Code.ALL_COLLIDE
    if filled.proved_empty:
        return Code.BIN_EMPTY
    return Code.NOTHING_GRASPABLE if filled.occupied else Code.BIN_UNKNOWN


def answer(inputs: CycleInput, frames: Frames, timing_ms: dict[str, float], code: Code,
           filled: load_carrier.Filling | None = None, grasps: tuple[GraspMessage, ...] = (),
           counts: dict[str, int] | None = None) -> Result:
    """The result of a cycle that got as far as what is given. Without `filled` the bin was not looked into."""
    pair, job = inputs.pair, inputs.job
    worst = max(inputs.pairs, key=lambda shot: abs(shot.skew_us))
    every = [frame for shot in inputs.pairs for frame in shot.frames]
    lost = {k: v for k, v in (counts or {}).items() if v and (k in REASONS or k.startswith("gate_"))}
    return Result(
        cycle_id=inputs.cycle_id, request=inputs.request, captured_at=pair.captured_at, simulated=inputs.simulated,
        return_code=ReturnCode.of(code, frames.location.message if frames.location is not None else ""),
        bin=_bin(job, frames, filled),
        grasps=grasps, funnel=Funnel(counts=counts or {}, dominating=max(lost, key=lambda k: lost[k]) if lost else ""),
        sync=SyncMessage(skew_us=worst.skew_us, sigma_us=worst.sigma_us, proof=worst.proof,
                         resends=sum(frame.resends for frame in every), missing=sum(frame.missing for frame in every),
                         exposure_us=worst.left.exposure_us, gain_db=worst.left.gain_db, arrival_ms=round(worst.arrival_ms, 3),
                         metering=inputs.metering, shots=tuple(map(_shot, inputs.lights, inputs.pairs))),
        timing_ms=timing_ms,
        inputs=Inputs(rig_sha256=inputs.rig.sha256, settings_sha256=job.sha256,
                      frame_ids=(pair.left.frame_id, pair.right.frame_id),
                      recipe=RecipeMessage(number=job.recipe.number, name=job.recipe.name, sha256=job.recipe_sha256)))


def _shot(light: Light, pair: StereoPair) -> ShotMessage:
    return ShotMessage(projector=light.projector, pattern=light.pattern,
                       exposure_us=(pair.left.exposure_us, pair.right.exposure_us),
                       gain_db=(pair.left.gain_db, pair.right.gain_db))


def _bin(job: Job, frames: Frames, filled: load_carrier.Filling | None) -> BinMessage:
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
