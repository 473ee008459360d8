"""`binpick sim`: the simulated cameras alone, for a daemon, or any GigE Vision client, of your own."""

from pathlib import Path
from typing import Annotated

import typer


def sim(
    out: Annotated[Path, typer.Option(help="Folder for the cell.yaml and rig.json that fit these cameras.")],
    world: Annotated[str, typer.Option(help="Exam world A or B.")] = "A",
    seed: Annotated[int, typer.Option(help="How the parts fall.", min=0)] = 4,
) -> None:
    """Run two GigE Vision cameras on 127.0.0.2 and 127.0.0.3, looking into a bin of settled parts, until Ctrl-C.

    Then, in another terminal: binpick run --cell OUT/cell.yaml
    """
    import threading

    from binpick import demo
    from binpick.errors import InputError
    from binpick.sim.gige import GigePair
    from binpick.sim.twin import Twin

    plan = demo.Plan(world=world, seed=seed)
    try:
        out.mkdir(parents=True, exist_ok=True)
        demo.files(plan, out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror}") from error
    typer.echo("Letting the parts settle ...", err=True)
    with GigePair(Twin(world, demo.KINDS, plan.parts, seed).image, plan.cameras):
        typer.echo(f"cameras at {plan.cameras[0]} and {plan.cameras[1]}; run: binpick run --cell {out / 'cell.yaml'}")
        try:
            threading.Event().wait()
        except KeyboardInterrupt:
            typer.echo("stopped", err=True)
