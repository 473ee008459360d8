"""A cell's servers in the test's own process: REST and Modbus over it, in an event loop of the test's or on a thread."""

import asyncio
import contextlib
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AbstractAsyncContextManager, asynccontextmanager, contextmanager
from pathlib import Path

import httpx
import uvicorn

from binpick import health, recording, settings
from binpick.cell import Cell
from binpick.publish import rest
from binpick.publish.modbus import ModbusServer

START_S = 20.0


def until(condition: Callable[[], object], limit_s: float = 5.0) -> None:
    deadline = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


class RestServer(uvicorn.Server):
    """Leaves the process's signals alone."""

    def __init__(self, cell: Cell, port: int) -> None:
        api = rest.create_app(cell, cell, health=lambda: health.judge(cell.snapshot()))
        super().__init__(uvicorn.Config(api, port=port, log_level="error", timeout_graceful_shutdown=2))

    def capture_signals(self) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()


@asynccontextmanager
async def with_modbus(cell: Cell, configured: settings.Cell) -> AsyncIterator[ModbusServer]:
    """The living cell, and its Modbus server."""
    assert configured.publish.modbus is not None
    async with cell:
        server = ModbusServer(cell, cell, configured.publish.modbus, configured)
        await server.start()
        try:
            yield server
        finally:
            await server.stop()


@contextmanager
def on_a_thread(living: AbstractAsyncContextManager[object], cell: Cell, port: int) -> Iterator[httpx.Client]:
    """REST over a cell that lives while `living` lasts, and a client of it."""
    server = RestServer(cell, port)

    async def live() -> None:
        async with living:
            await server.serve()

    thread = threading.Thread(target=asyncio.run, args=(live(),), name="binpick-test-server")
    thread.start()
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=40) as client:
            until(lambda: server.started, START_S)
            yield client
    finally:
        server.should_exit = True
        thread.join(5)
        assert not thread.is_alive()


@contextmanager
def recorder(folder: Path | None) -> Iterator[recording.Recorder | None]:
    """Records into the folder; when it ends, everything is on disk."""
    if folder is None:
        yield None
        return
    recorder = recording.Recorder(folder)
    recorder.start()
    try:
        yield recorder
    finally:
        assert recorder.close(10.0)
