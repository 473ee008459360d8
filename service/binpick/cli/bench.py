"""`binpick bench`: accuracy and speed on the frozen exam, beside the textbook pipeline on the same frames."""

from typing import Annotated

import typer


def bench(
    world: Annotated[str, typer.Option(help="Exam world: A (6 mm lens, 600x400 mm bin) or B (12 mm lens, 300x200 mm).")] = "A",
    scenes: Annotated[int, typer.Option(help="How many of the ten report seeds, 101 to 110.", min=1, max=10)] = 10,
    cycles: Annotated[int, typer.Option(help="Timed cycles per scene.", min=1, max=100)] = 2,
    textbook: Annotated[bool, typer.Option(help="Also run the textbook pipeline (6 s a cycle).")] = True,
    tuning: Annotated[bool, typer.Option("--tuning", help="Sit seeds 1 to 10, on which settings are fitted.")] = False,
    modbus: Annotated[str, typer.Option(metavar="HOST:PORT", help="Time a daemon's Modbus reads instead (20 s).")] = "",
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
) -> None:
    """Sit the exam: depth, first grasps and times against the simulator's ground truth."""
    import json

    if modbus:
        typer.echo(json.dumps(_latency(modbus), indent=1))
        return
    from rich.console import Console
    from rich.progress import track

    from binpick.lab import grasps, report
    from binpick.sim import exam

    seeds = (exam.TUNING_SEEDS if tuning else exam.REPORT_SEEDS)[:scenes]
    sitting = grasps.sit(world, seeds, cycles, textbook)
    done = list(track(sitting, "Sitting the exam", total=len(seeds), console=Console(stderr=True), transient=True))
    run = report.figures(world, done)
    if as_json:
        typer.echo(json.dumps(run, indent=1))
    else:
        Console(width=150).print(report.table(run))


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
