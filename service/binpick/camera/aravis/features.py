"""A camera's features through Aravis: written, read back, and compared; on the camera's own thread."""

import math
from collections.abc import Iterable
from typing import Any

from binpick.camera.aravis import library
from binpick.camera.sync import Step
from binpick.errors import CameraError, CameraLost

Value = str | int | float | bool
ROUNDED = 1.001
"""Increments that a rounded number may be off: one, as far as floats tell."""


class Features:
    """Of one open Aravis.Camera; `name` is the camera's, for errors."""

    def __init__(self, camera: Any, name: str) -> None:
        self._camera = camera
        self._name = name
        self._known: dict[str, bool] = {}

    def has(self, feature: str) -> bool:
        """Whether the camera has it, at all: its availability may change, its presence does not."""
        if feature not in self._known:
            self._known[feature] = bool(self._camera.is_feature_available(feature))
        return self._known[feature]

    def apply(self, steps: Iterable[Step]) -> None:
        """One after the other. Raises CameraError naming feature, value wanted and value found; CameraLost, CameraHeld."""
        for step in steps:
            if step.optional and not self.has(step.feature):
                continue
            refusal = self._write(step)
            found = step.value if step.secret and not refusal else self._found(step)
            if found != step.value:
                raise self._unlike(step, found, refusal)

    def bounds(self, feature: str) -> tuple[float, float]:
        """The least and the most that the camera takes now. Raises CameraError, CameraLost."""
        _, glib = library.load()
        try:
            low, high = self._camera.get_float_bounds(feature)
        except glib.Error as error:
            raise library.translated(error, self._name, f"reading the range of {feature}") from None
        return float(low), float(high)

    def _increment(self, feature: str) -> float:
        """What it is rounded up to; 0 when the camera does not say. Raises CameraLost."""
        _, glib = library.load()
        try:
            return float(self._camera.get_float_increment(feature))
        except glib.Error as error:
            trouble = library.translated(error, self._name, f"reading the increment of {feature}")
            if isinstance(trouble, CameraLost):
                raise trouble from None
            return 0.0

    def approach(self, feature: str, wanted: float, tolerance: float) -> float:
        """Sets a number that the camera may round, not clamp; what it is now. Raises as `apply` does."""
        step = Step(feature, float(wanted))
        low, high = self.bounds(feature)
        if not low <= wanted <= high:
            raise CameraError(f"camera {self._name}: {feature} should be {wanted:g}, but this camera's range is {low:g} to "
                              f"{high:g}: check the recipe", self._name)
        refusal = self._write(step)
        found = self._found(step)
        off = abs(float(found) - wanted) if found is not None else math.inf
        if found is None or (off > tolerance and off > ROUNDED * self._increment(feature)):
            raise self._unlike(step, found, refusal)
        return float(found)

    def _unlike(self, step: Step, found: Value | None, refusal: str) -> CameraError:
        is_now = f"is {found}" if found is not None else "it is not there"
        return CameraError(f"camera {self._name}: {step.feature} should be {step.value}, but {is_now}"
                           f"{f' ({refusal})' if refusal else ''}: check the cell file, and the camera's model and firmware",
                           self._name)

    def _write(self, step: Step) -> str:
        """Why the camera did not accept it, "" when it did. Raises CameraLost, CameraHeld."""
        _, glib = library.load()
        camera, value = self._camera, step.value
        try:
            if isinstance(value, bool):
                camera.set_boolean(step.feature, value)
            elif isinstance(value, int):
                camera.set_integer(step.feature, value)
            elif isinstance(value, float):
                camera.set_float(step.feature, value)
            else:
                camera.set_string(step.feature, value)
        except glib.Error as error:
            trouble = library.translated(error, self._name, f"setting {step.feature}")
            if type(trouble) is not CameraError:
                raise trouble from None
            return str(error.message)
        return ""

    def _found(self, step: Step) -> Value | None:
        _, glib = library.load()
        camera, value = self._camera, step.value
        read = (camera.get_boolean if isinstance(value, bool) else camera.get_integer if isinstance(value, int)
                else camera.get_float if isinstance(value, float) else camera.get_string)
        try:
            found: Value = read(step.feature)
        except glib.Error as error:
            trouble = library.translated(error, self._name, f"reading {step.feature}")
            if isinstance(trouble, CameraLost):
                raise trouble from None
            return None
        return found
