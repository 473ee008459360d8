"""The command line `binpick-calib`: every fault is one line on stderr and an exit code."""

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer
from rich.console import Console
from rich.progress import track

from binpick import rig as rigs
from binpick.errors import BinpickError, InputError
from binpick.poses import PoseFormat
from binpick.rigcheck.board import Board, parse
from binpick_calib import loose, residuals, summary, vector
from binpick_calib import sheet as sheets
from binpick_calib import views as viewing
from binpick_calib.report import page
from binpick_calib.solve import solve as solve_views
from binpick_calib.views import Shot

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)


@app.callback()
def tool() -> None:
    """Make the rig file that binpick runs on."""


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
    sheet = sheets.layout(parse(board), page)
    _write(out, vector.pdf(sheet) if out.suffix.lower() == ".pdf" else vector.svg(sheet))
    typer.echo(f"Written: {out} ({sheet.width:g} x {sheet.height:g} mm; print at 100 %, then check the ruler)")


@app.command()
def capture(
    board: Annotated[str, typer.Option(metavar="SPEC", help="The board, as for solve: charuco:9x6:0.025.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the views; one that holds some is gone on with.")],
    cell: Annotated[Path | None, typer.Option(metavar="FILE", help="Cell file: its cameras, or its daemon if it runs.")] = None,
    url: Annotated[str, typer.Option(help="A running daemon: http://127.0.0.1:8080.")] = "",
    left: Annotated[str, typer.Option(metavar="GLOB", help="Left images of a folder that fills up, quoted.")] = "",
    right: Annotated[str, typer.Option(metavar="GLOB", help="Right images of that folder.")] = "",
    views: Annotated[int, typer.Option(min=5, max=200, help="How many views there shall be at least.")] = 12,
) -> None:
    """Take views of a board by itself while you move it, and say what is missing.

    A view is taken as soon as the board stands still, is sharp, and shows something new: a part of
    the images, a tilt, a distance. It ends when the set is enough, or at Ctrl-C; what was taken stays.
    """
    from binpick_calib import session

    session.run(board, out, views, cell, url, left, right)


@app.command()
def solve(
    left: Annotated[str, typer.Option(metavar="GLOB", help="Images of the left camera, quoted: 'shots/left*.png'.")],
    right: Annotated[str, typer.Option(metavar="GLOB", help="Images of the right camera.")],
    board: Annotated[str, typer.Option(metavar="SPEC", help="Inner corners and side of a square in metres: "
                                                            "chessboard:9x6:0.025 (or charuco, circles, acircles).")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The rig file to write.")],
    camera: Annotated[list[str] | None, typer.Option(metavar="GLOB", help="Images of a further camera.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
    report: Annotated[Path | None, typer.Option(metavar="FILE", help="Write a page for people, too: report.html.")] = None,
) -> None:
    """Calibrate two or more cameras from images of a board.

    Partners are matched by the number in their names. Ten or more views, tilted every way and
    filling the image corners, make a good rig; the row error should stay below 0.2 px. Views that
    disagree with the others are left out and named, with the reason; if most disagree, or the rig
    that comes out cannot be, nothing is written.
    """
    spec = parse(board)
    for option, file in (("--out", out), ("--report", report)):
        if file is not None and not file.parent.is_dir():
            raise InputError(f"{option} {file}: there is no folder {file.parent}")
    shots, alone = viewing.match(left, right, *(camera or ()))
    views = _seen(shots, spec)
    solution = solve_views(views, spec, datetime.now(UTC).isoformat(timespec="seconds"))
    _write(out, rigs.dump(solution.rig))
    if report is not None:
        fit = residuals.of(solution.rig, replace(views, rejected=alone | views.rejected), spec)
        page.write(report, page.of(solution.rig, fit, spec, shots))
    unused = alone | solution.quality.rejected
    if as_json:
        typer.echo(json.dumps(summary.figures(solution, spec) | {"unused": unused, "out": str(out)}))
    else:
        summary.show(Console(), solution, spec, unused)
        typer.echo(f"Written: {out}" + (f", {report}" if report else ""))


def _seen(shots: Sequence[Shot], board: Board) -> viewing.Views:
    """The board in every shot; people see how far it is."""
    screen = Console(stderr=True)
    return viewing.detect(track(shots, description="Finding the board", console=screen, transient=True,
                                disable=not screen.is_terminal), board)


@app.command("report")
def write_report(
    rig: Annotated[Path, typer.Option(metavar="FILE", help="The rig file.")],
    left: Annotated[str, typer.Option(metavar="GLOB", help="Images of the left camera that it was made of, quoted.")],
    right: Annotated[str, typer.Option(metavar="GLOB", help="Images of the right camera.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The page to write: report.html.")],
    camera: Annotated[list[str] | None, typer.Option(metavar="GLOB", help="Images of a further camera.")] = None,
    board: Annotated[str | None, typer.Option(metavar="SPEC", help="The board, where the rig file does not name it.")] = None,
) -> None:
    """Write a page that shows what a calibration is worth.

    Residuals by place and by view, coverage, rectified pairs, depth errors to expect, the matrices to
    copy, and what to do better: one HTML file that needs no other and can be printed.
    """
    calibrated, warnings = rigs.load(rig)
    for warning in warnings:
        typer.echo(f"binpick-calib: {warning}", err=True)
    if board is None and calibrated.board is None:
        raise InputError(f"{rig}: it does not say which board it was made of; give --board")
    if len(calibrated.cameras) != 2 + len(camera or ()):
        raise InputError(f"{rig}: it has {len(calibrated.cameras)} cameras; give images of each (--camera for further ones)")
    spec = parse(board or str(calibrated.board))
    shots, alone = viewing.match(left, right, *(camera or ()))
    views = _seen(shots, spec)
    fit = residuals.of(calibrated, replace(views, rejected=alone | views.rejected), spec)
    page.write(out, page.of(calibrated, fit, spec, shots))
    typer.echo(f"Written: {out}")


@app.command(name="import")
def import_loose(
    files: Annotated[list[Path], typer.Argument(metavar="FILES", help="K, distortion, R and T: .npy .npz .yml .xml.")],
    image_size: Annotated[str, typer.Option(metavar="WxH", help="Size of the images they belong to, px: 1936x1216.")],
    unit_m: Annotated[float, typer.Option(min=1e-6, max=10, help="Metres in one unit of T: 0.001 for mm.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The rig file to write.")],
) -> None:
    """Make a rig file of loose OpenCV parameters: camera matrices, distortion, R and T in files of their own.

    They are known by name: M1 M2 D1 D2 R T, cameraMatrixL distL, mtx_left dist_left, K1 D1. What no
    real rig looks like is refused. Nothing tells how good they are: the rig file has no quality.
    """
    size = re.fullmatch(r"(\d{2,5})x(\d{2,5})", image_size.strip().lower())
    if not size:
        raise InputError(f"--image-size {image_size}: write it as 1936x1216")
    rig = loose.rig_of(files, (int(size[1]), int(size[2])), unit_m, datetime.now(UTC).isoformat(timespec="seconds"))
    _write(out, rigs.dump(rig))
    left, right = rig.cameras
    typer.echo(f"focal length {left.K[0][0]:.1f}, {right.K[0][0]:.1f} px; "
               f"baseline {1000 * float(np.linalg.norm(right.T_camera_rig[:3, 3])):.2f} mm")
    typer.echo(f"Written: {out}")


@app.command("handeye")
def hand_eye(
    poses: Annotated[Path, typer.Option(metavar="FILE", help="Robot poses, .csv or .yaml: name,x_mm,y_mm,z_mm and a,b,c "
                                                             "(KUKA), w,p,r (FANUC), rx,ry,rz (UR), qx..qw, q1..q4 (ABB).")],
    left: Annotated[str, typer.Option(metavar="GLOB", help="Images of the left camera, quoted: 'shots/left*.png'.")],
    rig: Annotated[Path, typer.Option(metavar="FILE", help="The rig file of `solve`.")],
    board: Annotated[str, typer.Option(metavar="SPEC", help="The board, as for solve, or a tag: apriltag:36h11:0.08.")],
    mounting: Annotated[Literal["base", "flange"], typer.Option(help="What carries the cameras; the other carries the board.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The rig file to write.")],
    right: Annotated[str, typer.Option(metavar="GLOB", help="Images of the right camera.")] = "",
    pose_format: Annotated[str, typer.Option(metavar="NAME", help=f"The angles, if the table's head does not tell: "
                                                                  f"{', '.join(known.name for known in PoseFormat)}.")] = "",
    unit: Annotated[Literal["", "mm", "m"], typer.Option(metavar="mm|m", help="Of positions, if the head does not tell.")] = "",
    z: Annotated[float | None, typer.Option(metavar="M", help="For robots with four axes: height of the board's first point in "
                                            "the flange (cameras on the base), else in the base.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Find where the cameras stand in the robot's base, or ride on its flange.

    Poses and images belong together by the number in their names; 10 or more, the flange tilted by
    20 to 40 degrees every way. A sample that contradicts the others is left out and named; when
    robot and cameras do not agree, nothing is written.
    """
    from binpick_calib import handeye

    outcome = handeye.run(handeye.Request(poses, left, right, rig, board, mounting, pose_format, unit, z), _now())
    _write(out, rigs.dump(outcome.rig))
    for warning in outcome.warnings:
        typer.echo(warning, err=True)
    if as_json:
        typer.echo(json.dumps(handeye.figures(outcome) | {"out": str(out)}))
    else:
        handeye.show(Console(), outcome)
        typer.echo(f"Written: {out}")


@app.command("bin")
def carrier(
    points: Annotated[Path | None, typer.Option(metavar="FILE", help="Points touched, in the robot's base, .csv: name,x_mm,"
                                                "y_mm,z_mm; three or four named rim (inner corners), one floor.")] = None,
    size: Annotated[str, typer.Option(metavar="LxWxH", help="Inner size, metres: 0.6x0.4x0.18; or give --cell.")] = "",
    unit: Annotated[Literal["", "mm", "m"], typer.Option(metavar="mm|m", help="Of points, if the head does not tell.")] = "",
    locate: Annotated[bool, typer.Option("--locate", help="Instead of points: see the rim in a pair of images.")] = False,
    left: Annotated[Path | None, typer.Option(metavar="FILE", help="The left image.")] = None,
    right: Annotated[Path | None, typer.Option(metavar="FILE", help="The right image.")] = None,
    rig: Annotated[Path | None, typer.Option(metavar="FILE", help="The rig file.")] = None,
    cell: Annotated[Path | None, typer.Option(metavar="FILE", help="The cell file: the bin's size and rough place.")] = None,
    number: Annotated[int, typer.Option("--bin", min=1, max=65535, help="Which bin of the cell file.")] = 1,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Write it there; else it is printed.")] = None,
) -> None:
    """Find where a bin stands, as the `bin:` of a cell file.

    Touched with the robot: the tool's tip in three inner corners of the rim and on the floor. Or
    with --locate by its rim in a pair of images, near where the cell file has it.
    """
    from binpick_calib import bin as bins

    found = bins.run(points, size, unit, (left, right, rig) if locate else None, cell, number)
    if out is None:
        typer.echo(found, nl=False)
    else:
        _write(out, found.encode())
        typer.echo(f"Written: {out}")


@app.command()
def verify(
    rig: Annotated[Path, typer.Option(metavar="FILE", help="The rig file; the trend is kept beside it.")],
    left: Annotated[Path | None, typer.Option(metavar="FILE", help="An image of the left camera.")] = None,
    right: Annotated[Path | None, typer.Option(metavar="FILE", help="The right camera's of the same moment.")] = None,
    url: Annotated[str, typer.Option(help="Instead of images: a running daemon, which takes them.")] = "",
    board: Annotated[str, typer.Option(metavar="SPEC", help="A board in view, as for solve.")] = "",
    sphere: Annotated[float, typer.Option(metavar="M", help="A sphere in view: its radius, metres.")] = 0.0,
    flat: Annotated[bool, typer.Option("--flat", help="A flat in view.")] = False,
    stays: Annotated[bool, typer.Option("--stays", help="The board stands where it stood when first verified so.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the verdict as JSON.")] = False,
) -> None:
    """Say whether a rig file still holds, by one look at a board, a sphere or a flat anywhere in view.

    A board tells most: rows, scale, and with --stays whether the rig was moved. A sphere or a flat needs
    the projected pattern or a texture. Exit code 1: it does not hold.
    """
    from binpick_calib import verification

    gauge, at = verification.Gauge(board, sphere, flat), datetime.now(UTC).isoformat(timespec="seconds")
    told, entries = verification.run(gauge, rig, left, right, url, stays, at)
    if as_json:
        typer.echo(json.dumps(told))
    else:
        verification.show(Console(), told, entries)
    raise typer.Exit(int(told["level"] == "fault"))


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _write(out: Path, content: bytes) -> None:
    try:
        out.write_bytes(content)
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written: {error.strerror}") from error


def main() -> None:
    """The console script `binpick-calib`."""
    try:
        app()
    except BinpickError as error:
        typer.echo(f"binpick-calib: {' '.join(str(error).split())}", err=True)
        raise SystemExit(error.exit_code) from None
