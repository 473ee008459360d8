"""Modbus/TCP on a real socket, in front of a real cell whose cameras and pipeline do what the test says."""

import asyncio
import struct
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import staged
from binpick import settings
from binpick.cell import Cell
from binpick.cycle import CycleInput, CycleResult
from binpick.errors import Code, NotReady, PortInUse
from binpick.publish.modbus import ModbusServer
from binpick.result import BinMessage, GraspMessage, PoseMessage, Result, ReturnCode, Sigma, ToolMessage
from binpick.settings import Bin, Pose, Recipe
from binpick.settings.cell import ModbusSettings
from binpick.sim.plc import Plc
from servers import with_modbus

QUATERNION = (0.5, -0.5, 0.5, 0.5)
ENABLE, TRIG, RES_ACK, CLEAR_ERR = 1, 2, 4, 16
READY, ACK, NACK, BUSY, ACQ_DONE, VALID, ERROR, SIM = 1, 2, 4, 8, 16, 32, 64, 2048


def grasps(inputs: CycleInput) -> tuple[GraspMessage, ...]:
    """As many as were asked for, 10 mm apart."""
    def one(number: int) -> GraspMessage:
        x = number / 100 + inputs.cycle_id / 1000
        return GraspMessage(
            id=f"{inputs.cycle_id}-{number}", rank=number, tool=ToolMessage(number=1, name="s", kind="suction"), frame="base",
            position_m=(x, -0.25, 1.0), quaternion_xyzw=QUATERNION, open_m=0.0, close_m=0.0, quality=0.9, approach_m=0.08,
            T_frame_pregrasp=PoseMessage(position_m=(x, -0.25, 0.92), quaternion_xyzw=QUATERNION), lift_m=0.15,
            sigma=Sigma(xy_m=0.0003, z_m=0.0004, tilt_rad=0.01), clearance_m=0.003, part_id=number)
    return tuple(one(n + 1) for n in range(inputs.request.max_grasps or 2))


def run(inputs: CycleInput, proceed: Callable[[], None]) -> CycleResult:
    proceed()
    empty = inputs.request.max_grasps == 20
    return CycleResult(Result(
        cycle_id=inputs.cycle_id, request=inputs.request, captured_at=inputs.pair.captured_at, simulated=inputs.simulated,
        return_code=ReturnCode.of(Code.BIN_EMPTY if empty else Code.OK), grasps=() if empty else grasps(inputs),
        bin=BinMessage(found=True, number=1, T_camera_bin=None, fill_level=0.25, coverage=1.0)))


class Wire:
    """A client that knows bytes only."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    async def ask(self, request: str, answers: int = 1) -> str:
        self.writer.write(bytes.fromhex(request))
        return " ".join([await self.answer() for _ in range(answers)])

    async def answer(self) -> str:
        head = await self.reader.readexactly(6)
        return (head + await self.reader.readexactly(int.from_bytes(head[4:], "big"))).hex(" ", 2)

    async def read(self, address: int, count: int = 1, function: int = 4) -> tuple[int, ...]:
        answer = bytes.fromhex(await self.ask(struct.pack(">HHHBBHH", 7, 0, 6, 1, function, address, count).hex()))
        assert answer[7] == function, answer.hex(" ")
        return struct.unpack(f">{count}H", answer[9:])

    async def put(self, address: int, word: int) -> None:
        request = struct.pack(">HHHBBHH", 8, 0, 6, 1, 6, address, word)
        assert bytes.fromhex(await self.ask(request.hex())) == request

    async def until(self, bits: int, limit_s: float = 5.0) -> int:
        async with asyncio.timeout(limit_s):
            while not (status := (await self.read(10))[0]) & bits:
                await asyncio.sleep(0.005)
        return status


@dataclass
class Site:
    """A cell with its server, and the way to it."""

    cell: Cell
    cameras: staged.Cameras
    port: int

    @asynccontextmanager
    async def wire(self) -> AsyncIterator[Wire]:
        client = Wire(*await asyncio.open_connection("127.0.0.1", self.port))
        try:
            yield client
        finally:
            client.writer.close()
            await client.writer.wait_closed()


@asynccontextmanager
async def site(port: int, *, word_order: Literal["ABCD", "CDAB"] = "ABCD", gated: bool = False,
               **changes: object) -> AsyncIterator[Site]:
    cameras = staged.Cameras()
    if not gated:
        cameras.gate.set()
    modbus = ModbusSettings(host="127.0.0.1", port=port, word_order=word_order)
    configured = settings.Cell.model_validate({
        "bins": [Bin(inner_size_m=(0.6, 0.4, 0.18), pose=Pose(position_m=(0, 0, 1)))], "reconnect_s": 0.3,
        "recipes": [Recipe(), Recipe(number=7, pose_format="kuka_abc_deg")], "publish": {"modbus": modbus}, **changes})
    cell = Cell(configured, staged.rig(T_base_rig=np.eye(4).tolist()), cameras, run, boot_id=77)
    async with with_modbus(cell, configured):
        try:
            yield Site(cell, cameras, port)
        finally:
            cameras.gate.set()


def holds(scenario: Callable[[], object]) -> None:
    asyncio.run(scenario())  # type: ignore[arg-type]


EXCHANGES = {
    "FC04": ("0001 0000 0006 11 04 0000 0006", "0001 0000 000f 11 04 0c b1d0 0001 0102 0304 47f1 2000"),
    "FC04 of all unused ends": ("0001 0000 0006 11 04 0167 0001", "0001 0000 0005 11 04 02 5a5a"),
    "FC03": ("0002 0000 0006 00 03 0000 0003", "0002 0000 0009 00 03 06 0000 0000 0000"),
    "FC03 of the mirror": ("0003 0000 0006 ff 03 03e8 0002", "0003 0000 0007 ff 03 04 b1d0 0001"),
    "FC06": ("0004 0000 0006 01 06 0003 0007", "0004 0000 0006 01 06 0003 0007"),
    "FC16": ("0005 0000 000b 01 10 0003 0002 04 0007 0001", "0005 0000 0006 01 10 0003 0002"),
    "coils": ("0006 0000 0006 01 01 0000 0001", "0006 0000 0003 01 81 01"),
    "read/write": ("0006 0000 000d 01 17 0000 0001 0000 0001 02 0001", "0006 0000 0003 01 97 01"),
    "diagnostics": ("0006 0000 0006 01 08 0000 0000", "0006 0000 0003 01 88 01"),
    "input past the end": ("0007 0000 0006 01 04 0167 0002", "0007 0000 0003 01 84 02"),
    "holding past the end": ("0008 0000 0006 01 03 0022 0002", "0008 0000 0003 01 83 02"),
    "mirror past the end": ("0009 0000 0006 01 03 054f 0002", "0009 0000 0003 01 83 02"),
    "between holding and mirror": ("0009 0000 0006 01 03 03e7 0002", "0009 0000 0003 01 83 02"),
    "no words": ("000a 0000 0006 01 04 0000 0000", "000a 0000 0003 01 84 03"),
    "too many words": ("000b 0000 0006 01 04 0000 007e", "000b 0000 0003 01 84 03"),
    "FC06 past the end": ("000c 0000 0006 01 06 0023 0001", "000c 0000 0003 01 86 02"),
    "FC06 into the mirror": ("000d 0000 0006 01 06 03e8 0001", "000d 0000 0003 01 86 02"),
    "FC16 past the end": ("000e 0000 000b 01 10 0022 0002 04 0001 0001", "000e 0000 0003 01 90 02"),
    "FC16 with another byte count": ("000f 0000 000b 01 10 0003 0002 02 0001 0001", "000f 0000 0003 01 90 03"),
    "FC16 cut short": ("0010 0000 0009 01 10 0003 0002 04 0001", "0010 0000 0003 01 90 03"),
    "FC04 cut short": ("0011 0000 0004 01 04 0000", "0011 0000 0003 01 84 03"),
    "FC04 too long": ("0012 0000 0007 01 04 0000 0001 00", "0012 0000 0003 01 84 03"),
}


def test_literal_bytes(free_port: int) -> None:
    async def scenario() -> None:
        async with site(free_port) as here, here.wire() as wire:
            for name, (request, expected) in EXCHANGES.items():
                assert bytes.fromhex(await wire.ask(request)) == bytes.fromhex(expected), name
    holds(scenario)


def test_pipelined_requests_are_all_answered_in_order(free_port: int) -> None:
    async def scenario() -> None:
        async with site(free_port) as here, here.wire() as wire:
            many = b"".join(struct.pack(">HHHBBHH", n, 0, 6, 1, 4, 0, 1) for n in range(100))
            answers = await wire.ask(many.hex(), 100)
            assert bytes.fromhex(answers) == b"".join(struct.pack(">HHHBBBH", n, 0, 5, 1, 4, 2, 0xB1D0) for n in range(100))
            request = bytes.fromhex("0101 0000 0006 01 06 0003 0009 0102 0000 0006 01 03 0003 0001")
            for byte in request:
                wire.writer.write(bytes([byte]))
                await wire.writer.drain()
                await asyncio.sleep(0)
            assert bytes.fromhex(await wire.answer() + await wire.answer()) == bytes.fromhex(
                "0101 0000 0006 01 06 0003 0009 0102 0000 0005 01 03 02 0009")
    holds(scenario)


@pytest.mark.parametrize("garbage", ["474554202f20485454502f312e310d0a", "0001 0000 0001 01", "0001 0000 1000 01 04"])
def test_who_does_not_speak_modbus_is_hung_up_on_after_what_came_before_is_answered(free_port: int, garbage: str) -> None:
    async def scenario() -> None:
        async with site(free_port) as here, here.wire() as wire:
            await wire.ask("0001 0000 0006 01 04 0000 0001" + garbage + "00" * 8)
            assert await wire.reader.read() == b""
    holds(scenario)


@pytest.mark.parametrize(("pose_format", "word_order"), [
    (0, "ABCD"), (1, "CDAB"), (2, "ABCD"), (3, "CDAB"), (4, "ABCD"), (5, "ABCD")])
def test_a_plc_picks_and_reports(free_port: int, pose_format: int, word_order: Literal["ABCD", "CDAB"]) -> None:
    async def scenario() -> None:
        async with site(free_port, word_order=word_order) as here, Plc("127.0.0.1", free_port, word_order) as plc:
            await plc.clear()
            for cycle_id in (1, 2):
                result = await plc.pick(recipe=7 if pose_format == 0 else 0, pose_format=pose_format, frame=3)
                assert (result.return_code, result.seq, result.frame) == (0, cycle_id, 3)
                assert [record.grasp_id for record in result.records] == [1, 2]
                T = result.records[0].T_frame_tcp
                np.testing.assert_allclose(T[:3, 3], [0.01 + cycle_id / 1000, -0.25, 1.0], atol=1e-7)
                np.testing.assert_allclose(T[:3, :3], Rotation.from_quat(QUATERNION).as_matrix(), atol=1e-6)
                assert result.records[0].approach_m == pytest.approx(0.08)
                assert here.cell.snapshot().withdrawn == "acknowledged"
                await plc.report(result.seq, 1, 2)
            assert here.cell.snapshot().counts[:2] == (("acknowledged", 2), ("finished", 2))
            async with here.wire() as wire:
                assert (await wire.read(15))[0] == 0
            await plc.report(9, 1, 2)
            async with here.wire() as wire:
                assert (await wire.read(15))[0] == 0x10000 - 8
    holds(scenario)


def test_a_plc_turns_pages(free_port: int) -> None:
    async def scenario() -> None:
        async with site(free_port), Plc("127.0.0.1", free_port) as plc:
            await plc.clear()
            assert [record.grasp_id for record in (await plc.pick(max_grasps=9)).records] == [*range(1, 10)]
            nothing = await plc.pick(max_grasps=20)
            assert (nothing.return_code, nothing.records) == (102, ())
    holds(scenario)


def test_refusals_reach_the_plc(free_port: int) -> None:
    async def scenario() -> None:
        async with site(free_port), Plc("127.0.0.1", free_port) as plc:
            await plc.clear()
            assert (await plc.pick(recipe=55)).return_code == -22
            assert (await plc.pick(frame=9)).return_code == -1
            assert (await plc.pick()).return_code == 0
    holds(scenario)


def test_a_cell_controlled_by_rest_names_itself(free_port: int) -> None:
    async def scenario() -> None:
        async with site(free_port, control="rest"), Plc("127.0.0.1", free_port) as plc:
            with pytest.raises(NotReady, match="-23"):
                await plc.clear(timeout_s=0.2)
    holds(scenario)


def test_word_by_word_and_the_echo_of_the_handshake(free_port: int) -> None:
    async def scenario() -> None:
        async with site(free_port, gated=True) as here, here.wire() as wire:
            assert not (await wire.read(10))[0] & READY
            await wire.put(0, ENABLE)
            await wire.until(READY)
            for address, word in ((3, 7), (6, 1), (1, 1), (2, 500), (0, ENABLE | TRIG)):
                await wire.put(address, word)
            status = (await wire.read(10))[0]
            assert status == ACK | BUSY | SIM
            await wire.put(2, 501)
            assert (await wire.read(10))[0] == ACK | BUSY | NACK | SIM
            here.cameras.gate.set()
            assert await wire.until(VALID) & (BUSY | ACQ_DONE) == ACQ_DONE
            block = await wire.read(100, 125)
            assert block[:6] == (1, 77, 500, 1, block[4], 0)
            assert block[7:15] == (7, 1, 3, 3, 1, 1, 1, 0)
            assert (0x5A5A + sum(block[:124])) % 65536 == block[124]
            assert block == await wire.read(1100, 125, function=3)
            assert here.cell.snapshot().valid
            await wire.put(0, ENABLE | TRIG | RES_ACK)
            assert not (await wire.read(10))[0] & VALID
            assert not here.cell.snapshot().valid
            await wire.put(0, ENABLE)
            assert (await wire.read(10))[0] & READY
    holds(scenario)


def test_a_command_in_one_block_write(free_port: int) -> None:
    async def scenario() -> None:
        async with site(free_port) as here, here.wire() as wire:
            await wire.put(0, ENABLE)
            await wire.until(READY)
            await wire.ask(struct.pack(">HHHBBHHB9H", 1, 0, 25, 1, 16, 0, 9, 18, ENABLE | TRIG, 1, 3, 0, 0, 0, 0, 0, 900).hex())
            await wire.until(VALID)
            shown = here.cell.snapshot().published
            assert shown is not None
            assert shown.result.request.timeout_ms == 900
    holds(scenario)


@pytest.mark.parametrize("finished", [False, True])
def test_a_killed_client_loses_its_result_after_reconnect_s(free_port: int, finished: bool, clock: Callable[[], float]) -> None:
    async def scenario() -> None:
        async with site(free_port, gated=not finished) as here, here.wire() as watch:
            async with here.wire() as wire:
                await wire.put(0, ENABLE)
                await wire.until(READY)
                await wire.put(1, 1)
                await wire.put(2, 5)
                await wire.put(0, ENABLE | TRIG)
                await wire.until(VALID if finished else BUSY)
                wire.writer.transport.abort()
                killed, killed_s = time.monotonic(), clock()
            await asyncio.sleep(0.1)
            assert (await watch.read(10))[0] & (VALID | BUSY)
            await watch.until(ERROR)
            assert time.monotonic() - killed > 0.25
            assert clock() - killed_s < 1.0
            header = await watch.read(100, 7)
            assert (header[2], header[5], header[6]) == (5, 0x10000 - 26, 4)
            assert not here.cell.snapshot().valid
            here.cameras.gate.set()
            await watch.put(0, ENABLE | TRIG)
            await asyncio.sleep(0.05)
            assert not (await watch.read(10))[0] & (READY | VALID)
            await watch.put(0, ENABLE)
            await watch.until(READY)
    holds(scenario)


def test_a_cycle_ends_with_its_time_limit_though_the_cameras_hang(free_port: int, clock: Callable[[], float]) -> None:
    async def scenario() -> None:
        async with site(free_port, gated=True) as here, Plc("127.0.0.1", free_port) as plc:
            await plc.clear()
            started = clock()
            assert (await plc.pick(timeout_ms=200)).return_code == -3
            assert clock() - started < 1
            with pytest.raises(NotReady, match="-11"):
                await plc.clear(timeout_s=0.2)
            here.cameras.gate.set()
            assert (await plc.pick()).return_code == 0
    holds(scenario)


def test_every_read_is_whole_while_results_come_and_go(free_port: int) -> None:
    async def scenario() -> None:
        async with site(free_port) as here, Plc("127.0.0.1", free_port) as plc, here.wire() as wire:
            await plc.clear()

            async def cycles() -> None:
                for _ in range(15):
                    await plc.pick(max_grasps=4)

            work = asyncio.create_task(cycles())
            seen: set[int] = set()
            while not work.done():
                block = await wire.read(100, 125)
                assert (0x5A5A + sum(block[:124])) % 65536 == block[124]
                poses = [block[first] for first in (20, 46, 72, 98) if block[first + 16] & 1]
                assert poses == ([block[0]] * 4 if block[4] & VALID else [])
                seen |= {block[0]} if poses else set()
            await work
            assert seen
    holds(scenario)


def test_the_heartbeat_counts_ten_times_a_second(free_port: int) -> None:
    async def scenario() -> None:
        async with site(free_port) as here, here.wire() as wire:
            first = (await wire.read(11))[0]
            await asyncio.sleep(0.55)
            assert 3 <= (await wire.read(11))[0] - first <= 7
    holds(scenario)


def test_a_plc_whose_heartbeat_stops_is_no_longer_served(free_port: int) -> None:
    async def scenario() -> None:
        async with site(free_port) as here, here.wire() as wire:
            await wire.put(9, 1)
            await wire.put(0, ENABLE)
            await wire.until(READY)
            async with asyncio.timeout(4):
                while (await wire.read(10))[0] & READY:
                    await asyncio.sleep(0.02)
            assert (await wire.read(15))[0] == 0x10000 - 11
            await wire.put(9, 2)
            await wire.until(READY)
    holds(scenario)


def test_a_foreign_client_reads_the_same_words(free_port: int) -> None:
    if not Path("/usr/bin/mbpoll").exists():
        pytest.skip("mbpoll is not installed")

    async def mbpoll(*options: str) -> str:
        process = await asyncio.create_subprocess_exec(
            "/usr/bin/mbpoll", "-m", "tcp", "-p", str(free_port), "-0", "-1", "-q", *options, "127.0.0.1",
            stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT)
        output, _ = await process.communicate()
        assert process.returncode == 0, output.decode()
        return output.decode()

    async def scenario() -> None:
        async with site(free_port) as here, here.wire() as wire:
            await wire.put(6, 3)
            assert "0xB1D0" in await mbpoll("-t", "3:hex", "-r", "0", "-c", "1")
            assert "123456" in await mbpoll("-t", "3:float", "-B", "-r", "4", "-c", "1")
            assert "0x5A5A" in await mbpoll("-t", "4:hex", "-r", "1359", "-c", "1")
            assert "[100]: \t3" in (await mbpoll("-t", "4", "-r", "6", "-c", "1")).replace("[6]", "[100]")
            await wire.put(0, ENABLE)
            await wire.until(READY)
            assert (await mbpoll("-t", "3", "-r", "100", "-c", "125")).count("[") >= 125
    holds(scenario)


def test_a_port_in_use_is_named(free_port: int) -> None:
    async def scenario() -> None:
        async with site(free_port) as here:
            modbus = ModbusSettings(host="127.0.0.1", port=free_port)
            second = ModbusServer(here.cell, here.cell, modbus, settings.Cell(bins=(Bin(inner_size_m=(1, 1, 1), pose=Pose()),)))
            with pytest.raises(PortInUse, match=str(free_port)):
                await second.start()
            await second.stop()
    holds(scenario)
