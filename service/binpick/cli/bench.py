"""`binpick bench`: accuracy and speed on the frozen exam, beside textbook methods on the same frames."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from binpick.cli.pick import write

if TYPE_CHECKING:
    from binpick.lab.depths import Sheet


class Parts(TyperGroup):
    """The parts of the bench; without a part's name the whole exam is meant."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Puts `exam` before options of its own."""
        named = args[:1] in (["--help"], *([name] for name in self.commands))
        return super().parse_args(ctx, args if named else ["exam", *args])


bench = typer.Typer(name="bench", cls=Parts,
                    help="Measure accuracy and speed; without a part's name, as in `binpick bench --scenes 3`: exam.")


@bench.command()
def exam(
    world: Annotated[str, typer.Option(help="Exam world: A (6 mm lens, 600x400 mm bin) or B (12 mm lens, 300x200 mm).")] = "A",
    scenes: Annotated[int, typer.Option(help="How many of the ten report seeds, 101 to 110.", min=1, max=10)] = 10,
    cycles: Annotated[int, typer.Option(help="Timed cycles per scene.", min=1, max=100)] = 2,
    textbook: Annotated[bool, typer.Option(help="Also run the textbook pipeline (6 s a cycle).")] = True,
    tuning: Annotated[bool, typer.Option("--tuning", help="Sit seeds 1 to 10, on which settings are fitted.")] = False,
    modbus: Annotated[str, typer.Option(metavar="HOST:PORT", help="Time a daemon's Modbus reads instead (20 s).")] = "",
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
) -> None:
    """Sit the exam, mixed parts and suction: depth, first grasps and times against the simulator's ground truth."""
    import json

    if modbus:
        typer.echo(json.dumps(_latency(modbus), indent=1))
        return
    from rich.console import Console
    from rich.progress import track

    from binpick.lab import grasps, report
    from binpick.sim import exam as frozen

    seeds = (frozen.TUNING_SEEDS if tuning else frozen.REPORT_SEEDS)[:scenes]
    sitting = grasps.sit(world, seeds, cycles, textbook)
    done = list(track(sitting, "Sitting the exam", total=len(seeds), console=Console(stderr=True), transient=True))
    run = report.figures(world, done)
    if as_json:
        typer.echo(json.dumps(run, indent=1))
    else:
        Console(width=150).print(report.table(run))


@bench.command()
def grasp(
    world: Annotated[str, typer.Option(help="Exam world: A (6 mm lens, 600x400 mm bin) or B (12 mm lens, 300x200 mm).")] = "A",
    scenes: Annotated[int, typer.Option(help="How many seeds from 101, or with --tuning from 1.", min=1, max=10)] = 10,
    parts: Annotated[int, typer.Option(help="Parts per bin.", min=1, max=100)] = 25,
    clear: Annotated[int, typer.Option(help="Of so many of these seeds, bins are also emptied.", min=0, max=10)] = 0,
    gate: Annotated[bool, typer.Option("--gate", help="World A, 25 and 60 parts; 3 seeds emptied (1 h).")] = False,
    full: Annotated[bool, typer.Option("--full", help="Both worlds, 20 to 60 parts, projector on and off.")] = False,
    tuning: Annotated[bool, typer.Option("--tuning", help="Sit seeds 1 to 10, on which settings are fitted.")] = False,
    folder: Annotated[Path | None, typer.Option(metavar="DIR", help="Keeps finished sheets and pictures: a run goes on where "
                                                "it ended. Else the user's cache.")] = None,
    picture: Annotated[Path | None, typer.Option("--film", metavar="FILE", help="Instead empty the first seed's mixed bin by "
                                                 "both tools, as an animated .webp.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
) -> None:
    """First cycles over kinds of parts, per tool, and bins emptied: grasps, segments, sigma, stages against the truth."""
    import json

    from rich.console import Console
    from rich.progress import Progress, track

    from binpick.errors import InputError
    from binpick.lab import archive, film, harvest, programme, tally
    from binpick.sim import exam as frozen

    if gate and full:
        raise InputError("--gate is a part of what --full does: give one of them")
    keep = archive.Archive(folder or archive.default())
    chosen = programme.GATE if gate else programme.FULL if full else (programme.Bins(world, parts, scenes, clear),)
    seeds = frozen.TUNING_SEEDS if tuning else frozen.REPORT_SEEDS
    if picture is not None:
        frames = track(film.shoot(world, seeds[0], parts, keep), "Filming", total=parts + 1, console=Console(stderr=True),
                       transient=True)
        film.save(frames, picture)
        return
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("Picking", total=sum(bins.sheets for bins in chosen))
        run = programme.run(chosen, seeds, keep, lambda: progress.advance(task))
    if as_json:
        typer.echo(json.dumps(run, indent=1))
        return
    for series in run["series"]:
        Console(width=150).print(tally.tables(series), harvest.table(series["clearing"]))


@bench.command()
def stereo(
    world: Annotated[str, typer.Option(help="A (mixed, metal, projector off), B (mixed), or all.")] = "all",
    scenes: Annotated[int, typer.Option(help="How many of the seeds from 101, or with --tuning from 1.", min=1, max=10)] = 5,
    tuning: Annotated[bool, typer.Option("--tuning", help="Sit seeds 1 to 10, on which settings are fitted.")] = False,
    repeats: Annotated[int, typer.Option(help="Timed runs per scene of ours and of plain SGBM.", min=1, max=100)] = 5,
    middlebury: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder with Middlebury's 2014 scenes.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for a picture per scene.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
) -> None:
    """Depth alone: ours beside plain SGBM, SGBM + WLS, block matching and the classics, on the same frames."""
    import json

    from rich.console import Console
    from rich.progress import Progress

    from binpick.errors import InputError
    from binpick.lab import plates, sitting, tables
    from binpick.lab.depths import SERIES
    from binpick.sim import exam as frozen

    chosen = [series for series in SERIES if world in (series.world, "all")]
    if not chosen:
        raise InputError(f"--world {world}: there are A, B and all")
    seeds = (frozen.TUNING_SEEDS if tuning else frozen.REPORT_SEEDS)[:scenes]
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("Measuring depth", total=len(chosen) * len(seeds))

        def marked(sheet: "Sheet") -> None:
            if out:
                write(out, plates.png(sheet))
            progress.advance(task)

        run = sitting.run(chosen, seeds, repeats, middlebury, marked)
    if as_json:
        typer.echo(json.dumps(run, indent=1))
    else:
        Console(width=150).print(tables.tables(run))


def _latency(address: str, seconds: float = 20.0) -> dict[str, int | float]:
    """Reads of 125 registers, one after the other. Raises InputError, NotReady."""
    from binpick.errors import InputError, NotReady
    from binpick.lab.modbus import measure

    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal():
        raise InputError(f"--modbus {address}: give HOST:PORT, as in 127.0.0.1:5020")
    try:
        return measure(host, int(port), seconds)
    except OSError as error:
        raise NotReady(f"no Modbus server answers at {address}: {error.strerror or error}") from error


@bench.command()
def pose(
    world: Annotated[str, typer.Option(help="Exam world: A (6 mm lens, 600x400 mm bin) or B (12 mm lens, 300x200 mm).")] = "A",
    scenes: Annotated[int, typer.Option(help="How many seeds from 101, or with --tuning from 1.", min=1, max=10)] = 10,
    parts: Annotated[int, typer.Option(help="Parts per bin.", min=1, max=100)] = 25,
    tuning: Annotated[bool, typer.Option("--tuning", help="Sit seeds 1 to 10, on which settings are fitted.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Poses by the parts' meshes: how far they are off, and how many parts have one, against the simulator's ground truth."""
    import json

    from rich.console import Console
    from rich.progress import track

    from binpick.lab import poses
    from binpick.sim import exam as frozen

    seeds = (frozen.TUNING_SEEDS if tuning else frozen.REPORT_SEEDS)[:scenes]
    total = (len(poses.BINS) + len(frozen.MIXTURES["mixed"]) - 1) * len(seeds)
    console = Console(stderr=True)
    sheets = list(track(poses.sit(world, seeds, parts), "Posing", total=total, console=console, transient=True))
    run = poses.figures(world, parts, sheets)
    if as_json:
        typer.echo(json.dumps(run, indent=1))
    else:
        Console(width=190).print(poses.table(run))


@bench.command()
def cameras(
    pairs: Annotated[int, typer.Option(help="Pairs in each series.", min=5, max=10000)] = 500,
    only: Annotated[str, typer.Option(help="Series whose name holds this, such as line, PTP, apart or lost.")] = "",
    reconnects: Annotated[int, typer.Option(help="Instead so many outages of a camera: found when, and good again when.", min=0,
                                            max=10000)] = 0,
    soak: Annotated[float, typer.Option(metavar="SECONDS", help="Instead ten pairs a second for so long, each picture with its "
                                        "number.", min=0)] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """The pair on simulated GigE Vision cameras: reported against true skew, time to both images, lost packets."""
    import json

    from rich.console import Console
    from rich.progress import track

    from binpick.errors import InputError
    from binpick.lab import cameras as lab

    if reconnects and soak:
        raise InputError("--reconnects and --soak are two runs: give one of them")
    if reconnects or soak:
        _endure(reconnects, soak, as_json)
        return

    chosen = [trial for trial in lab.programme(pairs) if only in trial.name]
    if not chosen:
        raise InputError(f"--only {only}: there are {', '.join(trial.name for trial in lab.programme(pairs))}")
    console = Console(stderr=True)
    rows = list(track(lab.run(chosen), "Taking pairs", total=len(chosen), console=console, transient=True))
    if as_json:
        typer.echo(json.dumps(rows, indent=1))
    else:
        Console(width=190).print(lab.table(rows))


def _endure(reconnects: int, soak: float, as_json: bool) -> None:
    """Outages, or a long run."""
    import json

    from rich.console import Console
    from rich.progress import Progress

    from binpick.lab import recovery
    from binpick.lab import soak as lab

    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("Enduring", total=1.0)

        def tick(share: float) -> None:
            progress.update(task, completed=share)

        run = recovery.run(reconnects, tick) if reconnects else lab.run(soak, tick=tick)
    if as_json:
        typer.echo(json.dumps(run, indent=1))
    else:
        Console(width=150).print(recovery.table(run) if reconnects else lab.table(run))


@bench.command()
def drift(
    world: Annotated[str, typer.Option(help="A (6 mm lens, 600x400 mm bin), B (12 mm lens, 300x200 mm), or all.")] = "all",
    only: Annotated[str, typer.Option(help="Trials whose name holds this: pitch, roll, yaw or mount.")] = "",
    calm: Annotated[int, typer.Option(help="Cycles of a rig that has not drifted, over five bins; 0: none.", min=0,
                                      max=10000)] = 500,
    plain: Annotated[bool, typer.Option("--plain", help="Without the projected pattern.")] = False,
    tuning: Annotated[bool, typer.Option("--tuning", help="Bins of seeds 1 to 5, on which settings are fitted.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
) -> None:
    """Rigs that have drifted by known turns and shifts: whether and when it is noticed, how well it is told and corrected."""
    import json

    from rich.console import Console
    from rich.progress import Progress

    from binpick.errors import InputError
    from binpick.lab import drift as lab
    from binpick.sim import exam as frozen

    worlds = [name for name in frozen.SETUPS if world in (name, "all")]
    if not worlds:
        raise InputError(f"--world {world}: there are A, B and all")
    chosen = {name: [trial for trial in lab.trials(name) if only in trial.name] for name in worlds}
    if only and not any(chosen.values()):
        raise InputError(f"--only {only}: there are {', '.join(trial.name for trial in lab.trials(worlds[0]))}")
    seeds = (frozen.TUNING_SEEDS if tuning else frozen.REPORT_SEEDS)[:5]
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("Drifting", total=len(worlds) * calm + lab.CALM * sum(map(len, chosen.values())))
        run = lab.sit_all(chosen, seeds, lab.light(not plain), calm, lambda: progress.advance(task))
    if as_json:
        typer.echo(json.dumps(run, indent=1))
    else:
        Console(width=170).print(*lab.tables(run))
