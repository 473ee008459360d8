"""A film of a bin being emptied: one overlay a cycle, as an animated picture for people."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from binpick import artefacts
from binpick.cycle import CycleInput, CycleResult
from binpick.errors import InputError
from binpick.lab import clearing
from binpick.lab.archive import NOWHERE, Archive
from binpick.lab.clearing import TASKS
from binpick.sim.world import World

WIDTH_PX = 640
FRAME_MS, LAST_MS = 700, 3000
SUFFIX = ".webp"
QUALITY = 70
"""Dots and grain are most of the bytes, and nobody looks at them."""
Picture = UInt8[np.ndarray, "h w 3"]


def shoot(world: str, seed: int, parts: int, keep: Archive = NOWHERE) -> Iterator[Picture]:
    """A bin of mixed parts, emptied by both tools: a frame a cycle. Raises InputError for an unknown world."""
    task = TASKS[-1]
    for step in clearing.steps(task, World(world, task.kinds, parts, seed), parts, keep):
        yield frame(step.paper.inputs, step.outcome)


def frame(inputs: CycleInput, cycle: CycleResult) -> Picture:
    """A cycle's overlay, small."""
    png = np.frombuffer(artefacts.render(inputs, cycle, "overlay.png")[1], np.uint8)
    large = np.asarray(cv2.imdecode(png, cv2.IMREAD_COLOR), np.uint8)
    height = round(large.shape[0] * WIDTH_PX / large.shape[1])
    return np.asarray(cv2.resize(large, (WIDTH_PX, height), interpolation=cv2.INTER_AREA), np.uint8)


def save(frames: Iterable[Picture], path: Path) -> None:
    """Writes the film; it starts again at its end. Raises InputError for a file that cannot move or has no folder."""
    if path.suffix != SUFFIX:
        raise InputError(f"{path}: a film is a {SUFFIX} file")
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}: create it, or name another one")
    film = cv2.Animation()
    film.frames = list(frames)
    film.durations = [FRAME_MS] * (len(film.frames) - 1) + [LAST_MS]
    if not cv2.imwriteanimation(str(path), film, [cv2.IMWRITE_WEBP_QUALITY, QUALITY]):
        raise InputError(f"{path}: the film could not be written")
