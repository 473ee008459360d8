"""A whole run of the stereo bench: series by series, so that one series' pixels are in memory at a time."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2

from binpick.lab import depths, marks, middlebury
from binpick.lab.depths import Series, Sheet
from binpick.sim import exam


def run(chosen: Sequence[Series], seeds: Sequence[int], repeats: int, real: Path | None,
        done: Callable[[Sheet], None]) -> dict[str, Any]:
    """All figures; `done` gets each scene as it is marked. `real` is a folder of Middlebury's scenes.

    Raises InputError for a folder without such scenes, before anything is measured.
    """
    real_scenes = list(middlebury.scenes(real)) if real else []
    figures = {}
    for series in chosen:
        marked = []
        for sheet in depths.sit(series, seeds, repeats):
            marked.append(sheet.marked)
            done(sheet)
        figures[series.name] = marks.figures(series, marked)
    return {
        "exam_sha256": exam.sha256(), "seeds": list(seeds), "repeats": repeats, "threads": cv2.getNumThreads(),
        "series": figures, "middlebury": {scene.name: middlebury.marks(scene) for scene in real_scenes},
    }
