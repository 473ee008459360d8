"""Things that happen at a time: functions called at an instant of the host's clock, on one thread."""

import heapq
import threading
from collections.abc import Callable

from binpick.sim.gige.clock import host_ns

Due = tuple[int, int, Callable[[], None]]


class Timer:
    """From `start` to `stop`; what is due later than that never happens."""

    def __init__(self) -> None:
        self._due: list[Due] = []
        self._count = 0
        self._changed = threading.Condition()
        self._running = False
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Begins to keep time."""
        self._running = True
        self._thread = threading.Thread(target=self._run, name="binpick-gige-timer", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Forgets what is due; called from elsewhere than the timer's own thread it waits for that to end."""
        with self._changed:
            self._running = False
            self._due.clear()
            self._changed.notify_all()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(1.0)

    def call(self, at_ns: int, function: Callable[[], None]) -> None:
        """Calls it then, on the timer's thread; at once when that is past. It must not take long."""
        with self._changed:
            self._count += 1
            heapq.heappush(self._due, (at_ns, self._count, function))
            self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                while self._running and (not self._due or self._due[0][0] > host_ns()):
                    self._changed.wait((self._due[0][0] - host_ns()) / 1e9 if self._due else None)
                if not self._running:
                    return
                _, _, function = heapq.heappop(self._due)
            function()
