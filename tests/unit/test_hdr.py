"""Two exposures of parts of which some shine and some are dark measure more than either exposure alone."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from binpick.lab import depths, exam
from binpick.lab.exam import Paper
from binpick.settings import Recipe
from binpick.stereo import depth

LONG_US, RATIO = 20_000.0, 8.0
"""Long enough for what steel shows, far too long for painted blocks."""
pytestmark = pytest.mark.slow


def paper(**light: object) -> Paper:
    """The same few parts, dark shiny steel and bright painted blocks, under another light."""
    asked = exam.paper("A", 2, kinds="block+steel-block", parts=6)
    job = asked.inputs.job
    recipe = Recipe.model_validate(job.recipe.model_dump() | {"exposure_us": LONG_US, **light})
    first, *more = (exam.pair(asked.scene, taken, 2 + number) for number, taken in enumerate(recipe.lights))
    job = job.model_copy(update={"recipe": recipe})
    return replace(asked, inputs=replace(asked.inputs, job=job, pair=first, more=tuple(more)))


@cache
def found(**light: object) -> tuple[float, float]:
    """Of the parts' pixels: the share that is measured, and the share that is measured within 1 px."""
    asked = paper(**light)
    recipe = asked.inputs.job.recipe
    pair, measured = depth.of_shots(depths.rectified(asked), asked.inputs.lights, recipe.stereo)
    truth = asked.truth(pair.window)
    parts = (truth.part_id > 0) & truth.visible_both
    with np.errstate(invalid="ignore"):
        right = np.abs(measured.disparity - truth.disparity) <= 1
    return float(measured.measured[parts].mean()), float(right[parts].mean())


def test_one_setting_measures_more_than_either_exposure_alone() -> None:
    long, short, both = found(), found(exposure_us=LONG_US / RATIO), found(hdr=RATIO)
    assert both[0] > max(long[0], short[0]), (long, short, both)
    assert both[1] > max(long[1], short[1]), (long, short, both)
