"""The last cycle's pictures and cloud, rendered when somebody asks and only once."""

import threading

from binpick.data import StereoPair
from binpick.result import Artefact, CycleResult


class Gallery:
    """Holds one cycle's arrays until the next one's take their place."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._cycle: CycleResult | None = None
        self._pair: StereoPair | None = None
        self._rendered: dict[str, Artefact] = {}

    def keep(self, cycle: CycleResult, pair: StereoPair) -> None:
        """Replaces the cycle shown."""
        with self._lock:
            self._cycle, self._pair, self._rendered = cycle, pair, {}

    def artefact(self, cycle_id: int, name: str) -> Artefact | None:
        """The artefact of that cycle, or None when it is not the one kept or never came so far.

        A second caller of the same picture waits for the first instead of drawing it again.
        """
        from binpick import artefacts

        with self._lock:
            if self._cycle is None or self._pair is None or self._cycle.result.cycle_id != cycle_id:
                return None
            if name not in self._rendered:
                self._rendered[name] = Artefact(*artefacts.render(self._cycle, self._pair, name))
            return self._rendered[name]
