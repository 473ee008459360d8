"""The command line: one command per module, listed here; every fault is one line on stderr and an exit code."""

from collections.abc import Callable
from typing import Any

import typer

from binpick.cli.bench import bench
from binpick.cli.cameras import cameras
from binpick.cli.check import check
from binpick.cli.demo import demo
from binpick.cli.depth import depth
from binpick.cli.pick import pick
from binpick.cli.run import run
from binpick.cli.schema import schema
from binpick.cli.sim import sim
from binpick.errors import BinpickError

COMMANDS: tuple[Callable[..., Any] | typer.Typer, ...] = (
    demo,
    run,
    check,
    cameras,
    sim,
    pick,
    depth,
    bench,
    schema,
)
"""In the order of `binpick --help`. Their modules import at their top only what is light."""

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
                  help="Bin-picking perception for two GigE cameras on a CPU.")
for command in COMMANDS:
    if isinstance(command, typer.Typer):
        app.add_typer(command)
    else:
        app.command()(command)


def main() -> None:
    """The console script `binpick`."""
    try:
        app()
    except BinpickError as error:
        typer.echo(f"binpick: {' '.join(str(error).split())}", err=True)
        raise SystemExit(error.exit_code) from None
