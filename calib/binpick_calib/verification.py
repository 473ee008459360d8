"""A verification, the command `verify`: images or a daemon asked, the verdict told, the trend kept and shown."""

import contextlib
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from binpick import rig as rigs
from binpick.data import Image
from binpick.errors import ImageError, InputError, NotReady
from binpick.geometry import Transform
from binpick.rig import Rig
from binpick.rigcheck import board as boards
from binpick.rigcheck import gauge, rows
from binpick.rigcheck.verdict import Verdict, judged
from binpick.rigcheck.verify import verify
from binpick_calib import capture, moments, relief, trend
from binpick_calib import views as viewing

SHOWN = 8
FIGURES = (("row_px", "row\npx", 1.0, "+.2f"), ("pitch_rad", "pitch\nmrad", 1000.0, "+.2f"),
           ("roll_rad", "roll\nmrad", 1000.0, "+.2f"), ("scale_permille", "scale\n‰", 1.0, "+.1f"),
           ("planarity_m", "shape\nmm", 1000.0, ".2f"), ("bend_m", "bend\nmm", 1000.0, ".2f"),
           ("offset_m", "offset\nmm", 1000.0, ".1f"))
COLOURS = {"ok": "green", "warn": "yellow", "fault": "bold red"}


@dataclass(frozen=True, slots=True)
class Gauge:
    """What is in view: a board (its description), a sphere (radius, m) or a flat."""

    board: str = ""
    sphere_m: float = 0.0
    flat: bool = False

    def __post_init__(self) -> None:
        if sum((bool(self.board), bool(self.sphere_m), self.flat)) != 1:
            raise InputError("say what is in view: --board SPEC, --sphere RADIUS in metres, or --flat")


def run(wanted: Gauge, rig_file: Path, left: Path | None, right: Path | None, url: str, stays: bool,
        at: str) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The verdict, as JSON, and with it all so far of this rig file; it is kept. Raises InputError for bad options."""
    if url and not wanted.board:
        raise InputError("--url: a daemon verifies by a board: give --board")
    rig, _ = rigs.load(rig_file)
    if url:
        told = of_daemon(url, wanted.board)
    elif left is not None and right is not None:
        told = of_images(left, right, rig, wanted, trend.expected(trend.read(rig_file), wanted.board, rig) if stays else None)
    else:
        raise InputError("say where the images come from: --left and --right, or --url")
    told |= {"at": at, "stays": stays, "rig_sha256": rig.sha256}
    trend.add(rig_file, told)
    return told, trend.read(rig_file)


def of_images(left: Path, right: Path, rig: Rig, wanted: Gauge, expected: Transform | None) -> dict[str, Any]:
    """The verdict on a pair of images, as JSON. Raises InputError, ImageError."""
    images = tuple(_read(path, rig) for path in (left, right))
    seen = _board(images, rig, wanted.board, expected) if wanted.board else _solid(images[0], images[1], rig, wanted)
    return seen.document


def _read(path: Path, rig: Rig) -> Image:
    image = viewing.read(path)
    if image is None:
        raise ImageError(f"{path}: not an image that can be read")
    if (image.shape[1], image.shape[0]) != rig.image_size_px:
        raise ImageError(f"{path}: {image.shape[1]}x{image.shape[0]} px, but the rig was calibrated at "
                         f"{rig.image_size_px[0]}x{rig.image_size_px[1]}")
    return image


def _board(images: tuple[Image, ...], rig: Rig, spec: str, expected: Transform | None) -> Verdict:
    board = boards.parse(spec)
    seen, reasons = capture.look(images, board)
    if None in seen:
        blind = [camera.name for camera, found in zip(rig.cameras, seen, strict=False) if found is None]
        raise InputError(f"the board is not seen by: {', '.join(blind)} ({'; '.join(reasons)})")
    return verify(seen, rig, expected)


def _solid(left: Image, right: Image, rig: Rig, wanted: Gauge) -> Verdict:
    """A sphere or a flat: found in the coarse relief, judged in the fine one about it."""
    radius_m = wanted.sphere_m
    sphere = functools.partial(gauge.sphere, radius_m=radius_m)
    fit: Callable[[relief.Points], gauge.Fit] = gauge.flat if wanted.flat else sphere
    pair, points = relief.gauged(left, right, rig, lambda coarse: fit(coarse).inside)
    turned = rows.check(pair)
    return judged(gauge.of_flat(points, turned) if wanted.flat else gauge.of_sphere(points, radius_m, turned))


def of_daemon(url: str, board: str) -> dict[str, Any]:
    """What a running daemon says of a board in view. Raises InputError when none answers or it refuses."""
    client = moments.daemon(url)
    if client is None:
        raise InputError(f"--url {url}: no daemon answers there")
    boards.parse(board)
    with contextlib.closing(client):
        try:
            verdict = moments.asked(client, "POST", "/v1/calibration/verify", json={"board": board}).json()["verdict"]
        except NotReady as error:
            raise NotReady(f"the daemon at {url}: {error}") from error
    seen = dict(verdict.get("board") or {})
    return seen | {"gauge": board, "level": verdict["level"], "sentence": verdict["sentence"]}


def show(console: Console, told: dict[str, Any], entries: Sequence[dict[str, Any]]) -> None:
    """The verdict, and the last verifications, this one included."""
    console.print(f"[{COLOURS[told['level']]}]{told['level']}[/]: ", end="")
    console.print(told["sentence"], markup=False, highlight=False, soft_wrap=True)
    there = [figure for figure in FIGURES if any(_number(entry, figure[0]) is not None for entry in entries[-SHOWN:])]
    table = Table("when (UTC)", "by", "", title="Trend of this rig file", box=SIMPLE_HEAD,
                  padding=(0, 1, 0, 0))
    for _, name, _, _ in there:
        table.add_column(name, justify="right")
    for entry in entries[-SHOWN:]:
        values, level = (_number(entry, key) for key, *_ in there), entry["level"]
        kind, at = entry.get("gauge", "").split(":")[0], entry.get("at", "")[5:16].replace("T", " ")
        table.add_row(at, kind, f"[{COLOURS[level]}]{level}[/]",
                      *("-" if value is None else format(value * factor, how)
                        for value, (_, _, factor, how) in zip(values, there, strict=True)))
    console.print(table)


def _number(entry: dict[str, Any], key: str) -> float | None:
    value = entry.get(key)
    return float(value) if isinstance(value, int | float) and np.isfinite(value) else None
