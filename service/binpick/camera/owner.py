"""A daemon thread that alone owns a driver's objects; others post functions to it and wait no longer than they may.

A thread cannot be cancelled. One that hangs in a foreign call is retired: nobody waits for it any more, and when it comes back
it takes leave of its objects by itself.
"""

import logging
import queue
import threading
import time
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

from binpick.camera.base import MonotonicNs, remaining_s
from binpick.errors import BinpickError

log = logging.getLogger(__name__)
T = TypeVar("T")
Posted = tuple[Callable[[], Any], "Future[Any]"]


class Owner:
    """Runs posted functions in order. `farewell` runs on the same thread when the owner retires.

    `rest` does so when nothing is posted at the time (host monotonic) that `due_ns` names; one that raises is not called again.
    """

    def __init__(self, name: str, farewell: Callable[[], None], rest: Callable[[], None] = lambda: None,
                 due_ns: Callable[[], MonotonicNs | None] = lambda: None) -> None:
        self._farewell = farewell
        self._rest = rest
        self._due_ns: Callable[[], MonotonicNs | None] = due_ns
        self._posted: queue.SimpleQueue[Posted | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def call(self, function: Callable[[], T], deadline_ns: MonotonicNs) -> T:
        """What the function returns or raises; TimeoutError when the deadline (host monotonic) passes first."""
        future: Future[T] = Future()
        self._posted.put((function, future))
        return future.result(timeout=remaining_s(deadline_ns, time.monotonic_ns))

    def retire(self) -> None:
        """No more calls; the thread takes leave as soon as it can. Does not wait."""
        self._posted.put(None)

    def join(self, timeout_s: float) -> None:
        """Waits for a retired thread, no longer than that."""
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while True:
            due_ns = self._due_ns()
            try:
                posted = self._posted.get(timeout=None if due_ns is None else remaining_s(due_ns))
            except queue.Empty:
                self._take_rest()
                continue
            if posted is None:
                break
            _carry_out(*posted)
            del posted        # the function may hold the driver's objects
        self._farewell()

    def _take_rest(self) -> None:
        try:
            self._rest()
        except Exception as error:    # noqa: BLE001 - nobody waits for it, and the next verb fails for the same reason
            log.info("%s: %s", self._thread.name, error)
            self._due_ns = lambda: None


def _carry_out(function: Callable[[], Any], future: "Future[Any]") -> None:
    try:
        result = function()
    except Exception as error:    # noqa: BLE001 - handed whole to the caller
        if not isinstance(error, BinpickError):      # a bug: its place must not get lost
            error.add_note(traceback.format_exc())
        # a traceback's frames would carry the driver's objects, and their finalisers, to the caller's thread
        future.set_exception(_bare(error))
    else:
        future.set_result(result)


def _bare(error: BaseException) -> BaseException:
    error.__cause__ = error.__context__ = None
    return error.with_traceback(None)
