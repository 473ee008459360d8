"""The command line `binpick-calib`: every fault is one line on stderr and an exit code."""

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import track
from rich.table import Table

from binpick import rig as rigs
from binpick.errors import BinpickError, InputError
from binpick_calib import board as boards
from binpick_calib import sheet as sheets
from binpick_calib import vector
from binpick_calib import views as viewing
from binpick_calib.board import Board
from binpick_calib.solve import Solution
from binpick_calib.solve import solve as solve_views

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)


@app.callback()
def tool() -> None:
    """Make the rig file that binpick runs on."""


@app.command()
def solve(
    left: Annotated[str, typer.Option(metavar="GLOB", help="Images of the left camera, quoted: 'shots/left*.png'.")],
    right: Annotated[str, typer.Option(metavar="GLOB", help="Images of the right camera.")],
    board: Annotated[str, typer.Option(metavar="SPEC", help="Inner corners and side of a square in metres: "
                                                            "chessboard:9x6:0.025.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The rig file to write.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Calibrate both cameras from images of a chessboard.

    Partners are matched by the number in their names. Ten or more views, tilted every way and
    filling the image corners, make a good rig; the row error should stay below 0.2 px.
    """
    spec = boards.parse(board)
    if not out.parent.is_dir():
        raise InputError(f"--out {out}: there is no folder {out.parent}")
    pairs, alone = viewing.match(left, right)
    screen = Console(stderr=True)
    watched = track(pairs, description="Finding the board", console=screen, transient=True, disable=not screen.is_terminal)
    views = viewing.detect(watched, spec)
    solution = solve_views(views, spec, datetime.now(UTC).isoformat(timespec="seconds"))
    try:
        out.write_bytes(rigs.dump(solution.rig))
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written: {error.strerror}") from error
    unused = alone | views.rejected
    if as_json:
        typer.echo(json.dumps(figures(solution, spec) | {"unused": unused, "out": str(out)}))
    else:
        show(Console(), solution, spec, unused)
        typer.echo(f"Written: {out}")


@app.command("board")
def print_board(
    board: Annotated[str, typer.Option(metavar="SPEC", help="The board, as solve is told it: chessboard:9x6:0.025, "
                                                            "charuco:9x6:0.025, circles:9x7:0.02, acircles:4x11:0.02.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The file to write: .pdf or .svg.")],
    page: Annotated[str, typer.Option(metavar="SIZE", help=f"{', '.join(sheets.PAGES_MM)}, or width and height in mm: "
                                                           "600x400.")] = "a4",
) -> None:
    """Write a board to print at true scale, with a ruler of 100 mm to check the print by."""
    if out.suffix.lower() not in (".pdf", ".svg"):
        raise InputError(f"--out {out}: write a .pdf or an .svg file")
    sheet = sheets.layout(boards.parse(board), page)
    try:
        out.write_bytes(vector.pdf(sheet) if out.suffix.lower() == ".pdf" else vector.svg(sheet))
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written: {error.strerror}") from error
    typer.echo(f"Written: {out} ({sheet.width:g} x {sheet.height:g} mm; print at 100 %, then check the ruler)")


def figures(solution: Solution, board: Board) -> dict[str, Any]:
    """What a calibration is judged by."""
    left, right = solution.rig.cameras
    baseline_m = float(np.linalg.norm(right.T_camera_rig[:3, 3]))
    return {
        "views": len(solution.per_view_px),
        "rms_px": solution.quality.rms_px,
        "row_error_px": solution.quality.row_error_px,
        "focal_px": {"left": [left.K[0][0], left.K[1][1]], "right": [right.K[0][0], right.K[1][1]]},
        "baseline_m": baseline_m,
        "baseline_squares": baseline_m / board.square_m,
        "per_view_px": {str(number): list(both) for number, both in solution.per_view_px.items()},
    }


def show(console: Console, solution: Solution, board: Board, unused: dict[str, str]) -> None:
    """The figures for people: each view's residual, the whole, and what was not used."""
    views = Table("view", "left px", "right px", title="Residual of each view (rms)")
    for number, (left_px, right_px) in solution.per_view_px.items():
        views.add_row(str(number), f"{left_px:.3f}", f"{right_px:.3f}")
    told = figures(solution, board)
    whole = Table(show_header=False, title="Rig")
    whole.add_row("views used", str(told["views"]))
    whole.add_row("stereo rms", f"{told['rms_px']:.3f} px")
    whole.add_row("row error after rectification (median)", f"{told['row_error_px']:.3f} px")
    for side, (fx, fy) in told["focal_px"].items():
        whole.add_row(f"focal length {side}", f"{fx:.2f}, {fy:.2f} px")
    whole.add_row("baseline", f"{told['baseline_m']:.5f} m = {told['baseline_squares']:.3f} squares")
    console.print(views, whole)
    for name, reason in unused.items():
        console.print(f"not used: {name}: {reason}", highlight=False, markup=False, soft_wrap=True)


def main() -> None:
    """The console script `binpick-calib`."""
    try:
        app()
    except BinpickError as error:
        typer.echo(f"binpick-calib: {' '.join(str(error).split())}", err=True)
        raise SystemExit(error.exit_code) from None
