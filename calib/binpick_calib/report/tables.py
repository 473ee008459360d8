"""Tables: the figures of a rig as rows for people, and its matrices as text to copy."""

import json
from collections.abc import Sequence
from html import escape

import cv2
import numpy as np

from binpick.geometry import epipolar
from binpick.rig import Rig
from binpick_calib.residuals import Residuals, rectification

TERMS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def matrices(rig: Rig) -> dict[str, np.ndarray]:
    """K and distortion of the first two cameras, their step, E and F (of undistorted pixels), and the rectification.

    R1 R2 P1 P2 Q are OpenCV's (`stereoRectify`, zero disparity at infinity), as the service rectifies.
    """
    left, right = rig.cameras[:2]
    T = right.T_camera_rig
    R1, R2, P1, P2, Q = rectification(rig)
    E = epipolar.essential(T)
    return {f"K {left.name}": left.K_px, f"distortion {left.name}": left.distortion_coefficients,
            f"K {right.name}": right.K_px, f"distortion {right.name}": right.distortion_coefficients,
            "R": T[:3, :3], "T": T[:3, 3], "E": E, "F": epipolar.fundamental(E, left.K_px, right.K_px),
            "R1": R1, "R2": R2, "P1": P1, "P2": P2, "Q": Q}


def copyable(found: dict[str, np.ndarray]) -> str:
    """Each as rows of numbers that JSON and numpy read; a click selects it whole."""
    told = ""
    for name, matrix in found.items():
        rows = ",\n ".join(json.dumps([float(f"{value:.10g}") for value in row]) for row in np.atleast_2d(matrix).tolist())
        told += (f'<figure class="matrix"><figcaption>{escape(name)}</figcaption><pre data-name="{escape(name)}">'
                 f"{rows if matrix.ndim == 1 else f'[{rows}]'}</pre></figure>")
    return f'<div class="matrices">{told}</div>'


def table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    """The first column names, the others hold numbers."""
    top = "".join(f"<th>{escape(word)}</th>" for word in head)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"


def cameras(rig: Rig) -> str:
    """The parameters of each camera with one standard deviation, where the file tells it."""
    sigma = (rig.quality.sigma if rig.quality else None) or {}

    def told(name: str, key: str, value: float, digits: int) -> str:
        doubt = sigma.get(f"{name}.{key}")
        return f"{value:.{digits}f}" + ("" if doubt is None else f" ± {doubt:.{digits}f}")

    rows = []
    for place, key in enumerate(("fx_px", "fy_px", "cx_px", "cy_px")):
        rows.append((key.replace("_", " "), *(told(c.name, key, (c.K[0][0], c.K[1][1], c.K[0][2], c.K[1][2])[place], 2)
                                              for c in rig.cameras)))
    most = max(len(camera.distortion) for camera in rig.cameras)
    for place, term in enumerate(TERMS[:most]):
        values = [camera.distortion[place] if place < len(camera.distortion) else 0.0 for camera in rig.cameras]
        if any(values):
            rows.append((term, *(told(c.name, term, value, 5) for c, value in zip(rig.cameras, values, strict=True))))
    rows.append(("distance mm", "", *(_doubted(1000 * float(np.linalg.norm(c.T_camera_rig[:3, 3])),
                                               1000 * sigma.get(f"{c.name}.distance_m", np.nan)) for c in rig.cameras[1:])))
    turned = [float(np.degrees(np.linalg.norm(cv2.Rodrigues(c.T_camera_rig[:3, :3])[0]))) for c in rig.cameras[1:]]
    rows.append(("turn °", "", *(_doubted(turn, float(np.degrees(sigma.get(f"{c.name}.turn_rad", np.nan))))
                                 for turn, c in zip(turned, rig.cameras[1:], strict=True))))
    return table(("", *(camera.name for camera in rig.cameras)), rows)


def _doubted(value: float, doubt: float) -> str:
    return f"{value:.3f}" + (f" ± {doubt:.3f}" if np.isfinite(doubt) else "")


def epipolar_errors(fit: Residuals) -> str:
    """Of each view: the row difference after rectification and the distance to the epipolar line, both with their sign."""
    rows = []
    for view in np.unique(fit.rows.views):
        own = fit.rows.views == view
        down, away = fit.rows.down_px[own], fit.rows.epipolar_px[own]
        rows.append((str(view), f"{np.median(down):+.3f}", f"{np.median(np.abs(down)):.3f}", f"{np.abs(down).max():.3f}",
                     f"{np.median(np.abs(away)):.3f}", f"{np.abs(away).max():.3f}"))
    down, away = fit.rows.down_px, fit.rows.epipolar_px
    rows.append(("all", f"{np.median(down):+.3f}", f"{np.median(np.abs(down)):.3f}", f"{np.abs(down).max():.3f}",
                 f"{np.median(np.abs(away)):.3f}", f"{np.abs(away).max():.3f}"))
    return table(("view", "rows, median", "rows, median |.|", "rows, worst", "to the line, median |.|", "worst"), rows)
