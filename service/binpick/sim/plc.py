"""The cell's controller: a PLC that knows nothing but Modbus/TCP and the printed register map, so its addresses are literal.

Its way of reading checks and orientations is its own on purpose: an error of the server must not hide behind shared code.
"""

import asyncio
import contextlib
import struct
from collections.abc import Awaitable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Literal

import numpy as np
from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ConnectionException, ModbusIOException
from pymodbus.pdu import ModbusPDU
from scipy.spatial.transform import Rotation

from binpick import geometry
from binpick.errors import BinpickError, CycleTimeout, NotReady
from binpick.geometry import Transform

ENABLE, TRIG, RES_ACK, NEXT_PAGE, CLEAR_ERR, STROBE = 1, 2, 4, 8, 16, 128
READY, ACK, NACK, ACQ_DONE, VALID, ERROR, LAST_PAGE = 1, 2, 4, 16, 32, 64, 256
POLL_S = 0.01
HEARTBEAT_S = 0.5
MARGIN_S = 2.0
"""Waited beyond the cycle's own time limit before the PLC gives up."""


@dataclass(frozen=True, slots=True, eq=False)
class PlcRecord:
    """One grasp as the registers tell it: T_frame_tcp in metres, lengths in metres."""

    grasp_id: int
    T_frame_tcp: Transform
    tool: int
    quality: float
    open_m: float
    close_m: float
    approach_m: float


@dataclass(frozen=True, slots=True)
class PlcResult:
    """What came of a command; `records` is empty unless everything allows the robot to move."""

    return_code: int
    seq: int
    frame: int
    records: tuple[PlcRecord, ...] = ()
    acquire_ms: int = 0
    total_ms: int = 0


class Plc:
    """Use it as `async with Plc(host, port) as plc`: connected, enabled, its heartbeat running."""

    def __init__(self, host: str, port: int, word_order: Literal["ABCD", "CDAB"] = "ABCD") -> None:
        self._client = AsyncModbusTcpClient(host, port=port, timeout=2, retries=0, reconnect_delay=0)
        self._word_order = word_order
        self._cmd_seq = 0
        self._heart: asyncio.Task[None] | None = None

    async def __aenter__(self) -> "Plc":
        if not await self._client.connect():
            raise NotReady("the PLC cannot reach the Modbus server")
        await self._write(0, [ENABLE])
        self._cmd_seq = (await self._read(102, 1))[0]
        self._heart = asyncio.get_running_loop().create_task(self._beat(), name="binpick-plc-heartbeat")
        return self

    async def __aexit__(self, kind: type[BaseException] | None, error: BaseException | None,
                        traceback: TracebackType | None) -> None:
        if self._heart is not None:
            self._heart.cancel()
            with contextlib.suppress(asyncio.CancelledError, BinpickError):
                await self._heart
        self._client.close()

    async def clear(self, timeout_s: float = 10.0) -> None:
        """Clears what is latched and waits for READY; raises NotReady with the named error."""
        await self._write(0, [ENABLE | CLEAR_ERR])
        await self._write(0, [ENABLE])
        await self._ready(timeout_s)

    async def pick(self, *, recipe: int = 0, bin_number: int = 0, tool: int = 0, frame: int = 0, max_grasps: int = 0,
                   pose_format: int = 0, timeout_ms: int = 5000) -> PlcResult:
        """One whole cycle, from READY until TRIG and RES_ACK have fallen again.

        Raises NotReady with the error that the cell names, CycleTimeout when the server breaks the handshake.
        """
        await self._ready(timeout_ms / 1000 + MARGIN_S)
        await self._write(3, [recipe, tool, frame, max_grasps, pose_format, timeout_ms])
        await self._write(27, [bin_number])
        return await self._cycle(1, timeout_ms / 1000 + MARGIN_S)

    async def verify(self, *, timeout_ms: int = 5000) -> PlcResult:
        """Has the calibration looked at (command 5): 0 it holds, 2 a warning, -24 a fault. Raises as `pick`."""
        await self._ready(timeout_ms / 1000 + MARGIN_S)
        await self._write(3, [0, 0, 0, 0, 0, timeout_ms])
        return await self._cycle(5, timeout_ms / 1000 + MARGIN_S)

    async def status(self) -> int:
        """The status word, register 10."""
        return (await self._read(10, 1))[0]

    async def _cycle(self, command: int, limit_s: float) -> PlcResult:
        """Triggers a command that takes images, with its arguments written, and reads what came of it."""
        self._cmd_seq = self._cmd_seq % 65535 + 1
        await self._write(1, [command, self._cmd_seq])
        await self._write(0, [ENABLE | TRIG])
        try:
            status = await self._until(ACK | NACK, limit_s)
            if status & ACK:
                # ACQ_DONE first: from there on a real robot may already leave the view.
                await self._until(ACQ_DONE | VALID | ERROR, limit_s)
                status = await self._until(VALID | ERROR, limit_s)
            result = await self._result(bool(status & VALID))
            await self._write(0, [ENABLE | TRIG | RES_ACK])
            await self._until(VALID, limit_s, level=False)
        finally:
            await self._write(0, [ENABLE])
        return result

    async def exchanged(self, *, bin_number: int = 0, timeout_ms: int = 1000) -> int:
        """Says that the bin was exchanged (command 8); returns the code of the answer. Raises NotReady, CycleTimeout."""
        await self._write(27, [bin_number])
        return (await self._command(8, timeout_ms))[0]

    async def sample(self, T_base_flange: Transform | None, *, timeout_ms: int = 5000) -> tuple[int, int]:
        """Has a calibration sample taken (command 7); returns code and detail. Raises NotReady, CycleTimeout."""
        if T_base_flange is not None:
            numbers = [*T_base_flange[:3, 3] * 1000, *Rotation.from_matrix(T_base_flange[:3, :3]).as_quat()]
            await self._write(12, [word for number in numbers for word in self._words(float(number))])
        await self._write(3, [0, 0, 0, 0, 1, timeout_ms])
        await self._write(34, [int(T_base_flange is not None)])
        return await self._command(7, timeout_ms)

    async def _command(self, command: int, timeout_ms: int) -> tuple[int, int]:
        """One command that gives no grasps, from READY until TRIG and RES_ACK have fallen again: its code and detail."""
        limit_s = timeout_ms / 1000 + MARGIN_S
        await self._ready(limit_s)
        self._cmd_seq = self._cmd_seq % 65535 + 1
        await self._write(1, [command, self._cmd_seq])
        await self._write(0, [ENABLE | TRIG])
        try:
            await self._until(VALID | NACK | ERROR, limit_s)
            code, detail = await self._read(105, 2)
            await self._write(0, [ENABLE | TRIG | RES_ACK])
            await self._until(VALID, limit_s, level=False)
        finally:
            await self._write(0, [ENABLE])
        return _signed(code), detail

    async def report(self, seq: int, grasp_id: int, outcome: int) -> None:
        """Tells what became of a grasp: 1 ok, 2 missed, 3 dropped, 4 collision, 5 skipped, 6 double, 7 unreachable."""
        await self._write(10, [grasp_id, outcome])
        await self._write(26, [seq])
        await self._write(0, [ENABLE | STROBE])
        await self._write(0, [ENABLE])

    async def _ready(self, timeout_s: float) -> None:
        try:
            await self._until(READY, timeout_s)
        except CycleTimeout:
            code = _signed((await self._read(15, 1))[0])
            raise NotReady(f"the cell did not become ready within {timeout_s:.1f} s; it names the error {code}") from None

    async def _result(self, valid: bool) -> PlcResult:
        """The result with its grasps of all pages; grasps only when every proof holds."""
        block = await self._read(100, 125)
        header = _Header.of(block)
        records = list(self._records(block, header)) if valid else []
        while valid and header.remaining and not header.status & LAST_PAGE:
            page = header.page
            await self._write(0, [ENABLE | TRIG | NEXT_PAGE])
            await self._write(0, [ENABLE | TRIG])
            block = await self._read(100, 125)
            header = _Header.of(block)
            if header.page != page + 1:
                raise NotReady(f"asked for page {page + 1}, got page {header.page}")
            records += self._records(block, header)
        return PlcResult(header.return_code, header.seq, header.frame, tuple(records), header.t_acq_ms, header.t_total_ms)

    def _records(self, block: Sequence[int], header: "_Header") -> list[PlcRecord]:
        """The rule: VALID, return code 0 to 3, n_in_page > 0, flags b0, checks right, cmd_seq mine."""
        for first, last in ((0, 19), (0, 124)):
            _prove(block, first, last)
        if not header.status & VALID or header.return_code not in (0, 1, 2, 3) or header.cmd_seq != self._cmd_seq:
            return []
        records = []
        for first in (20, 46, 72, 98)[:header.n_in_page]:
            _prove(block, first, first + 25)
            words = block[first:first + 26]
            if words[16] & 1 and words[0] == header.seq:
                records.append(self._record(words, header.pose_format))
        return records

    def _record(self, words: Sequence[int], pose_format: int) -> PlcRecord:
        x, y, z, *numbers = (self._float(words[i], words[i + 1]) for i in range(2, 16, 2))
        R = _rotation(numbers, pose_format).as_matrix()
        return PlcRecord(grasp_id=words[1], T_frame_tcp=geometry.make(R, np.array([x, y, z]) / 1000), tool=words[17],
                         quality=words[19] / 1000, open_m=words[20] / 10000, close_m=words[21] / 10000,
                         approach_m=words[22] / 10000)

    def _float(self, first: int, second: int) -> float:
        high, low = (first, second) if self._word_order == "ABCD" else (second, first)
        return float(struct.unpack(">f", struct.pack(">HH", high, low))[0])

    def _words(self, number: float) -> tuple[int, int]:
        high, low = struct.unpack(">HH", struct.pack(">f", number))
        return (high, low) if self._word_order == "ABCD" else (low, high)

    async def _until(self, bits: int, timeout_s: float, *, level: bool = True) -> int:
        """The status word as soon as any of the bits is set (or, with level False, all are clear)."""
        loop = asyncio.get_running_loop()
        deadline = loop.time() + timeout_s
        while True:
            status = (await self._read(10, 1))[0]
            if bool(status & bits) is level:
                return status
            if loop.time() >= deadline:
                raise CycleTimeout(f"the PLC waited {timeout_s:.1f} s for status bits {bits:#x}, got {status:#x}")
            await asyncio.sleep(POLL_S)

    async def _beat(self) -> None:
        count = 0
        while True:
            count = count % 65535 + 1
            await self._write(9, [count])
            await asyncio.sleep(HEARTBEAT_S)

    async def _read(self, address: int, count: int) -> list[int]:
        return list((await _answer(self._client.read_input_registers(address, count=count))).registers)

    async def _write(self, address: int, words: list[int]) -> None:
        await _answer(self._client.write_registers(address, words))


async def _answer(request: Awaitable[ModbusPDU]) -> ModbusPDU:
    try:
        response = await request
    except (ConnectionException, ModbusIOException) as error:
        raise NotReady(f"the PLC lost the Modbus server: {error}") from error
    # pymodbus waits with asyncio.wait_for, which in Python 3.11 swallows a cancellation that meets the answer.
    task = asyncio.current_task()
    if task is not None and task.cancelling():
        raise asyncio.CancelledError
    if response.isError():
        raise NotReady(f"the Modbus server answered {response}")
    return response


@dataclass(frozen=True, slots=True)
class _Header:
    seq: int
    cmd_seq: int
    status: int
    return_code: int
    frame: int
    pose_format: int
    n_in_page: int
    page: int
    remaining: int
    t_acq_ms: int
    t_total_ms: int

    @classmethod
    def of(cls, words: Sequence[int]) -> "_Header":
        return cls(seq=words[0], cmd_seq=words[2], status=words[4], return_code=_signed(words[5]), frame=words[9],
                   pose_format=words[10], n_in_page=words[13], page=words[14], remaining=words[15], t_acq_ms=words[16],
                   t_total_ms=words[17])


def _prove(block: Sequence[int], first: int, last: int) -> None:
    """The last word of a unit is 0x5A5A plus the sum of the others."""
    if (0x5A5A + sum(block[first:last])) & 0xFFFF != block[last]:
        raise NotReady(f"registers {100 + first} to {100 + last} are not one whole unit: their check is wrong")


def _signed(word: int) -> int:
    return word - 0x10000 if word & 0x8000 else word


def _rotation(numbers: Sequence[float], pose_format: int) -> Rotation:
    """R1 to R4: 1 quaternion xyzw, 2 and 5 rotation vector, 3 KUKA A B C, 4 FANUC W P R (about fixed x, y, z)."""
    if pose_format == 1:
        return Rotation.from_quat(numbers)
    if pose_format in (2, 5):
        return Rotation.from_rotvec(numbers[:3])
    if pose_format == 3:
        a, b, c = np.radians(numbers[:3])
        return Rotation.from_rotvec([0, 0, a]) * Rotation.from_rotvec([0, b, 0]) * Rotation.from_rotvec([c, 0, 0])
    if pose_format == 4:
        return Rotation.from_euler("xyz", numbers[:3], degrees=True)
    raise NotReady(f"the registers name an unknown pose format: {pose_format}")
