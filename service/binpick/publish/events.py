"""The cell's changes as they happen: for code an iteration over snapshots, for clients server-sent events."""

import time
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import aclosing

from fastapi.sse import ServerSentEvent

from binpick.publish.ports import View
from binpick.publish.wire import State, age_ms
from binpick.result import Snapshot


async def snapshots(view: View) -> AsyncGenerator[Snapshot, None]:
    """The present snapshot and every later one; ends after the one that says stopping.

    A slow reader misses some in between: the latest wins. Wrap it in `aclosing` when leaving early.
    """
    changed = view.subscribe()
    try:
        while True:
            changed.clear()
            snapshot = view.snapshot()
            yield snapshot
            if snapshot.phase == "stopping":
                return
            await changed.wait()
    finally:
        view.unsubscribe(changed)


async def stream(view: View) -> AsyncIterator[ServerSentEvent]:
    """A `state` event at once and at every change, a `result` event (binpick-result/1) when a cycle has finished."""
    told = 0
    first = True
    async with aclosing(snapshots(view)) as changes:
        async for snapshot in changes:
            yield ServerSentEvent(event="state", raw_data=State.of(snapshot).model_dump_json())
            latest = snapshot.latest
            if latest is not None and latest.result.cycle_id != told:
                told = latest.result.cycle_id
                if not first:
                    result = latest.result.model_copy(update={"age_ms": age_ms(latest, time.monotonic_ns())})
                    yield ServerSentEvent(event="result", id=str(told), raw_data=result.model_dump_json(by_alias=True))
            first = False
