"""The last cycle's pictures and cloud, drawn when somebody asks and only once."""

import threading

from binpick import artefacts
from binpick.cycle import CycleInput, CycleResult
from binpick.result import Artefact


class Exhibit:
    """One cycle's arrays, and what was drawn of them."""

    def __init__(self, inputs: CycleInput, cycle: CycleResult) -> None:
        self._inputs, self._cycle = inputs, cycle
        self._drawing = threading.Lock()
        self._drawn: dict[str, Artefact] = {}

    @property
    def cycle_id(self) -> int:
        """Whose pictures these are."""
        return self._inputs.cycle_id

    def artefact(self, name: str) -> Artefact:
        """A second caller of the same picture waits for the first instead of drawing it again."""
        with self._drawing:
            if name not in self._drawn:
                self._drawn[name] = Artefact(*artefacts.render(self._inputs, self._cycle, name))
            return self._drawn[name]


class Gallery:
    """Shows one cycle until the next one's take its place; the worker that hangs them up never waits for a viewer."""

    def __init__(self) -> None:
        self._shown: Exhibit | None = None

    def keep(self, inputs: CycleInput, cycle: CycleResult) -> None:
        """Replaces the cycle shown."""
        self._shown = Exhibit(inputs, cycle)

    def artefact(self, cycle_id: int, name: str) -> Artefact | None:
        """The artefact of that cycle; None when another cycle is shown, or there is no such picture."""
        shown = self._shown
        if shown is None or shown.cycle_id != cycle_id or name not in artefacts.DRAW:
            return None
        return shown.artefact(name)
