"""A session of taking views, the command `capture`: which images it looks at, and what it says at the end."""

import contextlib
from pathlib import Path

from rich.console import Console

from binpick import settings
from binpick.errors import InputError
from binpick.rigcheck import board as boards
from binpick.rigcheck.coverage import Coverage
from binpick_calib import capture as capturing
from binpick_calib import moments as coming
from binpick_calib.moments import Moments
from binpick_calib.viewfinder import Viewfinder


def run(board: str, out: Path, wanted: int, cell: Path | None, url: str, left: str, right: str) -> None:
    """Captures to a folder and says how to go on. Raises InputError for options that do not go together."""
    spec, console = boards.parse(board), Console(stderr=True)
    moments, where = _source(str(spec), cell, url, left, right)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {out}: cannot be made: {error.strerror}") from error
    if (left or right) and any(Path(glob).expanduser().parent.resolve() == out.resolve() for glob in (left, right)):
        raise InputError(f"--out {out}: give a folder of its own: the images come from there")
    coverage = capturing.resumed(out, spec, Coverage(wanted=wanted))
    console.print(f"Looking at {where}" + (f"; going on after {len(coverage.views)} views" if coverage.views else ""),
                  markup=False, highlight=False, soft_wrap=True)
    with contextlib.closing(moments), Viewfinder(console) as finder:
        coverage = capturing.capture(moments, spec, out, coverage, finder.show)
    for line in closing(coverage, out, str(spec)):
        Console().print(line, markup=False, highlight=False, soft_wrap=True)


def _source(board: str, cell: Path | None, url: str, left: str, right: str) -> tuple[Moments, str]:
    """Cameras obey one program at a time: while a daemon of this cell runs, it is asked for the images."""
    given = [bool(cell), bool(url), bool(left or right)]
    if sum(given) != 1 or bool(left) != bool(right):
        raise InputError("say where the images come from: --cell FILE (the cell's cameras, or the daemon that runs them), "
                         "--url of a daemon, or --left and --right of a folder that fills up")
    if left:
        return coming.of_folder(left, right), f"{left} and {right}"
    if url:
        client = coming.daemon(url)
        if client is None:
            raise InputError(f"--url {url}: no daemon answers there")
        return coming.of_daemon(client, board), f"the cameras of the daemon at {url}"
    assert cell is not None
    known = settings.load(cell)
    rest = known.publish.rest
    address = f"http://{'127.0.0.1' if rest.host == '0.0.0.0' else rest.host}:{rest.port}"
    client = coming.daemon(address)
    if client is not None:
        return coming.of_daemon(client, board), f"the cameras of the daemon at {address}"
    return coming.of_cameras(known), f"the cameras of {cell}"


def closing(coverage: Coverage, out: Path, board: str) -> list[str]:
    """What was taken, what is missing, and the command that comes next."""
    if not coverage.views:
        return [f"No view was taken; {out} is empty."]
    said = [f"{len(coverage.views)} views in {out}" + (": enough." if coverage.enough else ".")]
    if not coverage.enough:
        said.append(f"Still missing: {'; '.join(coverage.missing)}. The same command goes on after these.")
    further = "".join(f" --camera '{out / name}_*.png'" for name in coverage.cameras[2:])
    said.append(f"Next: binpick-calib solve --left '{out / 'left'}_*.png' --right '{out / 'right'}_*.png'{further} "
                f"--board {board} --out rig.json")
    return said
