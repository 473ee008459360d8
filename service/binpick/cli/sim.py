"""`binpick sim`: the simulated cameras alone, for a daemon, or any GigE Vision client, of your own; and what befalls them."""

import json
from pathlib import Path
from typing import Annotated

import typer


def sim(
    out: Annotated[Path | None, typer.Option(help="Run cameras; folder for the cell.yaml and rig.json that fit them.")] = None,
    world: Annotated[str, typer.Option(help="Exam world A or B.")] = "A",
    seed: Annotated[int, typer.Option(help="How the parts fall.", min=0)] = 4,
    heads: Annotated[int, typer.Option(help="How many cameras.", min=2, max=5)] = 2,
    numbered: Annotated[bool, typer.Option("--numbered", help="No bin: pictures that carry camera and number.")] = False,
    fault: Annotated[list[str] | None, typer.Option(
        metavar="NAME[=VALUE][@CAMERA]", help="What befalls a camera (left, right, third ...) or all; more than once. "
        "`--fault help` lists them.")] = None,
    at: Annotated[str, typer.Option(help="Address of the first camera; the others follow.")] = "127.0.0.2",
) -> None:
    """Run GigE Vision cameras on 127.0.0.2 and on, looking into a bin of settled parts, until Ctrl-C.

    Then, in another terminal: binpick run --cell OUT/cell.yaml

    Without --out: tell the simulator (or demo) that runs already what befalls its cameras, such as
    binpick sim --fault loss=0.05@left, and print how they are.
    """
    from binpick.sim.gige import door, faults

    wanted = fault or []
    if "help" in wanted:
        typer.echo(faults.manual())
        return
    if out is not None:
        _run(out, world, seed, _addresses(at, heads), numbered, wanted)
        return
    for text in wanted or [""]:
        states = door.ask(at, text)
    for state in states:
        typer.echo(json.dumps(state))


def _run(out: Path, world: str, seed: int, addresses: list[str], numbered: bool, wanted: list[str]) -> None:
    import threading

    from binpick import demo
    from binpick.errors import InputError
    from binpick.sim.gige import Door, GigeGroup, faults
    from binpick.sim.gige.group import ImageFn
    from binpick.sim.gige.numbered import Numbered
    from binpick.sim.twin import Twin

    parsed = [faults.parse(text, len(addresses)) for text in wanted]
    plan = demo.Plan(world=world, seed=seed, cameras=(addresses[0], addresses[1]))
    try:
        out.mkdir(parents=True, exist_ok=True)
        demo.files(plan, out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror}") from error
    eyes: list[ImageFn] = [Numbered(len(addresses))] * len(addresses)
    if not numbered:
        typer.echo("Letting the parts settle ...", err=True)
        eyes[:2] = [Twin(world, demo.KINDS, plan.parts, seed).image] * 2      # the rig that looks into the bin has two
    with GigeGroup(lambda index, light, shot: eyes[index](index, light, shot), addresses) as group, Door(group):
        for known in parsed:
            faults.apply(group, known)
        typer.echo(f"cameras at {', '.join(addresses)}; run: binpick run --cell {out / 'cell.yaml'}")
        try:
            threading.Event().wait()
        except KeyboardInterrupt:
            typer.echo("stopped", err=True)


def _addresses(first: str, count: int) -> list[str]:
    from ipaddress import IPv4Address

    from binpick.errors import InputError

    try:
        return [str(IPv4Address(first) + further) for further in range(count)]
    except ValueError as error:
        raise InputError(f"--at: {error}") from None
