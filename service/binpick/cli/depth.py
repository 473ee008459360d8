"""`binpick depth`: disparity, confidence and a cloud of one stereo pair."""

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from binpick.cli.pick import write

if TYPE_CHECKING:
    from binpick.data import Depth, Image, Rectified


def depth(
    left: Annotated[Path, typer.Option(help="Left image, 8-bit; colour is turned to grey.")],
    right: Annotated[Path, typer.Option(help="Right image.")],
    out: Annotated[Path, typer.Option(help="Folder for the results.")],
    rig: Annotated[Path | None, typer.Option(help="Rig file; the pair is rectified with it and a cloud is written.")] = None,
    near: Annotated[float, typer.Option(help="Nearest depth to search, metres (with --rig).", min=0.05, max=100)] = 0.5,
    far: Annotated[float, typer.Option(help="Farthest depth to search, metres (with --rig).", min=0.06, max=1000)] = 2.0,
    rectified: Annotated[bool, typer.Option("--rectified", help="The images are rectified already.")] = False,
    min_disparity: Annotated[int, typer.Option(help="Smallest disparity, px (with --rectified).", min=0, max=4000)] = 0,
    num_disparities: Annotated[int, typer.Option(help="Disparities to search, px (with --rectified).", min=16,
                                                 max=2048)] = 128,
    preset: Annotated[str, typer.Option(help="Matching preset: quality, or fast at about a third of the time.")] = "quality",
    as_json: Annotated[bool, typer.Option("--json", help="Print timing.json instead of a summary.")] = False,
) -> None:
    """Measure one stereo pair.

    Writes disparity.tiff (float32 px of the rectified left view, NaN = not measured), disparity_filled.tiff (smoothed, for
    people), confidence.png, timing.json, and with a rig cloud.ply.
    """
    from binpick import artefacts
    from binpick.errors import InputError
    from binpick.settings import PRESETS
    from binpick.stereo import cloud, rectify
    from binpick.stereo import depth as stereo

    if rectified == (rig is not None):
        raise InputError("give either --rectified (with --min-disparity and --num-disparities) or --rig rig.json")
    if rig is not None and near >= far:
        raise InputError(f"--near {near:g} must be smaller than --far {far:g}")
    if preset not in PRESETS:
        raise InputError(f"there is no preset {preset!r}; there are {', '.join(PRESETS)}")
    images = _read(left), _read(right)
    began = time.perf_counter()
    pair = (_with_rig(*images, rig, near, far) if rig is not None
            else rectify.whole(*images, min_disparity, num_disparities))
    times = {"rectify": time.perf_counter()}
    measured = stereo.measure(pair, PRESETS[preset])
    times["match"] = time.perf_counter()
    files = _files(measured)
    if rig is not None:
        files["cloud.ply"] = artefacts.ply(cloud.reproject(measured, pair))
    figures = _figures(measured, began, times)
    write(out, files | {"timing.json": (json.dumps(figures, indent=1) + "\n").encode()})
    typer.echo(json.dumps(figures) if as_json else _sentence(figures, out))


def _read(path: Path) -> "Image":
    import cv2

    from binpick.errors import ImageError

    image: Image | None = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.is_file() else None
    if image is None:
        raise ImageError(f"{path}: {'not an image that can be read' if path.is_file() else 'there is no such image'}")
    return image


def _with_rig(left: "Image", right: "Image", rig: Path, near: float, far: float) -> "Rectified":
    """Everything the left camera sees, between two depths."""
    from binpick import rig as rig_file
    from binpick.data import Window
    from binpick.stereo import rectify

    loaded, warnings = rig_file.load(rig)
    for warning in warnings:
        typer.echo(warning, err=True)
    rect = rectify.rectification(loaded)
    scale = rect.focal_px * rect.baseline_m
    low = int(scale / far)
    width, height = loaded.image_size_px
    everything = Window(-width, -height, 3 * width, 3 * height, low, 16 * (int(scale / near - low) // 16 + 1))
    return rectify.rectify(left, right, loaded, rectify.visible(rect, loaded, everything))


def _files(measured: "Depth") -> dict[str, bytes]:
    import cv2

    return {name: cv2.imencode(Path(name).suffix, picture)[1].tobytes() for name, picture in (
        ("disparity.tiff", measured.disparity), ("disparity_filled.tiff", measured.filled),
        ("confidence.png", measured.confidence))}


def _figures(measured: "Depth", began: float, times: dict[str, float]) -> dict[str, float]:
    import numpy as np

    known = measured.disparity[measured.measured]
    low, high = (float(v) for v in np.percentile(known, (1, 99))) if known.size else (0.0, 0.0)
    stages, last = {}, began
    for name, at in times.items():
        stages[f"{name}_ms"], last = round(1000 * (at - last), 2), at
    return {**stages, "total_ms": round(1000 * (last - began), 2), "density": round(float(measured.measured.mean()), 4),
            "disparity_p1_px": round(low, 2), "disparity_p99_px": round(high, 2)}


def _sentence(figures: dict[str, float], out: Path) -> str:
    return (f"{figures['density']:.1%} of the pixels measured, disparities {figures['disparity_p1_px']:g} to "
            f"{figures['disparity_p99_px']:g} px, {figures['total_ms']:.0f} ms; written to {out}")
