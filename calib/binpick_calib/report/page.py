"""The page: a calibration as one HTML file without a link: figures, maps, pictures, matrices, and what to do better."""

from collections.abc import Sequence
from html import escape
from importlib import resources
from pathlib import Path

import numpy as np

from binpick.errors import InputError
from binpick.rig import Rig
from binpick.rigcheck.board import Board
from binpick_calib import advice, outlook, residuals
from binpick_calib.outlook import MATCHED_PX, Outlook
from binpick_calib.report import charts, maps, pictures, tables
from binpick_calib.residuals import Residuals
from binpick_calib.views import Shot, read

PAIRS = 3
"""Rectified pairs that are shown: the nearest, the middle and the farthest."""
MOST_PRINTS = 24
"""Rejected views that are shown with their pictures; the others by name."""


def of(rig: Rig, fit: Residuals, board: Board, shots: Sequence[Shot]) -> str:
    """The page; `shots` are the files that the views were found in. The same rig and images give the same bytes."""
    away_m = residuals.distances_m(fit.boards, board)
    near_m, far_m = min(away_m.values()), max(away_m.values())
    ahead = outlook.of(fit.fitted, rig.image_size_px, np.linspace(0.6 * near_m, 1.6 * far_m, 41))
    sections = [
        ("What to do better", "better", _sentences(advice.of(rig, fit, ahead))),
        ("Cameras", "cameras", tables.cameras(rig)),
        ("Depth error to expect", "depth", _depth(ahead, near_m, far_m)),
        ("Residuals by place", "wide", _residual_maps(rig, fit)),
        ("Residuals by view", "views", charts.bars({str(view): each for view, each in fit.per_view_px().items()},
                                                   fit.coverage.cameras, "px")),
        ("Not used", "rejected", _rejected(fit.rejected, shots)),
        ("Coverage", "wide", _coverage(rig, fit, away_m)),
        ("Rectified pairs", "wide", _pairs(rig, shots, away_m)),
        ("Rows and epipolar lines", "wide", tables.epipolar_errors(fit)),
        ("What these images cannot tell, and rows cannot show later", "untold",
         _sentences(advice.untold(fit, board, float(np.median(list(away_m.values())))))),
        ("Matrices", "wide", _matrices(rig))]
    cards = "".join(f'<section class="card {kind}"><h2>{title}</h2>{content}</section>' for title, kind, content in sections)
    style = resources.files(__package__).joinpath("style.css").read_text(encoding="utf-8")
    name = f"Calibration {rig.sha256[:12]}"
    return (f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{name}</title>'
            f'<meta name="viewport" content="width=device-width"><style>{style}</style></head><body>'
            f"{_head(rig, fit, board)}<main>{cards}</main></body></html>\n")


def write(out: Path, content: str) -> None:
    """The file. Raises InputError where it cannot be written."""
    try:
        out.write_text(content, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror}") from error


def _head(rig: Rig, fit: Residuals, board: Board) -> str:
    left, right = rig.cameras[:2]
    baseline_m = float(np.linalg.norm(right.T_camera_rig[:3, 3]))
    sound = fit.rows.error_px <= advice.ROW_PX and fit.rms_px <= advice.RMS_PX and _alike(rig, fit)
    tiles = {"rms_px": ("residual, rms", f"{fit.rms_px:.3f} px"),
             "row_px": ("row error, median", f"{fit.rows.error_px:.3f} px"),
             "baseline_m": ("baseline", f"{1000 * baseline_m:.2f} mm"),
             "focal_px": ("focal length", f"{left.K[0][0]:.1f}, {right.K[0][0]:.1f} px"),
             "views": ("views used", str(len(fit.boards))), "out": ("not used", str(len(fit.rejected)))}
    shown = "".join(f'<div class="tile"><small>{words}</small><b id="{key}">{value}</b></div>'
                    for key, (words, value) in tiles.items())
    model = f", distortion {rig.quality.distortion_model}" if rig.quality and rig.quality.distortion_model else ""
    about = (f"{len(rig.cameras)} cameras of {rig.image_size_px[0]} × {rig.image_size_px[1]} px, board {board}{model}, "
             f"made {rig.created or 'at an unknown time'}, sha256 {rig.sha256}")
    moved = "" if _alike(rig, fit) else ('<p class="moved">These images by themselves give other parameters than the rig file '
                                         "has: it was made of others, or edited.</p>")
    tone, word = ("good", "GOOD") if sound else ("warn", "LOOK AGAIN")
    return (f'<header class="{tone}"><b>{word}</b><p>Calibration</p></header>'
            f'<p class="about">{escape(about)}</p>{moved}<div class="tiles">{shown}</div>')


def _alike(rig: Rig, fit: Residuals) -> bool:
    """Whether fitting again from the rig on stays there, within a tenth of a deviation and the file's own rounding."""
    assert fit.fitted.covariance is not None
    sigma = fit.fitted.covariance.deviations(np.eye(len(fit.fitted.covariance.scatter)))
    return all(abs(own.values[0] - camera.K[0][0]) < 0.1 * sigma[12 * place] + 1e-3
               for place, (own, camera) in enumerate(zip(fit.fitted.lenses, rig.cameras, strict=True)))


def _sentences(told: Sequence[str]) -> str:
    return "<ul>" + "".join(f"<li>{escape(sentence)}</li>" for sentence in told) + "</ul>"


def _residual_maps(rig: Rig, fit: Residuals) -> str:
    drawn = "".join(f"<figure>{maps.residuals(own, rig.image_size_px)}<figcaption>{escape(camera.name)}</figcaption></figure>"
                    for own, camera in zip(fit.misses, rig.cameras, strict=True))
    return (f'<div class="row">{drawn}</div><p class="note">Thin arrows: from where the rig puts a corner to where it was '
            "seen. Thick arrows: their mean in a part of the image; where these are long, the lens or the board bends there in "
            "a way the model does not follow. Redder parts fit worse. The bar shows the scale of the arrows.</p>")


def _coverage(rig: Rig, fit: Residuals, away_m: dict[int, float]) -> str:
    if not fit.coverage.views:
        return '<p class="none">Nothing is known of it.</p>'
    drawn = "".join(f"<figure>{maps.coverage(fit.coverage, place, rig.image_size_px)}"
                    f"<figcaption>{escape(camera.name)}: views that show the board in each part</figcaption></figure>"
                    for place, camera in enumerate(rig.cameras))
    tilts = [float(np.degrees(np.arccos(min(1.0, abs(T[2, 2]))))) for T in fit.boards.values()]
    chart = charts.points([away_m[view] for view in fit.boards], tilts, ("distance m", "tilt °"))
    sides = ", ".join(f"{tilt} {number}" for tilt, number in fit.coverage.tilts.items())
    return (f'<div class="row">{drawn}<figure>{chart}<figcaption>the board in each view</figcaption></figure></div>'
            f'<p class="note">Views whose board had this side nearer: {sides}. The nearest board looks '
            f"{fit.coverage.range:.2f} times as large as the farthest. Dashed parts: no other camera sees them.</p>")


def _depth(ahead: Outlook, near_m: float, far_m: float) -> str:
    rows = []
    for z in (near_m, (near_m + far_m) / 2, far_m, 1.5 * far_m):
        at = [1000 * float(np.interp(z, ahead.distance_m, sigma))
              for sigma in (ahead.matching_m, ahead.middle_m, ahead.worst_m, ahead.total_m)]
        rows.append((f"{z:.3f} m", *(f"{value:.3f}" for value in at)))
    return (charts.depth(ahead, (near_m, far_m))
            + '<p class="keys"><i class="matching"></i>matching <i class="middle"></i>calibration, middle of the image '
              '<i class="worst"></i>calibration, worst place <i class="total"></i>both, middle</p>'
            + tables.table(("one sigma, mm", "matching", "calibration", "worst place", "both"), rows)
            + f'<p class="note">Matching: Z² σ_d / (f b) with σ_d = {MATCHED_PX:g} px (Gallup, Frahm, Mordohai, Pollefeys: '
              "Variable Baseline/Resolution Stereo, CVPR 2008). Calibration: the covariance of all parameters together, of "
              "views rather than corners where that is larger, through the triangulated depth (Hartley, Zisserman: Multiple "
              "View Geometry, 5.2). Shaded: where the board was; beyond it the curves rest on the model alone.</p>")


def _rejected(reasons: dict[str, str], shots: Sequence[Shot]) -> str:
    if not reasons:
        return '<p class="none">Every view was used.</p>'
    files = {path.name: path for shot in shots for path in shot.files if path is not None}
    shown = ""
    for number, (names, reason) in enumerate(reasons.items()):
        prints = "".join(pictures.thumbnail(files[name]) for name in names.split(", ") if name in files)
        shown += (f'<li><div class="prints">{prints if number < MOST_PRINTS else ""}</div><b>{escape(names)}</b> '
                  f"{escape(reason)}</li>")
    return f'<ul class="rejects">{shown}</ul>'


def _pairs(rig: Rig, shots: Sequence[Shot], away_m: dict[int, float]) -> str:
    by_distance = sorted(away_m, key=lambda view: away_m[view])
    chosen = [by_distance[place] for place in np.linspace(0, len(by_distance) - 1, PAIRS).round().astype(int)]
    files = {shot.number: shot.files for shot in shots}
    drawn = ""
    for view in dict.fromkeys(chosen):
        left, right = (None if path is None else read(path) for path in files[view][:2])
        if left is not None and right is not None:
            drawn += (f"<figure>{pictures.rectified(rig, left, right)}<figcaption>view {view}, board at {away_m[view]:.3f} m"
                      "</figcaption></figure>")
    return f'{drawn}<p class="note">After rectification a line meets the same things in both pictures.</p>'


def _matrices(rig: Rig) -> str:
    return ('<p class="note">x_right = R x_left + T, metres; E and F: right<sup>T</sup> F left = 0 for undistorted pixels; '
            "R1 R2 P1 P2 Q: OpenCV's rectification. A click selects one.</p>" + tables.copyable(tables.matrices(rig)))
