"""Plates: a picture per scene of what was seen, what plain SGBM and ours made of it, and how far off each is."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from binpick.lab import methods
from binpick.lab.depths import Sheet
from binpick.lab.stereo import score

Picture = UInt8[np.ndarray, "h w 3"]
TILE_WIDTH, CAPTION_HEIGHT, BORDER_PX = 620, 30, 24
OURS = "quality"
ERROR_PX, SIGMA_PX = 1.0, 0.5
"""Full colour is reached here."""
COOL, NEUTRAL, WARM, NOTHING = (200, 90, 30), (245, 245, 245), (40, 40, 200), (35, 35, 35)
"""BGR: too far away, right, too near; not measured."""


def png(sheet: Sheet) -> dict[str, bytes]:
    """A scene's plate as a file: its name and content."""
    return {f"{sheet.series.name}_{sheet.marked.seed}.png": cv2.imencode(".png", plate(sheet))[1].tobytes()}


def plate(sheet: Sheet) -> Picture:
    """Two rows, plain SGBM and ours, around the parts: image or truth, disparity, signed error, and what is measured."""
    around = _around(sheet.truth.part_id > 0)
    truth = sheet.truth.disparity[around]
    low, high = (float(v) for v in np.nanpercentile(truth, (0.5, 99.5)))
    name = f"{sheet.series.name} seed {sheet.marked.seed}"
    image = cv2.cvtColor(sheet.rectified.left[:, sheet.rectified.margin :][around], cv2.COLOR_GRAY2BGR)
    plain, ours = (sheet.maps[method][around] for method in (methods.PLAIN, OURS))
    measured = np.where(np.isfinite(plain)[..., None], np.uint8(235), np.uint8(35)).repeat(3, axis=-1)
    sigma = _scale(sheet.depths[OURS].sigma_px[around], 0.0, SIGMA_PX, cv2.COLORMAP_VIRIDIS)
    rows = (
        ((image, f"{name}: left image"), (_scale(plain, low, high), f"plain SGBM: disparity {low:.0f} to {high:.0f} px"),
         (_signed(plain - truth), _verdict(sheet, methods.PLAIN)), (measured, "plain SGBM: measured")),
        ((_scale(truth, low, high), "true disparity"), (_scale(ours, low, high), f"{OURS}: disparity"),
         (_signed(ours - truth), _verdict(sheet, OURS)), (sigma, f"{OURS}: sigma 0 to {SIGMA_PX:g} px")),
    )
    return np.vstack([np.hstack([_tile(picture, caption) for picture, caption in row]) for row in rows])


def _around(parts: Bool[np.ndarray, "h w"]) -> tuple[slice, slice]:
    """The box around the parts, or everything when there are none."""
    if not parts.any():
        return slice(None), slice(None)
    rows, columns = (np.flatnonzero(parts.any(axis=axis)) for axis in (1, 0))
    return (slice(max(0, int(rows[0]) - BORDER_PX), int(rows[-1]) + BORDER_PX),
            slice(max(0, int(columns[0]) - BORDER_PX), int(columns[-1]) + BORDER_PX))


def _verdict(sheet: Sheet, method: str) -> str:
    figures = score(sheet.maps[method], sheet.truth.disparity, sheet.truth.part_id > 0, sheet.truth.visible_both)
    return (f"error +-{ERROR_PX:g} px (red: too near); parts: density {figures.density:.2f} bad-1 {figures.bad1:.1%} "
            f"median {figures.median_px:.3f}")


def _scale(values: Float32[np.ndarray, "h w"], low: float, high: float, colours: int = cv2.COLORMAP_TURBO) -> Picture:
    grey = np.clip(np.nan_to_num((values - low) * (255 / (high - low))), 0, 255).astype(np.uint8)
    return _gaps(np.asarray(cv2.applyColorMap(grey, colours), dtype=np.uint8), np.isnan(values))


def _signed(error: Float32[np.ndarray, "h w"]) -> Picture:
    """Blue over white to red: too far, right, too near."""
    at = np.clip(np.nan_to_num(error), -ERROR_PX, ERROR_PX)
    channels = [np.interp(at, (-ERROR_PX, 0, ERROR_PX), stops) for stops in zip(COOL, NEUTRAL, WARM, strict=True)]
    return _gaps(np.stack(channels, axis=-1).astype(np.uint8), np.isnan(error))


def _gaps(picture: Picture, gaps: Bool[np.ndarray, "h w"]) -> Picture:
    picture[gaps] = NOTHING
    return picture


def _tile(picture: Picture, caption: str) -> UInt8[np.ndarray, "h2 w2 3"]:
    height = round(picture.shape[0] * TILE_WIDTH / picture.shape[1])
    tile = cv2.resize(picture, (TILE_WIDTH, height), interpolation=cv2.INTER_AREA)
    strip = np.full((CAPTION_HEIGHT, TILE_WIDTH, 3), 255, dtype=np.uint8)
    cv2.putText(strip, caption, (6, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    return np.vstack([strip, tile])
