"""`binpick demo`: the whole cell without hardware."""

from typing import Annotated

import typer


def demo(
    cycles: Annotated[int, typer.Option(help="Cycles to run; 0: until the bin is empty.", min=0, max=100000)] = 0,
    headless: Annotated[bool, typer.Option("--headless", help="End with the picking; leave no page up.")] = False,
) -> None:
    """Watch a simulated robot cell empty a bin.

    Starts two GigE Vision cameras on loopback, the daemon, and a PLC that triggers cycles over Modbus; a simulated robot moves
    to the poses it reads, and the printed error is the world's own. The page is at http://127.0.0.1:8080/ui meanwhile.
    """
    try:
        from binpick import demo as cell
    except KeyboardInterrupt:
        # importing takes a second or two, and Ctrl-C is a sound way to end the demo at any time
        raise typer.Exit(0) from None
    raise typer.Exit(cell.run(cell.Plan(cycles=cycles), headless))
