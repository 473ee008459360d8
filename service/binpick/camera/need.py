"""What the recipes will ask of the cameras: every exposure and gain with the setting it comes from."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from binpick.settings.recipe import Recipe

RANGES = {"exposure_range_us": "ExposureTime", "gain_range_db": "Gain"}
"""The features (SFNC) behind the ranges of `CameraStatus`."""


@dataclass(frozen=True, slots=True)
class Need:
    """A value that one of the camera's ranges must hold, and how the cell file calls it."""

    setting: str
    range: Literal["exposure_range_us", "gain_range_db"]
    value: float


def needs(recipes: Iterable[Recipe]) -> tuple[Need, ...]:
    """Of all recipes, in order."""
    return tuple(need for recipe in recipes for need in _needs(recipe))


def _needs(recipe: Recipe) -> Iterable[Need]:
    name = f"recipe {recipe.number}"
    if recipe.metered:
        yield Need(f"{name}: auto.longest_us", "exposure_range_us", recipe.auto.longest_us)
        yield Need(f"{name}: auto.highest_gain_db", "gain_range_db", recipe.auto.highest_gain_db)
    for number, light in enumerate(recipe.lights, start=1):
        if not light.metered:
            yield Need(f"{name}, shot {number}: exposure_us", "exposure_range_us", light.exposure_us)
        yield Need(f"{name}, shot {number}: gain_db", "gain_range_db", light.gain_db)
