"""The one place where the cell's state lives: replaced whole under a lock, shown as a snapshot, announced to whoever waits."""

import asyncio
import threading
from collections.abc import Callable
from typing import Concatenate, ParamSpec

from binpick.cell import machine
from binpick.cell.machine import State
from binpick.result import Owner, Snapshot

P = ParamSpec("P")


class Board:
    """Any thread may read and step; a step is a pure function, so the lock is held for microseconds."""

    def __init__(self, state: State, boot_id: int, owner: Owner) -> None:
        self._boot_id, self._owner = boot_id, owner
        self._changed = threading.Condition()
        self._state = state
        self._snapshot = machine.snapshot(state, boot_id, owner)
        self._subscribers: dict[asyncio.Event, asyncio.AbstractEventLoop] = {}

    @property
    def state(self) -> State:
        """As it is now."""
        return self._state

    @property
    def snapshot(self) -> Snapshot:
        """As the interfaces show it."""
        return self._snapshot

    def step(self, transition: Callable[Concatenate[State, P], State], *args: P.args, **kwargs: P.kwargs) -> State:
        """Replaces the state by the transition's and returns it; what the transition raises leaves the state as it was."""
        with self._changed:
            state = transition(self._state, *args, **kwargs)
            if state is self._state:
                return state
            self._state = state
            self._snapshot = machine.snapshot(state, self._boot_id, self._owner)
            self._changed.notify_all()
            waiting = list(self._subscribers.items())
        for event, loop in waiting:
            try:
                loop.call_soon_threadsafe(event.set)
            except RuntimeError:  # that loop has ended without unsubscribing; nobody is left to tell
                self.unsubscribe(event)
        return state

    def wait(self, until: Callable[[State], bool], timeout_s: float) -> State:
        """Blocks this thread until the state fulfils `until`, at most `timeout_s`; returns the state either way."""
        with self._changed:
            self._changed.wait_for(lambda: until(self._state), timeout_s)
            return self._state

    def subscribe(self) -> asyncio.Event:
        """An event of the running loop, set at every change."""
        event = asyncio.Event()
        with self._changed:
            self._subscribers[event] = asyncio.get_running_loop()
        return event

    def unsubscribe(self, event: asyncio.Event) -> None:
        """Ends a subscription."""
        with self._changed:
            self._subscribers.pop(event, None)
