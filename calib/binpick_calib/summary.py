"""The summary of a calibration: its figures for machines, and as tables for people."""

from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from binpick.rigcheck.board import Board
from binpick_calib.solve import Solution


def figures(solution: Solution, board: Board) -> dict[str, Any]:
    """What a calibration is judged by."""
    cameras = solution.rig.cameras
    baseline_m = float(np.linalg.norm(cameras[1].T_camera_rig[:3, 3]))
    return {
        "views": len(solution.per_view_px),
        "rms_px": solution.quality.rms_px,
        "row_error_px": solution.quality.row_error_px,
        "distortion_model": solution.quality.distortion_model,
        "focal_px": {camera.name: [camera.K[0][0], camera.K[1][1]] for camera in cameras},
        "baseline_m": baseline_m,
        "baseline_squares": baseline_m / board.square_m,
        "sigma": solution.quality.sigma,
        "per_view_px": {str(number): [px if np.isfinite(px) else None for px in each]
                        for number, each in solution.per_view_px.items()},
    }


def show(console: Console, solution: Solution, board: Board, unused: dict[str, str]) -> None:
    """The figures for people: each view's residual, the whole, and what was not used."""
    told, sigma = figures(solution, board), solution.quality.sigma or {}
    views = Table("view", *(f"{camera.name} px" for camera in solution.rig.cameras), title="Residual of each view (rms)")
    for number, each in solution.per_view_px.items():
        views.add_row(str(number), *(f"{px:.3f}" if np.isfinite(px) else "-" for px in each))
    whole = Table(show_header=False, title="Rig")
    whole.add_row("views used", str(told["views"]))
    whole.add_row("stereo rms", f"{told['rms_px']:.3f} px")
    whole.add_row("row error after rectification (median)", f"{told['row_error_px']:.3f} px")
    for side, (fx, fy) in told["focal_px"].items():
        whole.add_row(f"focal length {side}", f"{fx:.2f}, {fy:.2f} ± {sigma[f'{side}.fx_px']:.2f} px")
    whole.add_row("distortion", str(told["distortion_model"]))
    whole.add_row("baseline", f"{told['baseline_m']:.5f} ± {sigma['right.distance_m']:.5f} m "
                              f"= {told['baseline_squares']:.3f} squares")
    console.print(views, whole)
    for name, reason in unused.items():
        console.print(f"not used: {name}: {reason}", highlight=False, markup=False, soft_wrap=True)
