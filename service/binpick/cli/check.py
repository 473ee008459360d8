"""`binpick check`: what stands between this cell file and a running cell."""

import json
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

if TYPE_CHECKING:
    from binpick.cell import Cameras
    from binpick.rig import Rig
    from binpick.settings import Bin, Cell, Recipe, Tool
    from binpick.settings.cell import CameraAddress
    from binpick.settings.mesh import Mesh

CAMERA_LIMIT_S = 10.0


class Finding(NamedTuple):
    """One thing that was looked at; `fault` is empty when it is well, and `exit_code` says what kind of fault.

    `warning`: no fault, but it may become one, or could not be seen. `command` mends either.
    """

    what: str
    seen: str
    fault: str = ""
    exit_code: int = 0
    warning: str = ""
    command: str = ""


def check(
    cell: Annotated[Path, typer.Option(help="Cell file.")],
    host: Annotated[bool, typer.Option("--host", help="Look at this machine instead: the network to the cameras, kernel "
                                                      "settings, clock, processors; also while the daemon runs.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False,
) -> None:
    """Look at everything `run` needs: cell file, rig, free ports, cameras and one pair of images.

    With --host, at the machine instead, and print the commands that mend it. Nothing is changed by looking.

    Exit code 0: all is well. 2: a file or a setting is wrong. 3: a camera does not answer.
    """
    found = list(_of_host(cell) if host else findings(cell))
    if as_json:
        typer.echo(json.dumps([finding._asdict() for finding in found], indent=1))
    else:
        _tell(found)
    raise typer.Exit(max(finding.exit_code for finding in found))


def findings(path: Path) -> Iterator[Finding]:
    """Looks at one thing after the other; what rests on a broken one is left out."""
    from binpick import app, settings
    from binpick.errors import BinpickError

    try:
        cell = settings.load(path)
        yield Finding("cell file", f"{path}: bins {_numbers(cell.bins)}, tools {_numbers(cell.tools)}, recipes "
                                    f"{_numbers(cell.recipes)}, controlled by {cell.control}")
    except BinpickError as error:
        yield Finding("cell file", str(path), str(error), error.exit_code)
        return
    yield from _ports(cell)
    try:
        rig, seen = _rig(cell)
        yield Finding("rig", seen)
    except BinpickError as error:
        yield Finding("rig", str(cell.rig), str(error), error.exit_code)
        return
    for tool in cell.tools:
        yield Finding(f"tool {tool.number}", _tool(tool))
    for recipe in cell.recipes:
        yield _tried(f"recipe {recipe.number}", partial(_recipe, cell, rig, recipe.number))
    cameras = app.cameras(cell)
    try:
        opened = _tried("cameras", partial(_open, cell, cameras))
        yield opened._replace(command=f"binpick check --host --cell {path}" if opened.exit_code == 3 else "")
        if not opened.fault:
            yield _tried("a pair of images", partial(_capture, cell, rig, cameras))
    finally:
        cameras.close()


def _rig(cell: "Cell") -> tuple["Rig", str]:
    """The rig that the daemon would run on, and which that is. Raises RigError."""
    from binpick import rig as rig_file
    from binpick.cell.rigs import Rigs

    rig, warnings = rig_file.load(cell.rig)
    installed = Rigs(cell.calibration_directory, cell.rig, rig).chosen()
    told = [f"{cell.rig}: {' and '.join(c.name for c in rig.cameras)}", *warnings]
    if installed.rig.sha256 != rig.sha256:
        told.append(f"version {installed.told.version} was activated and is used, {installed.told.file}")
    return installed.rig, "; ".join(filter(None, (*told, installed.note)))


def _of_host(path: Path) -> Iterator[Finding]:
    """The machine, as the cameras of this cell file need it. Raises SettingsError."""
    from binpick import host, settings
    from binpick.camera.base import NAMES
    from binpick.errors import CameraError

    cell = settings.load(path)
    cameras, packet_size = cell.cameras, 0
    places: list[tuple[str, str]] = []
    if cameras.backend == "aravis":
        packet_size = 0 if cameras.packet_size == "auto" else cameras.packet_size
        known = (cameras.left, cameras.right, *cameras.more)
        try:
            addresses = _addresses(known)
        except CameraError as error:       # no driver to search with; the machine can be looked at nevertheless
            addresses = [camera.address for camera in known]
            yield Finding("search by serial number", "", str(error), error.exit_code)
        places = list(zip(NAMES, addresses, strict=False))
    for finding in host.judge(host.look(), places, packet_size):
        first = "unknown" if finding.level == "unknown" else ""
        told = ": ".join(part for part in (first, finding.seen, finding.reason) if part)
        fails, well = finding.level == "fail", finding.level == "ok"
        yield Finding(finding.what, finding.seen, told if fails else "", 2 if fails else 0,
                      "" if fails or well else told, finding.command)


def _addresses(cameras: "Sequence[CameraAddress]") -> list[str]:
    """Where they are; those known by their serial number alone are searched. Empty: it does not answer. Raises CameraError."""
    from binpick.camera import backends

    found = () if all(camera.address for camera in cameras) else backends.discover()
    by_serial = {camera.serial: camera.address for camera in found}
    return [camera.address or by_serial.get(camera.serial, "") for camera in cameras]


def _numbers(items: "Iterable[Bin | Tool | Recipe]") -> str:
    return " ".join(str(item.number) for item in items)


def _tried(what: str, look: Callable[[], str]) -> Finding:
    from binpick.errors import BinpickError

    try:
        return Finding(what, look())
    except BinpickError as error:
        return Finding(what, "", str(error), error.exit_code)


def _ports(cell: "Cell") -> Iterator[Finding]:
    for key, server in (("publish.rest", cell.publish.rest), ("publish.modbus", cell.publish.modbus)):
        if server is not None:
            yield _tried(key, partial(_free, server.host, server.port, key))


def _free(host: str, port: int, key: str) -> str:
    from binpick import app

    app.listen(host, port, key).close()
    return f"{host}:{port} is free"


def _tool(tool: "Tool") -> str:
    """What the robot must know of it by itself."""
    from binpick import geometry

    T_flange_tcp = tool.T_flange_tcp.T_parent_this
    position, turn = (", ".join(f"{number:g}" for number in numbers.round(4))
                      for numbers in (1000 * T_flange_tcp[:3, 3], geometry.quaternion(T_flange_tcp)))
    told = f"{tool.name}: the robot's TCP is {position} mm, quaternion xyzw {turn} from its flange; its program "
    if tool.kind == "suction":
        return f"{told}presses {1000 * tool.compression_m:g} mm beyond the pose"
    return f"{told}opens the fingers to each pose's open, and closes them until they hold (at about its close)"


def _recipe(cell: "Cell", rig: "Rig", number: int) -> str:
    from binpick import pipeline, settings
    from binpick.errors import FlangePoseMissing
    from binpick.result import Request

    job = settings.resolve(cell, number)
    located = " (located by its rim)" if job.bin.locate else ""
    seen = f"{job.recipe.name}: bin {job.bin.number}{located}, tools {_numbers(job.tools)}, poses in {job.recipe.frame}"
    if job.recipe.mesh is not None:
        seen += f", {_mesh(job.recipe.mesh)}"
    try:
        pipeline.admit(rig, job, Request())
    except FlangePoseMissing:
        return f"{seen}; every request must carry T_base_flange"
    return seen


def _mesh(mesh: "Mesh") -> str:
    """The part's size and how often it looks alike. Raises InputError."""
    from binpick.grasp import shape

    model = shape.load(mesh)
    alike = len(model.symmetry.turns)
    turns = f"round, {alike} ways" if model.symmetry.axis is not None else f"looks alike {alike} ways"
    return f"mesh {mesh.file.name} ({1000 * model.size_m:.1f} mm long, {turns})"


def _open(cell: "Cell", cameras: "Cameras") -> str:
    from binpick import app

    cameras.open(time.monotonic_ns() + int(CAMERA_LIMIT_S * 1e9))
    app.refuse_simulation_on_502(cell, cameras.statuses())
    return ", ".join(f"{c.name} {c.model} {c.serial} {c.address}".strip() for c in cameras.statuses())


def _capture(cell: "Cell", rig: "Rig", cameras: "Cameras") -> str:
    from binpick.errors import ImageError

    pair = cameras.capture(cell.recipes[0].lights[0], time.monotonic_ns() + int(CAMERA_LIMIT_S * 1e9))
    width, height = rig.image_size_px
    for frame in (pair.left, pair.right):
        if frame.image.shape != (height, width):
            given = f"{frame.image.shape[1]}x{frame.image.shape[0]}"
            raise ImageError(f"camera {frame.camera} gives {given} pixels and the rig was calibrated with {width}x{height}: "
                             "set the camera back, or calibrate again")
    return f"{width}x{height}, mean grey {pair.left.image.mean():.0f} and {pair.right.image.mean():.0f} of 255"


def _tell(found: list[Finding]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for title in ("", "what", "found"):
        table.add_column(title, overflow="fold")
    for finding in found:
        level = "[red]FAIL[/]" if finding.fault else "[yellow]look[/]" if finding.warning else "[green]ok[/]"
        table.add_row(level, finding.what, escape(finding.fault or finding.warning or finding.seen))
    Console().print(table)
    commands = dict.fromkeys(finding.command for finding in found if finding.command)
    if commands:
        typer.echo("\nCommands, in the order of the lines above:")      # below it: whole lines, for copying
    for command in commands:
        typer.echo(f"  {command}")
