"""`binpick run`: the daemon of one cell."""

from pathlib import Path
from typing import Annotated

import typer


def run(cell: Annotated[Path, typer.Option(help="Cell file.")]) -> None:
    """Serve a cell until Ctrl-C or SIGTERM.

    The page, REST and Modbus are up at once and say what the cameras still lack. A second Ctrl-C exits at once.
    """
    from binpick import app, log

    log.configure()
    app.run_file(cell)
