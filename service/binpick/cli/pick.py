"""`binpick pick`: one cycle on two images from disk, or on a recording."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from binpick.cycle import CycleInput, CycleResult
    from binpick.message import PoseMessage
    from binpick.result import Request
    from binpick.rig import Rig
    from binpick.settings import Cell, Job, Recipe

PICTURES = ("cloud.ply", "overlay.png")


def pick(
    left: Annotated[Path, typer.Option(help="Left image, 8-bit grey, as the camera gave it.")],
    right: Annotated[Path, typer.Option(help="Right image of the same instant.")],
    rig: Annotated[Path, typer.Option(help="Rig file of these cameras.")],
    cell: Annotated[Path, typer.Option(help="Cell file: bin, tool, recipe.")],
    out: Annotated[Path, typer.Option(help="Folder for result.json, cloud.ply and overlay.png.")],
    recipe: Annotated[int, typer.Option(help="Recipe number; 0: the first.", min=0, max=65535)] = 0,
    flange_pose: Annotated[str, typer.Option(metavar="'X Y Z QX QY QZ QW'", help="Flange in base, metres and quaternion, for a "
                                             "rig that rides on it.")] = "",
    fresh: Annotated[bool, typer.Option("--fresh", help="Leave out what a recording remembers of its bin.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result instead of a summary.")] = False,
) -> None:
    """Find grasps in one stereo pair.

    Images that belong to a recording (input.json beside them) run with its request and cycle number, and give its result
    byte for byte, times aside. Exit code 1: the scene says no; the return code says why.
    """
    from binpick import artefacts, pipeline, settings
    from binpick import rig as rig_file
    from binpick.outcomes import NO_MEMORY
    from binpick.result import Request

    loaded_rig, warnings = rig_file.load(rig)
    for warning in warnings:
        typer.echo(warning, err=True)
    inputs = _inputs(left, right, loaded_rig, settings.load(cell), Request(recipe=recipe, T_base_flange=_flange(flange_pose)))
    if fresh:
        inputs = replace(inputs, memory=NO_MEMORY)
        typer.echo("fresh: nothing is remembered of the bin", err=True)
    outcome = pipeline.run(inputs)
    write(out, {"result.json": outcome.result.json_bytes(),
                 **{name: artefacts.render(inputs, outcome, name)[1] for name in PICTURES}})
    if as_json:
        typer.echo(outcome.result.json_bytes().decode(), nl=False)
    else:
        _tell(outcome, out)
    if not outcome.result.return_code.code.carries_poses:
        raise typer.Exit(1)


def _flange(numbers: str) -> "PoseMessage | None":
    """The pose of seven numbers; None of none. Raises InputError."""
    from pydantic import ValidationError

    from binpick.errors import InputError
    from binpick.message import PoseMessage

    if not numbers:
        return None
    try:
        x, y, z, qx, qy, qz, qw = map(float, numbers.replace(",", " ").split())
        return PoseMessage(position_m=(x, y, z), quaternion_xyzw=(qx, qy, qz, qw))
    except ValidationError as error:
        raise InputError(f"--flange-pose {numbers}: {error.errors()[0]['msg']}") from error
    except ValueError as error:
        raise InputError(f"--flange-pose {numbers}: write it as seven numbers: x y z in metres, quaternion x y z w") from error


def _inputs(left: Path, right: Path, rig: "Rig", cell: "Cell", request: "Request") -> "CycleInput":
    """The cycle of two images; of a recording when they belong to one."""
    import time

    from binpick import recording, settings
    from binpick.camera import backends
    from binpick.cycle import CycleInput

    job = settings.resolve(cell, request.recipe)
    if (left.parent / "input.json").is_file() and (left.name, right) == ("left.png", left.parent / "right.png"):
        typer.echo(f"{left.parent} is a recording: its cycle and request are used", err=True)
        recorded, _ = recording.load(left.parent)
        job = settings.resolve(cell, request.recipe or recorded.request.recipe, recorded.request.bin, recorded.request.tool)
        if recorded.more or recorded.job.recipe.metered or len(job.recipe.lights) > 1:
            job = _exposed(job, recorded.job.recipe)
        flange = request.T_base_flange or recorded.request.T_base_flange
        guard = recorded.guard.for_rig(rig) if recorded.guard is not None else None
        asked = recorded.request.model_copy(update={"T_base_flange": flange})
        return replace(recorded, rig=rig, job=job, guard=guard, request=asked)
    if len(job.recipe.lights) > 1:
        typer.echo(f"two images are one shot: the other {len(job.recipe.lights) - 1} of the recipe are left out", err=True)
        job = _exposed(job, job.recipe.single)
    files = settings.FileCameras(backend="files", left=left, right=right)
    cameras = backends.group(files)
    deadline_ns = time.monotonic_ns() + 10_000_000_000
    cameras.open(deadline_ns)
    try:
        pair = cameras.capture(job.recipe.lights[0], deadline_ns)
    finally:
        cameras.close()
    return CycleInput(cycle_id=1, pair=pair, rig=rig, job=job, request=request, simulated=False)


def _exposed(job: "Job", taken: "Recipe") -> "Job":
    """The job with the shots that the images really are: those of the recipe they were taken by."""
    light = {name: getattr(taken, name) for name in ("exposure_us", "auto", "gain_db", "projector", "hdr", "shots")}
    return job.model_copy(update={"recipe": job.recipe.model_copy(update=light)})


def write(folder: Path, files: dict[str, bytes]) -> None:
    """Writes the files of a command. Raises InputError when the folder cannot be written."""
    from binpick.errors import InputError

    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, body in files.items():
            (folder / name).write_bytes(body)
    except OSError as error:
        raise InputError(f"{error.filename or folder}: cannot be written: {error.strerror}") from error


def _tell(outcome: "CycleResult", out: Path) -> None:
    """The summary for people: the outcome, the grasps, and why no more."""
    from rich.console import Console
    from rich.table import Table

    result, console = outcome.result, Console()
    console.print(f"{result.return_code.value} {result.return_code.name}: {result.return_code.message}")
    if result.grasps:
        table = Table("rank", "x mm", "y mm", "z mm", "quality", "clearance mm", "σz mm",
                      title=f"Grasps in frame {result.grasps[0].frame}")
        for grasp in result.grasps:
            x, y, z = (f"{1000 * value:.1f}" for value in grasp.position_m)
            table.add_row(str(grasp.rank), x, y, z, f"{grasp.quality:.2f}", f"{1000 * grasp.clearance_m:.1f}",
                          f"{1000 * grasp.sigma.z_m:.2f}")
        console.print(table)
    if result.funnel is not None:
        console.print("  ".join(f"{name} {count}" for name, count in result.funnel.counts.items()))
    if result.parts:
        posed = sum(part.T_frame_part is not None for part in result.parts)
        console.print(f"{posed} of {len(result.parts)} parts looked at have a pose by the mesh {result.parts[0].label}")
    console.print(f"{result.timing_ms.get('compute', 0):.0f} ms; written to {out}")
