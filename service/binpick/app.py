"""The composition root: settings become cameras, a cell and its servers; the only asyncio.run and the only signal handlers.

Everything stops in the reverse order of its start: READY falls and waiters end, the cell gives the cameras back,
the servers close, the recorder empties its queue. A driver stuck in C cannot hold the exit.
"""

import asyncio
import contextlib
import errno
import logging
import os
import secrets
import signal
import socket
import sys
import threading
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import uvicorn

from binpick import health, recording, settings
from binpick import rig as rig_file
from binpick.cell import Cameras, Cell
from binpick.data import CameraStatus
from binpick.errors import InputError, PortInUse
from binpick.recording import Recorder
from binpick.rig import Rig

STOP_LIMIT_S = 2.8
"""From the first signal to exit (contract: 3 s); what has not ended by then is abandoned."""
RECORDER_LIMIT_S = 0.5
SWITCH_S = 0.001
"""How long a thread may hold the interpreter while another waits for it. Beside a Python loop on the cell's thread this brings
the median of an exchange from 5.4 ms, with Python's own 5 ms, to 1.3 ms, and its p99 from 17 ms or more to 7 ms (measured)."""
MODBUS_PORT = 502
"""The port robots look at: simulated results never appear there."""

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Addresses:
    """Where a running daemon is reached; `modbus` is None when the cell file has none."""

    rest: str
    page: str
    modbus: tuple[str, int] | None

    def sentence(self) -> str:
        """The line a person sees."""
        modbus = f", Modbus/TCP {self.modbus[0]}:{self.modbus[1]}" if self.modbus else ""
        return f"binpick is up: page {self.page}, REST {self.rest}/v1{modbus}"


def run_file(path: Path) -> NoReturn:
    """Runs the cell of a file until a signal, then exits. Raises the faults of errors.py that stop a start."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _quit)  # until the loop has its own: a stop while libraries load is no traceback
    sys.setswitchinterval(SWITCH_S)
    cell = settings.load(path)
    rig, warnings = rig_file.load(cell.rig)
    for warning in warnings:
        log.warning(warning)
    _load_meshes(cell)
    _compile(cell)
    run(cell, rig, cameras(cell))
    leave()


def _load_meshes(cell: settings.Cell) -> None:
    """Makes the parts' models, a second each, before a cycle needs them. Raises InputError for one that cannot be used."""
    for mesh in (recipe.mesh for recipe in cell.recipes if recipe.mesh is not None):
        from binpick.grasp import shape

        shape.load(mesh)


def _compile(cell: settings.Cell) -> None:
    """Has machine code made of the loops over pixels, once after an installation: no cycle waits for it."""
    from binpick.stereo import depth

    for stereo in {recipe.stereo.model_dump_json(): recipe.stereo for recipe in cell.recipes}.values():
        depth.warm(stereo)


def leave() -> NoReturn:
    """Exits with 0 once `run` is over, without tearing the interpreter down.

    Everything of ours has ended by then. Unloading half a gigabyte of libraries takes up to 2 s on a busy machine and may crash
    under a thread that is stuck in one of them.
    """
    sys.stdout.flush()
    logging.shutdown()
    os._exit(0)


def cameras(cell: settings.Cell) -> Cameras:
    """The cell file's cameras as a group, not yet open."""
    from binpick.camera import backends

    return backends.group(cell.cameras, cell.recipes)


def run(cell: settings.Cell, rig: Rig, cameras: Cameras) -> None:
    """Runs a daemon over these cameras until a signal.

    Raises PortInUse; InputError when simulated cameras would be served on Modbus port 502.
    """
    stop = asyncio.Event()
    watchdog = threading.Timer(STOP_LIMIT_S, _abandon, [stop])
    watchdog.name, watchdog.daemon = "binpick-stop", True
    try:
        asyncio.run(_main(cell, rig, cameras, stop, watchdog))
    finally:
        watchdog.cancel()


async def _main(cell: settings.Cell, rig: Rig, cameras: Cameras, stop: asyncio.Event, watchdog: threading.Timer) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, _signalled, stop, number)
    async with _serving(cell, rig, cameras) as (addresses, vital):
        sys.stdout.write(addresses.sentence() + "\n")
        sys.stdout.flush()
        try:
            await _until(stop, vital)
        finally:
            watchdog.start()
            log.info("stopping")


def _signalled(stop: asyncio.Event, number: int) -> None:
    if stop.is_set():  # the second one: at once, whatever is left
        os._exit(128 + number)
    stop.set()


async def _until(stop: asyncio.Event, vital: set[asyncio.Task[Any]]) -> None:
    """Waits for the signal. Raises what ended a task that should never end."""
    signalled = asyncio.create_task(stop.wait())
    try:
        await asyncio.wait({signalled, *vital}, return_when=asyncio.FIRST_COMPLETED)
        for task in vital:
            if task.done():
                task.result()
                raise RuntimeError(f"{task.get_name()} ended by itself")
    finally:
        signalled.cancel()


@contextlib.asynccontextmanager
async def _serving(cell: settings.Cell, rig: Rig, cameras: Cameras,
                   ) -> AsyncIterator[tuple[Addresses, set[asyncio.Task[Any]]]]:
    """The daemon while it runs, and the tasks that must not end."""
    from binpick.publish import dashboard, rest

    refuse_simulation_on_502(cell, cameras.statuses())
    rest_at = cell.publish.rest
    with _recording(cell) as recorder, listen(rest_at.host, rest_at.port, "publish.rest") as listener:
        living = Cell(cell, rig, cameras, boot_id=secrets.randbelow(65535) + 1, recorder=recorder)

        def judged() -> health.Health:
            return health.judge(living.snapshot(), alive=living.alive, recording=recorder.status().trouble if recorder else "")

        api = rest.create_app(living, living, health=judged)
        dashboard.attach(api, living, judged)
        async with _modbus(cell, living) as registers, _http(api, listener) as pages:
            guard = asyncio.create_task(_watch_simulation(cell, living), name="the guard of port 502")
            try:
                yield _addresses(cell), {*registers, pages, living.launch(), guard}
            finally:
                guard.cancel()
                await living.close()


@contextlib.contextmanager
def _recording(cell: settings.Cell) -> Iterator[Recorder | None]:
    if cell.recording.directory is None:
        yield None
        return
    recorder = recording.Recorder(cell.recording.directory)
    recorder.start()
    try:
        yield recorder
    finally:
        if not recorder.close(RECORDER_LIMIT_S):
            log.warning("recordings of the last cycles were abandoned: the disk is too slow")


@contextlib.asynccontextmanager
async def _modbus(cell: settings.Cell, living: Cell) -> AsyncIterator[set[asyncio.Task[Any]]]:
    if cell.publish.modbus is None:
        yield set()
        return
    from binpick.publish.modbus import ModbusServer

    server = ModbusServer(living, living, cell.publish.modbus, cell)
    task = await server.start()
    try:
        yield {task}
    finally:
        await server.stop()


class _Server(uvicorn.Server):
    """uvicorn without its signal handling, which loses `finally` on SIGTERM and hangs on an open SSE client."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Ours are installed already."""
        yield


@contextlib.asynccontextmanager
async def _http(api: Any, listener: socket.socket) -> AsyncIterator[asyncio.Task[None]]:
    server = _Server(uvicorn.Config(api, log_config=None, access_log=False, timeout_graceful_shutdown=2))
    task = asyncio.create_task(server.serve(sockets=[listener]), name="the HTTP server")
    try:
        while not server.started and not task.done():
            await asyncio.sleep(0.005)
        yield task
    finally:
        server.should_exit = True
        await task


def listen(host: str, port: int, key: str) -> socket.socket:
    """A listening TCP socket; `key` names the setting. Raises PortInUse, InputError."""
    try:
        return socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
    except OSError as error:
        what = {errno.EADDRINUSE: "another program listens there: stop it, or choose another port",
                errno.EACCES: "ports below 1024 need the capability CAP_NET_BIND_SERVICE: grant it, or choose another port",
                errno.EADDRNOTAVAIL: "this machine has no such address: use one of its own, or 0.0.0.0 for all"}
        kind = PortInUse if error.errno == errno.EADDRINUSE else InputError
        raise kind(f"{key}: cannot listen on {host}:{port}: {what.get(error.errno or 0, error.strerror)}") from error


def _addresses(cell: settings.Cell) -> Addresses:
    """0.0.0.0 is no address to go to: people are shown this machine's own."""
    rest, modbus = cell.publish.rest, cell.publish.modbus
    host = "127.0.0.1" if rest.host in ("0.0.0.0", "::") else rest.host
    base = f"http://{f'[{host}]' if ':' in host else host}:{rest.port}"
    return Addresses(base, f"{base}/ui", (modbus.host, modbus.port) if modbus else None)


def refuse_simulation_on_502(cell: settings.Cell, cameras: tuple[CameraStatus, ...]) -> None:
    """Raises InputError when a robot could take poses of a simulated scene for real ones."""
    if cell.publish.modbus is not None and cell.publish.modbus.port == MODBUS_PORT:
        for status in cameras:
            if status.simulated:
                raise InputError(f"camera {status.name} is simulated, and simulated poses are never served on Modbus port "
                                 f"{MODBUS_PORT}: set publish.modbus.port, for instance to 5020")


async def _watch_simulation(cell: settings.Cell, living: Cell) -> NoReturn:
    """Some cameras are known to be simulated only once they are open."""
    changed = living.subscribe()
    try:
        while True:
            changed.clear()
            refuse_simulation_on_502(cell, living.snapshot().cameras)
            await changed.wait()
    finally:
        living.unsubscribe(changed)


def _quit(_number: int, _frame: object) -> NoReturn:
    raise SystemExit(0)


def _abandon(stop: asyncio.Event) -> None:
    """The watchdog's bite: what holds the exit now would hold it for ever."""
    log.warning("not everything ended within %.1f s; it is abandoned", STOP_LIMIT_S)
    logging.shutdown()
    os._exit(0 if stop.is_set() else 1)
