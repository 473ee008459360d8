"""The Modbus/TCP server: pymodbus' messages behind our own connection class, one image of words, one handshake.

pymodbus' server keeps only the last request of a TCP segment and answers once (3.16, `TransactionManager.last_pdu`), so
pipelined requests would be lost; its codec is used, its server is not. A read is answered from one immutable image, so it never
spans two results; a write runs through the handshake before it is answered.
"""

import asyncio
import contextlib
import errno
import logging
import struct
import time
from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias, cast

from pymodbus.constants import ExcCodes
from pymodbus.pdu import ExceptionResponse, ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadHoldingRegistersResponse,
    ReadInputRegistersRequest,
    ReadInputRegistersResponse,
    WriteMultipleRegistersRequest,
    WriteMultipleRegistersResponse,
    WriteSingleRegisterRequest,
    WriteSingleRegisterResponse,
)

from binpick import settings
from binpick.calibration import SampleRequest
from binpick.errors import BinpickError, Code, CycleRefused, FlangePoseMissing, InputError, NotApplicable, PortInUse
from binpick.message import Verify
from binpick.publish import handshake, image
from binpick.publish.connection import Connection
from binpick.publish.exchange import NO_CTRL, Abort, Acknowledge, Action, Facts, Forget, Inputs, Report, Start, Withdraw
from binpick.publish.handshake import State
from binpick.publish.image import Signals
from binpick.publish.ports import Control, View
from binpick.publish.registers import HOLDING, HOLDING_WORDS, INPUT_WORDS, MIRROR, Ctrl
from binpick.result import Request, Snapshot
from binpick.settings.cell import ModbusSettings

Clock: TypeAlias = Callable[[], int]

BEAT_S = 0.1
"""The heartbeat's period, and the longest time between two looks at the clock."""
STANDARD_PORT = 502
REQUESTS: dict[int, type[ModbusPDU]] = {request.function_code: request for request in (
    ReadHoldingRegistersRequest, ReadInputRegistersRequest, WriteSingleRegisterRequest, WriteMultipleRegistersRequest)}
AT = {register.name: register.address for register in HOLDING}

log = logging.getLogger(__name__)


class ModbusServer:
    """Serves one cell. All of it runs on the loop that `start` was awaited on; nothing here blocks."""

    def __init__(self, view: View, control: Control, server: ModbusSettings, cell: settings.Cell,
                 clock: Clock = time.monotonic_ns) -> None:
        self._view, self._control, self._settings, self._cell, self._clock = view, control, server, cell, clock
        self._holding = [0] * HOLDING_WORDS
        self._written = False
        self._state = State()
        self._shown: tuple[Signals, Snapshot] | None = None
        self._image: tuple[int, ...] = (0,) * INPUT_WORDS
        self._beat = 0
        self._connections: set[Connection] = set()
        self._writer: Connection | None = None
        self._listener: asyncio.Server | None = None
        self._task: asyncio.Task[None] | None = None

    async def start(self) -> asyncio.Task[None]:
        """Listens, and returns the task that keeps the registers current: it ends only by `stop` or by a defect.

        Raises PortInUse, or InputError when the address cannot be listened on.
        """
        host, port = self._settings.host, self._settings.port
        self._advance()
        loop = asyncio.get_running_loop()
        try:
            self._listener = await loop.create_server(lambda: Connection(self), host, port)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise PortInUse(f"Modbus: another program listens on {host}:{port}; stop it, or set another "
                                "publish.modbus.port") from error
            raise InputError(f"Modbus: cannot listen on {host}:{port}: {error.strerror or error}; check publish.modbus "
                             "(a port below 1024 needs the right to open it)") from error
        self._task = loop.create_task(self._follow(), name="binpick-modbus")
        log.info("Modbus/TCP on %s:%d, word order %s", host, port, self._settings.word_order)
        return self._task

    async def stop(self) -> None:
        """Closes the port and every connection."""
        if self._listener is not None:
            self._listener.close()
        for connection in tuple(self._connections):
            connection.close()
        if self._task is not None:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task
        if self._listener is not None:
            await self._listener.wait_closed()

    def opened(self, connection: Connection) -> None:
        """A client is there."""
        self._connections.add(connection)

    def closed(self, connection: Connection) -> None:
        """A client is gone; when it was the one that wrote last, the handshake counts the time until somebody writes again."""
        self._connections.discard(connection)
        self._advance()

    def answer(self, body: bytes, connection: Connection) -> bytes:
        """The response to one request, each as function code and data."""
        response = self._respond(body, connection)
        return bytes([response.function_code]) + response.encode()

    def _respond(self, body: bytes, connection: Connection) -> ModbusPDU:
        function = body[0]
        if function not in REQUESTS:
            return ExceptionResponse(function, ExcCodes.ILLEGAL_FUNCTION)
        request = REQUESTS[function]()
        try:
            request.decode(body[1:])
        except (ValueError, struct.error):
            return ExceptionResponse(function, ExcCodes.ILLEGAL_VALUE)
        if not _sound(request, body):
            return ExceptionResponse(function, ExcCodes.ILLEGAL_VALUE)
        if isinstance(request, ReadHoldingRegistersRequest):
            return self._read(request)
        return self._write(request, connection)

    def _read(self, request: ModbusPDU) -> ModbusPDU:
        first, last = request.address, request.address + request.count
        if isinstance(request, ReadInputRegistersRequest):
            if last <= INPUT_WORDS:
                return ReadInputRegistersResponse(registers=self._image[first:last])
        elif last <= HOLDING_WORDS:
            return ReadHoldingRegistersResponse(registers=self._holding[first:last])
        elif first >= MIRROR and last <= MIRROR + INPUT_WORDS:
            return ReadHoldingRegistersResponse(registers=self._image[first - MIRROR:last - MIRROR])
        return ExceptionResponse(request.function_code, ExcCodes.ILLEGAL_ADDRESS)

    def _write(self, request: ModbusPDU, connection: Connection) -> ModbusPDU:
        words = cast(list[int], request.registers)
        first, last = request.address, request.address + len(words)
        if last > HOLDING_WORDS:
            return ExceptionResponse(request.function_code, ExcCodes.ILLEGAL_ADDRESS)
        self._holding[first:last] = words
        self._written = self._written or first <= AT["ctrl"] < last
        self._writer = connection
        self._advance()
        if isinstance(request, WriteSingleRegisterRequest):
            return WriteSingleRegisterResponse(address=first, registers=words)
        return WriteMultipleRegistersResponse(address=first, count=len(words))

    async def _follow(self) -> None:
        """Looks again at every new snapshot and at every beat."""
        changed, loop = self._view.subscribe(), asyncio.get_running_loop()
        beat_at = loop.time()
        try:
            while True:
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout_at(beat_at):
                        await changed.wait()
                changed.clear()
                if loop.time() >= beat_at:
                    self._beat = (self._beat + 1) % 0x10000
                    # A loop that was held up beats on from now, it does not catch up.
                    beat_at = max(beat_at + BEAT_S, loop.time())
                    self._show(self._image)
                self._advance()
        finally:
            self._view.unsubscribe(changed)

    def _advance(self) -> None:
        """Steps the handshake until it rests, then renders what it and the cell say."""
        inputs = self._inputs()
        for _ in handshake.Phase:
            self._state, actions = handshake.step(self._state, inputs)
            for action in actions:
                self._state = self._perform(action, inputs)
            inputs = self._inputs()
            if not actions:
                break
        snapshot, signals = self._view.snapshot(), handshake.signals(self._state, inputs)
        if self._shown is None or self._shown[0] != signals or self._shown[1] is not snapshot:
            self._shown = signals, snapshot
            self._show(image.encode(snapshot, signals, self._settings.word_order))

    def _show(self, words: tuple[int, ...]) -> None:
        self._image = (*words[:image.HEARTBEAT], self._beat, *words[image.HEARTBEAT + 1:])

    def _inputs(self) -> Inputs:
        words, facts = self._holding, Facts.of(self._view.snapshot())
        if facts.simulated and self._settings.port == STANDARD_PORT:
            # What a simulated camera sees must never move a robot that was told the standard port.
            facts = replace(facts, fault=Code.NOT_READY.value)
        return Inputs(
            now_ns=self._clock(), ctrl=NO_CTRL | Ctrl(words[AT["ctrl"]] & 0xFF), written=self._written,
            command=words[AT["command"]], cmd_seq=words[AT["cmd_seq"]], heartbeat=words[AT["plc_heartbeat"]],
            feedback=(words[AT["feedback_seq"]], words[AT["feedback_grasp_id"]], words[AT["feedback_code"]]),
            connected=self._writer is None or self._writer in self._connections,
            reconnect_ns=int(self._cell.reconnect_s * 1e9), facts=facts)

    def _perform(self, action: Action, inputs: Inputs) -> State:
        try:
            match action:
                case Start():
                    return self._start(inputs)
                case Forget():
                    return self._forget(inputs)
                case Report():
                    return self._report(action)
                case Abort(cycle_id):
                    self._control.abort(cycle_id, "modbus")
                case Acknowledge(cycle_id):
                    self._control.acknowledge(cycle_id, "modbus")
                case Withdraw(reason):
                    self._control.withdraw(reason, "modbus")
        except CycleRefused as refusal:
            # The cell ended it by itself between the snapshot and now: what was asked for is already so.
            log.info("Modbus: %s", refusal)
        return self._state

    def _start(self, inputs: Inputs) -> State:
        try:
            job = settings.resolve(self._cell, *(self._holding[AT[name]] for name in ("recipe", "bin", "tool")))
            request = image.decode_request(self._holding, job.recipe, self._settings.word_order)
            cycle_id = self._begin(request, inputs.command)
        except BinpickError as error:
            log.warning("Modbus: command %d refused: %s", inputs.cmd_seq, error)
            return handshake.refused(self._state, inputs, error.code)
        deadline_ns = inputs.now_ns + (request.timeout_ms or self._cell.timeout_ms) * 1_000_000
        return handshake.started(self._state, inputs, cycle_id, image.Echo.of(request, job), deadline_ns)

    def _begin(self, request: Request, command: int) -> int:
        if command == handshake.VERIFY:
            return self._control.verify(Verify(), request, "modbus")
        if command != handshake.SAMPLE:
            return self._control.start(request, "modbus")
        if request.T_base_flange is None:
            raise FlangePoseMissing("a calibration sample needs the flange pose: write it, and b0 of flange_flags")
        sample = SampleRequest(recipe=request.recipe, timeout_ms=request.timeout_ms, T_base_flange=request.T_base_flange)
        return self._control.calibration.sample(sample, "modbus")

    def _forget(self, inputs: Inputs) -> State:
        try:
            job = settings.resolve(self._cell, *(self._holding[AT[name]] for name in ("recipe", "bin")))
            self._control.forget(job.bin.number, "modbus")
        except BinpickError as error:
            log.warning("Modbus: command %d refused: %s", inputs.cmd_seq, error)
            return handshake.refused(self._state, inputs, error.code)
        return handshake.done(self._state, inputs, image.Echo(recipe=job.recipe.number, bin=job.bin.number))

    def _report(self, outcome: Report) -> State:
        latest = self._view.snapshot().latest
        cycle_id = image.cycle_of(outcome.seq, latest.result.cycle_id if latest else 0)
        try:
            if not cycle_id:
                raise NotApplicable(f"there is no result {outcome.seq}")
            self._control.report(cycle_id, outcome.grasp_id, outcome.outcome, "modbus")
        except BinpickError as error:
            log.warning("Modbus: outcome refused: %s", error)
            return handshake.unreported(self._state, error.code)
        return self._state


def _sound(request: ModbusPDU, body: bytes) -> bool:
    """The lengths agree, which pymodbus' own decoding does not ask."""
    if isinstance(request, WriteMultipleRegistersRequest):
        return 1 <= request.count <= 123 and request.byte_count == 2 * request.count == len(body) - 6
    return len(body) == 5
