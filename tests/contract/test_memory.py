"""The memory of outcomes in a living cell: told over Modbus and REST, kept on disk, forgotten when the bin is exchanged.

The pipeline is the real one; the cameras show one picture, of two blocks, until the test shows another.
"""

import asyncio
import json
import os
import signal
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx
import numpy as np
import pytest

import staged
from binpick import geometry, pipeline, recording, settings
from binpick.cell import Cell
from binpick.cell.store import DAMAGED, NAME, Store
from binpick.data import Image, Light
from binpick.errors import Busy, Code, InputError, NotInControl, UnknownItem
from binpick.outcomes import Attempt, Grid, Memory
from binpick.result import Request
from binpick.sim import exam
from binpick.sim.plc import Plc, PlcResult
from binpick.sim.render import Renderer
from binpick.sim.world import ScenePart, WorldScene
from servers import START_S, on_a_thread, recorder, until, with_modbus

OK, MISSED, SKIPPED = 1, 2, 5
SPOT_M = 0.010
BLOCKS = (geometry.translation(0.0, 0.0, 0.0075), geometry.translation(0.08, 0.03, 0.0075))


RIG = staged.small_exam_rig()


@pytest.fixture(scope="module")
def pictures() -> Callable[..., tuple[Image, Image]]:
    """pictures(T_bin_part, ...): blocks in the exam's small bin."""
    renderer, light = Renderer(RIG, "B"), settings.resolve(exam.cell("B")).recipe.lights[0]

    def take(*blocks: geometry.Transform) -> tuple[Image, Image]:
        scene = WorldScene("B", tuple(ScenePart(i, "block", T) for i, T in enumerate(blocks, start=1)), 1, 1)
        left, right = (renderer.expose(scene, index, light, 1) for index in (0, 1))
        return left, right

    return take


@pytest.fixture(scope="module")
def two_blocks(pictures: Callable[..., tuple[Image, Image]]) -> tuple[Image, Image]:
    return pictures(*BLOCKS)


@dataclass
class Showing(staged.Cameras):
    """They see what is `shown`."""

    shown: tuple[Image, Image]

    def images(self, light: Light) -> tuple[Image, Image]:
        return self.shown


def showing(images: tuple[Image, Image]) -> Showing:
    cameras = Showing(images)
    cameras.gate.set()
    return cameras


def configured(port: int, folder: Path | None, **changes: object) -> settings.Cell:
    return exam.cell("B", memory={"directory": folder}, publish={"modbus": {"host": "127.0.0.1", "port": port}},
                     timeout_ms=30_000, **changes)


@asynccontextmanager
async def controlled(port: int, cameras: Showing, folder: Path | None = None,
                     **changes: object) -> AsyncIterator[tuple[Cell, Plc]]:
    cell_settings = configured(port, folder, **changes)
    cell = Cell(cell_settings, RIG, cameras, boot_id=77)
    async with with_modbus(cell, cell_settings), Plc("127.0.0.1", port) as plc:
        yield cell, plc


def spots(result: PlcResult) -> np.ndarray:
    return np.array([record.T_frame_tcp[:3, 3] for record in result.records])


def offers(result: PlcResult, spot: np.ndarray) -> bool:
    return bool((np.linalg.norm(spots(result) - spot, axis=1) < SPOT_M).any())


async def look(plc: Plc) -> PlcResult:
    return await plc.pick(frame=2, timeout_ms=30_000)


def test_a_miss_told_over_modbus_is_not_offered_again_until_the_bin_is_exchanged(
        free_port: int, two_blocks: tuple[Image, Image], tmp_path: Path) -> None:
    async def scenario() -> None:
        async with controlled(free_port, showing(two_blocks), tmp_path / "state") as (cell, plc):
            first = await look(plc)
            missed = spots(first)[0]
            for _ in range(2):                                       # a report that is repeated counts once
                await plc.report(first.seq, first.records[0].grasp_id, MISSED)
            second = await look(plc)
            assert second.return_code == 0
            assert not offers(second, missed)
            assert np.linalg.norm(spots(second)[0] - missed) > 0.06  # the other block
            await plc.report(first.seq, first.records[0].grasp_id, OK)
            assert offers(await look(plc), missed)                   # the later word counts
            await plc.report(first.seq, first.records[0].grasp_id, MISSED)
        async with controlled(free_port, showing(two_blocks), tmp_path / "state") as (cell, plc):
            assert not offers(await look(plc), missed)               # remembered by the next daemon
            assert await plc.exchanged() == 0
            assert not cell.snapshot().valid
            assert offers(await look(plc), missed)
        async with controlled(free_port, showing(two_blocks), tmp_path / "state") as (_, plc):
            assert offers(await look(plc), missed)                   # forgotten on disk too

    asyncio.run(scenario())


def test_a_pick_nobody_speaks_of_is_verified_by_the_next_look(
        free_port: int, two_blocks: tuple[Image, Image], pictures: Callable[..., tuple[Image, Image]],
        caplog: pytest.LogCaptureFixture) -> None:
    def verdicts() -> list[str]:
        said = [record.getMessage() for record in caplog.records if "by the cameras" in record.getMessage()]
        caplog.clear()
        return said

    async def scenario() -> None:
        cameras = showing(two_blocks)
        async with controlled(free_port, cameras) as (_, plc):
            first = await look(plc)
            await look(plc)
            assert verdicts() == []                                  # nobody is known to pick here
            picked = int(np.linalg.norm(spots(first)[0][:2] - BLOCKS[0][:2, 3]) > 0.03)
            cameras.shown = pictures(BLOCKS[1 - picked])
            third = await look(plc)
            assert verdicts() == ["cycle 2 grasp 1: outcome 1 by the cameras"]
            fourth = await look(plc)
            assert verdicts() == ["cycle 3 grasp 1: outcome 2 by the cameras"]
            assert fourth.return_code == 0
            assert fourth.records[0].quality < 0.3 < third.records[0].quality
            assert (await look(plc)).return_code == Code.ALL_BLOCKED_BY_HISTORY
            assert await plc.exchanged() == 0
            fresh = await look(plc)
            assert fresh.records[0].quality == third.records[0].quality
            await plc.report(fresh.seq, fresh.records[0].grasp_id, SKIPPED)
            verdicts()
            assert spots(await look(plc)).shape == spots(fresh).shape
            assert verdicts() == []                                  # a controller that speaks is believed

    with caplog.at_level("INFO", "binpick.cell.worker"):
        asyncio.run(scenario())


def test_when_everything_has_failed_the_code_is_104(free_port: int, two_blocks: tuple[Image, Image]) -> None:
    async def scenario() -> None:
        async with controlled(free_port, showing(two_blocks)) as (cell, plc):
            for _ in range(10):
                result = await look(plc)
                if not result.records:
                    break
                for record in result.records:
                    await plc.report(result.seq, record.grasp_id, MISSED)
            assert result.return_code == Code.ALL_BLOCKED_BY_HISTORY
            latest = cell.snapshot().latest
            assert latest is not None
            assert "stir the bin" in latest.result.return_code.message

    asyncio.run(scenario())


def test_the_exchange_of_an_unknown_bin_is_refused(free_port: int, two_blocks: tuple[Image, Image]) -> None:
    async def scenario() -> None:
        async with controlled(free_port, showing(two_blocks)) as (cell, plc):
            assert await plc.exchanged(bin_number=9) == Code.UNKNOWN_ITEM
            with pytest.raises(NotInControl):
                cell.forget(1, "rest")
            with pytest.raises(UnknownItem):
                cell.forget(9, "modbus")

    asyncio.run(scenario())


def test_no_bin_is_exchanged_under_a_running_cycle(two_blocks: tuple[Image, Image], free_port: int) -> None:
    async def scenario() -> None:
        cameras = Showing(two_blocks)
        async with Cell(configured(free_port, None, control="rest"), RIG, cameras, boot_id=7) as cell:
            while cell.snapshot().phase != "ready":
                await asyncio.sleep(0.005)
            cell.start(Request(), "rest")
            with pytest.raises(Busy, match="say that the bin was exchanged when it has ended"):
                cell.forget(1, "rest")
            cell.abort(1, "rest")
            cameras.gate.set()

    asyncio.run(scenario())


@contextmanager
def serving(port: int, images: tuple[Image, Image], folder: Path | None = None,
            recordings: Path | None = None) -> Iterator[tuple[httpx.Client, Cell]]:
    with recorder(recordings) as recording_it:
        cell = Cell(configured(port, folder, control="rest"), RIG, showing(images), boot_id=7, recorder=recording_it)
        with on_a_thread(cell, cell, port) as client:
            until(lambda: cell.snapshot().phase == "ready", START_S)
            yield client, cell


def test_outcomes_told_over_rest_are_remembered_and_recorded(
        free_port: int, two_blocks: tuple[Image, Image], tmp_path: Path) -> None:
    def cycle(client: httpx.Client) -> list[dict[str, object]]:
        grasps: list[dict[str, object]] = client.post("/v1/cycles?wait=true", json={"frame": "bin"}).json()["grasps"]
        return grasps

    def near(grasps: list[dict[str, object]], spot: object) -> bool:
        return any(np.linalg.norm(np.subtract(grasp["position_m"], spot)) < SPOT_M for grasp in grasps)  # type: ignore[arg-type]

    with serving(free_port, two_blocks, tmp_path / "state", tmp_path / "recordings") as (client, _):
        first = cycle(client)
        for code in (OK, MISSED, MISSED):
            assert client.post(f"/v1/cycles/1/grasps/{first[0]['id']}/outcome", json={"code": code}).status_code == 204
        assert not near(cycle(client), first[0]["position_m"])
        assert near(cycle(client), first[1]["position_m"])
    replayed = sorted((tmp_path / "recordings").iterdir())[1]
    inputs, stored = recording.load(replayed)
    assert [attempt.outcome for attempt in inputs.memory.attempts] == [MISSED]
    assert pipeline.run(inputs).result.timeless_bytes() == stored.timeless_bytes()
    document = json.loads((tmp_path / "state" / NAME).read_text())
    assert [attempt["outcome"] for attempt in document["bins"]["1"]["attempts"]] == [MISSED]


def test_a_damaged_file_is_set_aside_and_an_alarm(free_port: int, two_blocks: tuple[Image, Image], tmp_path: Path) -> None:
    for body in (b"", b'{"format": "binpick-memory", "version": 1, "bins": {"1": [{', b"\xff\xfe", b'{"version": 9}'):
        (tmp_path / NAME).write_bytes(body)
        with serving(free_port, two_blocks, tmp_path) as (client, _):
            document = client.get("/v1/health").json()
            assert document["status"] == "degraded"
            assert any("memory.json is damaged" in reason for reason in document["reasons"])
            assert (tmp_path / DAMAGED).read_bytes() == body
            assert not (tmp_path / NAME).exists()


def test_a_disk_that_refuses_is_an_alarm_and_the_cell_goes_on(
        free_port: int, two_blocks: tuple[Image, Image], tmp_path: Path) -> None:
    folder = tmp_path / "state"
    with serving(free_port, two_blocks, folder) as (client, cell):
        grasps = client.post("/v1/cycles?wait=true", json={"frame": "bin"}).json()["grasps"]
        folder.rmdir()
        folder.write_text("in the way")
        assert client.post(f"/v1/cycles/1/grasps/{grasps[0]['id']}/outcome", json={"code": MISSED}).status_code == 204
        until(lambda: cell.snapshot().faults)
        assert "will not survive a restart" in cell.snapshot().faults[0]
        assert client.post("/v1/cycles?wait=true", json={"frame": "bin"}).json()["return_code"]["value"] == 0


def test_a_folder_that_cannot_be_made_stops_the_start(free_port: int, two_blocks: tuple[Image, Image], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match=r"memory\.directory"):
        Cell(configured(free_port, tmp_path / "file" / "state"), RIG, showing(two_blocks), boot_id=7)


def remembered(count: int) -> dict[int, Memory]:
    patch = Grid.of(np.random.default_rng(count).integers(0, 999, (20, 20)).astype(np.int16))
    attempts = (Attempt(captured_at="2026-01-01T00:00:00Z", cycle_id=n, grasp=1, tool=1, position_m=(0.0, 0.0, 0.1),
                        approach=(0.0, 0.0, -1.0), reach_m=0.02, patch=patch, outcome=MISSED) for n in range(1, count + 1))
    return {1: Memory(attempts=tuple(attempts))}


def test_a_process_killed_at_any_moment_leaves_a_whole_file(tmp_path: Path) -> None:
    store, states = Store(tmp_path), [remembered(count) for count in (1, 40, 200)]
    store.save(states[0])                             # the first child may be killed before it wrote anything
    for number in range(12):
        child = os.fork()
        if child == 0:                                # nothing of pytest may run here
            while True:
                for state in states:
                    store.save(state)
        time.sleep(0.02 + 0.007 * number)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        memories, trouble = store.load()
        assert trouble == ""
        assert memories in states
