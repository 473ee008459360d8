"""Maps: what happened where in a camera's image, as SVG: residuals as arrows over warm parts, and views in each part."""

import numpy as np

from binpick.rigcheck.coverage import Coverage
from binpick_calib.advice import CELLS, FEWEST
from binpick_calib.residuals import Misses

ARROW = 0.04
"""Length of an arrow as long as the rms, of the image's width."""
HOT = 2.0
"""A part is drawn hottest at so many times the rms of the whole."""


def residuals(own: Misses, image_size_px: tuple[int, int]) -> str:
    """Each corner's residual, enlarged; a part's shade is its rms, its thick arrow its mean (only chance when short)."""
    width, height = image_size_px
    scale = ARROW * width / max(own.rms_px, 1e-9)
    parts, arrows = _parts(own, image_size_px, scale)
    lines = "".join(f"M{x:.1f} {y:.1f}l{scale * dx:.1f} {scale * dy:.1f}"
                    for (x, y), (dx, dy) in zip(own.px.tolist(), own.off_px.tolist(), strict=True))
    dots = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in own.px.tolist())
    stroke = width / 640
    key = ARROW * width
    return (f'<svg class="map" viewBox="0 0 {width} {height}" role="img">{parts}'
            f'<path class="arrow" stroke-width="{stroke:.2f}" d="{lines}"/>'
            f'<path class="foot" stroke-width="{3 * stroke:.2f}" d="{dots}"/>'
            f'<path class="mean" stroke-width="{3 * stroke:.2f}" d="{arrows}"/>'
            f'<path class="mean" stroke-width="{3 * stroke:.2f}" d="M{0.02 * width:.1f} {0.97 * height:.1f}h{key:.1f}"/>'
            f'<text x="{0.03 * width + key:.1f}" y="{0.98 * height:.1f}" font-size="{0.028 * width:.1f}">'
            f"{own.rms_px:.3f} px</text>"
            "</svg>")


def _parts(own: Misses, image_size_px: tuple[int, int], scale: float) -> tuple[str, str]:
    wide, high = image_size_px[0] / CELLS[0], image_size_px[1] / CELLS[1]
    column, row = np.clip(own.px / (wide, high), 0, np.array(CELLS) - 1).astype(int).T
    shades, arrows = "", ""
    for c in range(CELLS[0]):
        for r in range(CELLS[1]):
            off = own.off_px[(column == c) & (row == r)]
            if len(off) < FEWEST:
                continue
            heat = np.sqrt((off**2).sum(axis=1).mean()) / (HOT * max(own.rms_px, 1e-9))
            shades += (f'<rect class="heat" x="{c * wide:.1f}" y="{r * high:.1f}" width="{wide:.1f}" height="{high:.1f}" '
                       f'fill-opacity="{min(float(heat), 1.0) ** 2:.2f}"/>')
            dx, dy = scale * off.mean(axis=0)
            arrows += f"M{(c + 0.5) * wide:.1f} {(r + 0.5) * high:.1f}l{dx:.1f} {dy:.1f}"
    return shades, arrows


def coverage(covered: Coverage, camera: int, image_size_px: tuple[int, int]) -> str:
    """How many views show the board in each part of one camera's image; parts that no other camera sees stay out."""
    counts, shared = covered.cells(camera), covered.shared(camera)
    rows, columns = counts.shape
    width, height = image_size_px
    wide, high = width / columns, height / rows
    most = max(int(counts.max()), 1)
    cells = ""
    for r in range(rows):
        for c in range(columns):
            seen, alone = int(counts[r, c]), not shared[r, c]
            cells += (f'<rect class="{"alone" if alone else "cover"}" x="{c * wide:.1f}" y="{r * high:.1f}" width="{wide:.1f}" '
                      f'height="{high:.1f}" fill-opacity="{0.15 + 0.85 * seen / most if seen else 0:.2f}"/>'
                      f'<text class="count" x="{(c + 0.5) * wide:.1f}" y="{(r + 0.56) * high:.1f}" '
                      f'font-size="{0.05 * width:.1f}">{"" if alone and not seen else seen}</text>')
    return f'<svg class="map" viewBox="0 0 {width} {height}" role="img">{cells}</svg>'
