"""The living cell: a worker thread, a supervisor on the loop, and cameras that do what the test says."""

import asyncio
import threading
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import pytest

import staged
from binpick import health, pipeline, settings
from binpick.camera.group import CameraGroup
from binpick.cell import Cell, worker
from binpick.cell.worker import Pose as PoseStep
from binpick.cycle import CycleInput, CycleResult
from binpick.data import CameraStatus, Frame, Light, StereoPair, frozen
from binpick.errors import (
    Busy,
    CameraLost,
    Code,
    FrameUnavailable,
    InputError,
    NotApplicable,
    NotInControl,
    NotReady,
    UnknownItem,
)
from binpick.result import PartMessage, Request, Result, ReturnCode, Snapshot
from binpick.settings import Bin, Pose, Recipe
from binpick.sim.camera import SimCamera


def cell_settings(**changes: object) -> settings.Cell:
    return settings.Cell.model_validate({
        "bins": [Bin(inner_size_m=(0.6, 0.4, 0.18), pose=Pose(position_m=(0, 0, 1)))], "recipes": [Recipe(frame="camera")],
        "control": "rest", **changes})


def pair(triggered_ns: int, light: Light) -> StereoPair:
    frames = [Frame(frozen(np.zeros((24, 32), np.uint8)), name, 1, 1, triggered_ns, triggered_ns, triggered_ns,
                    light.exposure_us, light.gain_db) for name in ("left", "right")]
    return StereoPair(frames[0], frames[1], "2026-01-02T03:04:05.678Z", 0.0, 0.0, "simulated")


@dataclass
class TestCameras:
    """Cameras of the test: `gate` holds a capture, `broken` names the camera that is dead, `stale` pairs are of long ago."""

    __test__ = False
    broken: str = ""
    opened: bool = False
    stale: bool = False
    stale_from: int = 1
    captures: list[Light] = field(default_factory=list)
    attempts: int = 0
    closed: int = 0
    gate: threading.Event = field(default_factory=threading.Event)

    def open(self, deadline_ns: int) -> None:
        self.attempts += 1
        if self.broken:
            raise CameraLost(f"camera {self.broken} is dead", self.broken)
        self.opened = True

    def capture(self, light: Light, deadline_ns: int) -> StereoPair:
        self.captures.append(light)
        triggered_ns = 1 if self.stale and len(self.captures) >= self.stale_from else time.monotonic_ns()
        self.gate.wait()
        if self.broken:
            self.opened = False
            raise CameraLost(f"camera {self.broken} is dead", self.broken)
        return pair(triggered_ns, light)

    def close(self) -> None:
        self.closed += 1

    def watch(self) -> bool:
        return False

    def statuses(self) -> tuple[CameraStatus, ...]:
        return tuple(CameraStatus(name, self.opened, simulated=True, error="dead" if self.broken == name else "")
                     for name in ("left", "right"))


def good(inputs: CycleInput, proceed: Callable[[], None]) -> CycleResult:
    proceed()
    return CycleResult(Result(cycle_id=inputs.cycle_id, request=inputs.request, captured_at=inputs.pair.captured_at,
                              simulated=inputs.simulated, return_code=ReturnCode.of(Code.BIN_EMPTY), bin=None,
                              timing_ms={"match": 1.0}))


@asynccontextmanager
async def living(cameras: TestCameras, run: Callable[[CycleInput, Callable[[], None]], CycleResult] = good,
                 ready: bool = True, pose: PoseStep = pipeline.poses, **changes: object) -> AsyncIterator[Cell]:
    cell = Cell(cell_settings(**changes), staged.rig(), cameras, run, boot_id=7, pose=pose)
    async with cell:
        if ready:
            await until(cell, lambda s: s.phase == "ready")
        try:
            yield cell
        finally:
            cameras.gate.set()


async def until(cell: Cell, condition: Callable[[Snapshot], bool], limit_s: float = 5.0) -> Snapshot:
    changed = cell.subscribe()
    try:
        async with asyncio.timeout(limit_s):
            while not condition(cell.snapshot()):
                changed.clear()
                if condition(cell.snapshot()):
                    break
                await changed.wait()
    finally:
        cell.unsubscribe(changed)
    return cell.snapshot()


def released() -> TestCameras:
    cameras = TestCameras()
    cameras.gate.set()
    return cameras


def test_a_cycle_is_captured_computed_and_published() -> None:
    async def scenario() -> None:
        cameras = TestCameras()
        async with living(cameras) as cell:
            cycle_id = cell.start(Request(request_id="mine"), "rest")
            assert cell.snapshot().current == cycle_id == 1
            cameras.gate.set()
            shown = await until(cell, lambda s: s.valid)
            assert shown.phase == "ready"
            assert shown.published is not None
            result = shown.published.result
            assert (result.cycle_id, result.request.request_id, result.return_code.code) == (1, "mine", Code.BIN_EMPTY)
            assert list(result.timing_ms) == ["acquire", "match", "total"]
            assert result.simulated
            assert shown.published.body == result.json_bytes()
            assert cell.finished(1) is shown.published
            assert cameras.captures[0].exposure_us == 6000.0
            cell.acknowledge(1, "rest")
            assert (cell.snapshot().valid, cell.snapshot().withdrawn) == (False, "acknowledged")
            cell.start(Request(), "rest")
            assert (await until(cell, lambda s: s.valid)).latest is cell.finished(2)
        assert cameras.closed == 1

    asyncio.run(scenario())


def test_a_busy_cell_refuses_at_once_and_only_its_owner_may_ask() -> None:
    async def scenario() -> None:
        async with living(TestCameras()) as cell:
            cell.start(Request(), "rest")
            with pytest.raises(Busy):
                cell.start(Request(), "rest")
            with pytest.raises(NotInControl, match="controlled by rest"):
                cell.start(Request(), "modbus")
            for ask in (lambda: cell.abort(1, "modbus"), lambda: cell.acknowledge(1, "modbus"),
                        lambda: cell.withdraw("gone", "modbus"), lambda: cell.report(1, 1, 1, "modbus")):
                with pytest.raises(NotInControl):
                    ask()
            assert dict(cell.snapshot().counts)["refused"] == 2

    asyncio.run(scenario())


def test_a_bad_request_is_refused_by_name_and_starts_nothing() -> None:
    async def scenario() -> None:
        async with living(released()) as cell:
            for request, error in ((Request(recipe=9), UnknownItem), (Request(tool=9), UnknownItem),
                                   (Request(bin=9), UnknownItem), (Request(frame="base"), FrameUnavailable)):
                with pytest.raises(error):
                    cell.start(request, "rest")
            assert (cell.snapshot().phase, cell.snapshot().counts) == ("ready", ())

    asyncio.run(scenario())


def test_a_stuck_worker_delays_neither_the_timeout_nor_its_successor_once_it_is_back(clock: Callable[[], float]) -> None:
    async def scenario() -> None:
        cameras = TestCameras()
        async with living(cameras) as cell:
            started = clock()
            cell.start(Request(timeout_ms=100), "rest")
            shown = await until(cell, lambda s: s.valid)
            assert clock() - started < 2
            assert shown.published is not None
            assert shown.published.result.return_code.code is Code.TIMEOUT
            assert (shown.current, shown.phase) == (0, "starting")
            with pytest.raises(Busy, match="withdrawn"):
                cell.start(Request(), "rest")
            cameras.gate.set()
            await until(cell, lambda s: s.phase == "ready")
            cell.start(Request(), "rest")
            shown = await until(cell, lambda s: s.valid)
            assert shown.published is not None
            assert shown.published.result.cycle_id == 2
            assert cell.finished(1) is not None

    asyncio.run(scenario())


def test_a_late_result_is_dropped_and_counted() -> None:
    gate = threading.Event()

    def slow(inputs: CycleInput, _proceed: Callable[[], None]) -> CycleResult:
        gate.wait()
        return good(inputs, lambda: None)

    async def scenario() -> None:
        async with living(released(), slow) as cell:
            cell.start(Request(timeout_ms=100), "rest")
            await until(cell, lambda s: s.valid)
            gate.set()
            shown = await until(cell, lambda s: s.phase == "ready")
            assert dict(shown.counts)["late"] == 1
            assert shown.published is not None
            assert shown.published.result.return_code.code is Code.TIMEOUT

    asyncio.run(scenario())


def test_abort_ends_the_cycle_between_two_stages() -> None:
    inside, stages = threading.Event(), []
    gate = threading.Event()

    def staged(inputs: CycleInput, proceed: Callable[[], None]) -> CycleResult:
        inside.set()
        gate.wait()
        proceed()
        stages.append("second")
        return good(inputs, proceed)

    async def scenario() -> None:
        async with living(released(), staged) as cell:
            cycle_id = cell.start(Request(), "rest")
            await asyncio.to_thread(inside.wait)
            assert cell.snapshot().phase == "computing"
            assert cell.snapshot().acquired
            cell.abort(cycle_id, "rest")
            kept = cell.finished(cycle_id)
            assert kept is not None
            assert kept.result.return_code.code is Code.ABORTED
            with pytest.raises(NotApplicable):
                cell.abort(cycle_id, "rest")
            gate.set()
            shown = await until(cell, lambda s: s.phase == "ready")
            assert stages == []
            assert "late" not in dict(shown.counts)

    asyncio.run(scenario())


def test_dead_cameras_fail_the_cycle_by_name_then_are_opened_again() -> None:
    async def scenario() -> None:
        cameras = TestCameras()
        async with living(cameras) as cell:
            cell.start(Request(), "rest")
            cameras.broken = "right"
            cameras.gate.set()
            shown = await until(cell, lambda s: s.valid)
            assert shown.published is not None
            assert shown.published.result.return_code.code is Code.CAMERAS
            assert "right" in shown.published.result.return_code.message
            assert shown.phase == "starting"
            with pytest.raises(NotReady, match="right"):
                cell.start(Request(), "rest")
            cameras.broken = ""
            await until(cell, lambda s: s.phase == "ready")
            cell.start(Request(), "rest")
            await until(cell, lambda s: s.valid)

    asyncio.run(scenario())


def test_a_pair_older_than_the_cycle_is_never_computed() -> None:
    async def scenario() -> None:
        cameras = released()
        cameras.stale = True
        async with living(cameras) as cell:
            cell.start(Request(), "rest")
            shown = await until(cell, lambda s: s.valid)
            assert shown.published is not None
            code = shown.published.result.return_code
            assert (code.code, code.message) == (Code.CAMERAS, "the cameras gave a pair that is older than the trigger")

    asyncio.run(scenario())


SHOTS = Recipe(frame="camera", shots=({}, {"exposure_us": 1200.0}, {"projector": False}))  # type: ignore[arg-type]


def test_all_shots_are_taken_in_order_before_the_images_count_as_acquired() -> None:
    async def scenario() -> None:
        cameras, seen = TestCameras(), []

        def run(inputs: CycleInput, proceed: Callable[[], None]) -> CycleResult:
            seen.append(inputs)
            return good(inputs, proceed)

        async with living(cameras, run, recipes=[SHOTS]) as cell:
            cell.start(Request(), "rest")
            await asyncio.sleep(0.05)
            assert not cell.snapshot().acquired
            cameras.gate.set()
            shown = await until(cell, lambda s: s.valid)
            (inputs,) = seen
            assert [(light.exposure_us, light.projector) for light in cameras.captures] == [
                (6000.0, True), (1200.0, True), (6000.0, False)]
            assert [pair.left.exposure_us for pair in inputs.pairs] == [6000.0, 1200.0, 6000.0]
            assert shown.published is not None
            assert shown.published.triggered_ns == inputs.pair.left.triggered_ns

    asyncio.run(scenario())


def test_auto_exposure_is_found_before_the_first_cycle_and_its_test_shots_are_never_matched() -> None:
    async def scenario() -> None:
        cameras, seen = released(), []

        def run(inputs: CycleInput, proceed: Callable[[], None]) -> CycleResult:
            seen.append(inputs)
            return good(inputs, proceed)

        auto = Recipe(frame="camera", exposure_us="auto", projector="alternate")
        async with living(cameras, run, recipes=[auto]) as cell:
            assert not cameras.captures                            # before a trigger the robot may stand in the way
            for _ in range(2):
                started = cell.start(Request(), "rest")
                await until(cell, lambda s, started=started: s.valid and s.latest.result.cycle_id == started)
        first, second = seen
        assert [inputs.metering for inputs in seen] == ["too_dark", "too_dark"]          # these cameras see nothing at all
        assert [len(inputs.pairs) for inputs in seen] == [2, 2]
        tests = len(cameras.captures) - 4
        assert 4 <= tests <= 10
        assert [light.projector for light in cameras.captures[tests:]] == [True, False] * 2
        longest = auto.auto.longest_us, auto.auto.highest_gain_db
        assert {(light.exposure_us, light.gain_db) for light in (*first.lights, *second.lights)} == {longest}

    asyncio.run(scenario())


def test_a_later_shot_that_is_stale_fails_the_cycle() -> None:
    async def scenario() -> None:
        cameras = released()
        cameras.stale, cameras.stale_from = True, 3
        async with living(cameras, recipes=[SHOTS]) as cell:
            cell.start(Request(), "rest")
            shown = await until(cell, lambda s: s.valid)
            assert shown.published is not None
            assert shown.published.result.return_code.code is Code.CAMERAS
            assert len(cameras.captures) == 3

    asyncio.run(scenario())


def test_a_cycle_withdrawn_between_two_shots_takes_no_more() -> None:
    async def scenario() -> None:
        cameras = TestCameras()
        async with living(cameras, recipes=[SHOTS]) as cell:
            cycle_id = cell.start(Request(), "rest")
            while not cameras.captures:
                await asyncio.sleep(0.005)
            cell.abort(cycle_id, "rest")
            cameras.gate.set()
            await until(cell, lambda s: s.phase == "ready")
            assert len(cameras.captures) == 1

    asyncio.run(scenario())


@pytest.mark.parametrize("fail", ["dead", pytest.param("stuck", marks=pytest.mark.slow)])
def test_two_cameras_killed_in_mid_cycle_fail_it_within_two_seconds_by_name(fail: Literal["dead", "stuck"],
                                                                            clock: Callable[[], float]) -> None:
    exposing = threading.Event()

    def sleep(seconds: float) -> None:
        exposing.set()
        time.sleep(seconds)

    def expose(index: int, light: Light, shot: int) -> np.ndarray:
        return np.zeros((24, 32), np.uint8)

    async def scenario() -> None:
        eyes = (SimCamera(0, expose, sleep=sleep), SimCamera(1, expose, sleep=sleep))
        slow = cell_settings(recipes=[Recipe(frame="camera", exposure_us=300_000)])
        cell = Cell(slow, staged.rig(), CameraGroup(eyes, 5000.0), good, boot_id=7)
        async with cell:
            await until(cell, lambda s: s.phase == "ready")
            cell.start(Request(), "rest")
            await asyncio.to_thread(exposing.wait)
            for eye in eyes:
                eye.fail = fail
            killed = clock()
            shown = await until(cell, lambda s: s.valid)
            assert clock() - killed < 2
            assert shown.published is not None
            assert shown.published.result.return_code.code is Code.CAMERAS
            reasons = " ".join(health.judge(shown).reasons)
            assert "camera left is down" in reasons
            assert "camera right is down" in reasons
            for eye in eyes:
                eye.fail = ""
            await until(cell, lambda s: s.phase == "ready", 15)

    asyncio.run(scenario())


def test_an_idle_cameras_death_and_return_need_no_trigger(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "BACKOFF_S", (60.0,))

    async def scenario() -> None:
        eyes = tuple(SimCamera(index, lambda *_: np.zeros((24, 32), np.uint8)) for index in (0, 1))
        async with Cell(cell_settings(), staged.rig(), CameraGroup(eyes, 5000.0), good, boot_id=7) as cell:
            await until(cell, lambda s: s.phase == "ready")
            eyes[1].fail = "dead"
            shown = await until(cell, lambda s: s.phase == "starting")
            assert health.judge(shown).reasons == ("camera right is down: the right camera does not answer",)
            eyes[1].fail = ""
            shown = await until(cell, lambda s: s.phase == "ready")      # though the next attempt is not due for a minute
            assert health.judge(shown).reasons == ()

    asyncio.run(scenario())


def test_a_death_is_told_while_poses_are_computed() -> None:
    told = threading.Event()

    def pose(inputs: CycleInput, cycle: CycleResult, proceed: Callable[[], None]) -> CycleResult:
        eyes[1].fail = "dead"
        while not told.wait(0.01):
            proceed()
        return cycle

    async def scenario() -> None:
        async with Cell(cell_settings(), staged.rig(), CameraGroup(eyes, 5000.0), good, boot_id=7, pose=pose) as cell:
            await until(cell, lambda s: s.phase == "ready")
            cell.start(Request(), "rest")
            try:
                shown = await until(cell, lambda s: s.valid and s.phase == "starting")
            finally:
                told.set()
            assert [bool(camera.error) for camera in shown.cameras] == [False, True]

    eyes = tuple(SimCamera(index, lambda *_: np.zeros((24, 32), np.uint8)) for index in (0, 1))
    asyncio.run(scenario())


def test_cameras_that_stay_away_are_one_line_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    async def scenario() -> None:
        cameras = TestCameras(broken="left")
        async with living(cameras, ready=False):
            while cameras.attempts < 3:
                await asyncio.sleep(0.01)

    asyncio.run(scenario())
    assert [record.getMessage() for record in caplog.records if "not open" in record.getMessage()] == [
        "cameras not open: camera left is dead"]


def test_an_error_of_ours_fails_one_cycle_and_stays_visible_until_a_good_one() -> None:
    failing = [True]

    def fragile(inputs: CycleInput, proceed: Callable[[], None]) -> CycleResult:
        if failing[0]:
            raise ZeroDivisionError("planted")
        return good(inputs, proceed)

    async def scenario() -> None:
        async with living(released(), fragile) as cell:
            cell.start(Request(), "rest")
            shown = await until(cell, lambda s: s.valid)
            assert shown.published is not None
            code = shown.published.result.return_code
            assert (code.code, code.message) == (Code.NOT_READY, "internal error, see the log")
            assert (shown.faults, shown.phase) == (("internal error, see the log",), "ready")
            failing[0] = False
            cell.start(Request(), "rest")
            assert (await until(cell, lambda s: s.valid)).faults == ()

    asyncio.run(scenario())


def test_a_pipeline_error_of_the_tree_keeps_its_code() -> None:
    def refuse(inputs: CycleInput, proceed: Callable[[], None]) -> CycleResult:
        raise InputError("the images are of another size than the rig")

    async def scenario() -> None:
        async with living(released(), refuse) as cell:
            cell.start(Request(), "rest")
            shown = await until(cell, lambda s: s.valid)
            assert shown.published is not None
            assert shown.published.result.return_code.code is Code.BAD_ARGUMENT
            assert shown.faults == ()

    asyncio.run(scenario())


def test_an_unread_result_expires() -> None:
    async def scenario() -> None:
        async with living(released(), result_max_age_ms=500) as cell:
            cell.start(Request(), "rest")
            await until(cell, lambda s: s.valid)
            shown = await until(cell, lambda s: not s.valid)
            assert shown.withdrawn == "older than 500 ms"
            assert shown.published is not None

    asyncio.run(scenario())


def test_a_controller_that_goes_away_takes_its_cycle_along() -> None:
    async def scenario() -> None:
        cameras = TestCameras()
        async with living(cameras) as cell:
            cell.start(Request(), "rest")
            cell.withdraw("the connection was lost", "rest")
            shown = cell.snapshot()
            assert (shown.current, shown.valid, shown.withdrawn) == (0, False, "the connection was lost")
            assert shown.latest is not None
            assert shown.latest.result.return_code.code is Code.ABORTED

    asyncio.run(scenario())


def test_stopping_ends_waiters_at_once_and_abandons_a_stuck_worker() -> None:
    async def scenario() -> None:
        cameras = TestCameras()
        cell = Cell(cell_settings(), staged.rig(), cameras, good, boot_id=7)
        cell.launch()
        await until(cell, lambda s: s.phase == "ready")
        cell.start(Request(), "rest")
        while not cameras.captures:
            await asyncio.sleep(0.005)
        cell.stop()
        shown = cell.snapshot()
        assert (shown.phase, shown.current, shown.valid) == ("stopping", 0, False)
        with pytest.raises(NotReady, match="stopping"):
            cell.start(Request(), "rest")
        assert not await cell.close(0.05)
        cameras.gate.set()
        assert await cell.close(2)

    asyncio.run(scenario())


PART = PartMessage(id=3, part_ids=(3,), label="bracket", frame="bin", score=0.9, T_frame_part=None)


def test_poses_follow_the_grasps_in_the_same_place() -> None:
    allowed = threading.Event()

    def pose(_inputs: CycleInput, cycle: CycleResult, _proceed: Callable[[], None]) -> CycleResult:
        allowed.wait(5)
        return replace(cycle, result=cycle.result.model_copy(update={"parts": (PART,)}))

    async def scenario() -> None:
        async with living(released(), pose=pose) as cell:
            cycle_id = cell.start(Request(), "rest")
            before = await until(cell, lambda s: s.published is not None)
            assert before.published is not None
            assert not before.published.result.parts
            allowed.set()
            after = await until(cell, lambda s: s.published is not before.published)
            assert after.published is not None
            assert after.published is after.latest is cell.finished(cycle_id)
            assert after.valid
            assert after.published.result.parts == (PART,)
            assert after.published.triggered_ns == before.published.triggered_ns
            same = {"timing_ms": {}, "parts": ()}
            assert after.published.result.model_copy(update=same) == before.published.result.model_copy(update=same)
            assert dict(after.counts)["finished"] == 1

    asyncio.run(scenario())


def test_the_next_trigger_does_not_wait_for_poses() -> None:
    given_up = threading.Event()

    def pose(inputs: CycleInput, cycle: CycleResult, proceed: Callable[[], None]) -> CycleResult:
        if inputs.cycle_id > 1:
            return cycle
        try:
            for _ in range(500):
                time.sleep(0.01)
                proceed()
        except Exception:
            given_up.set()
            raise
        return cycle

    async def scenario() -> None:
        async with living(released(), pose=pose) as cell:
            cell.start(Request(), "rest")
            await until(cell, lambda s: s.latest is not None and s.phase == "ready")
            cell.start(Request(), "rest")
            done = await until(cell, lambda s: s.latest is not None and s.latest.result.cycle_id == 2)
            assert given_up.is_set()
            assert not done.faults

    asyncio.run(scenario())


def test_a_mesh_that_went_away_costs_the_poses_only(caplog: pytest.LogCaptureFixture) -> None:
    asked = threading.Event()

    def pose(_inputs: CycleInput, _cycle: CycleResult, _proceed: Callable[[], None]) -> CycleResult:
        asked.set()
        raise InputError("part.stl: the mesh cannot be read: No such file or directory")

    async def scenario() -> None:
        async with living(released(), pose=pose) as cell:
            cell.start(Request(), "rest")
            await until(cell, lambda s: s.latest is not None)
            while "part.stl" not in caplog.text:
                await asyncio.sleep(0.01)
            assert asked.is_set()
            assert cell.snapshot().valid
            assert not cell.snapshot().faults

    asyncio.run(scenario())
