"""The watchdog in a living cell: a camera that turns is warned of, then stops the poses, on REST and Modbus alike.

The pipeline is the real one. The cameras show one picture; the right one is moved down by some rows, as a pitch would.
"""

import asyncio
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

import ports
import staged
from binpick import geometry, pipeline, recording, settings
from binpick.cell import Cell
from binpick.cell.logbook import DAMAGED, NAME
from binpick.data import Image, Light, frozen
from binpick.errors import Code, InputError, NotInControl
from binpick.message import Verify
from binpick.publish.registers import Status
from binpick.result import Request
from binpick.sim import exam
from binpick.sim.drift import NONE, Drift
from binpick.sim.marks import Mark, layout
from binpick.sim.plc import Plc, PlcResult
from binpick.sim.render import Renderer
from binpick.sim.world import ScenePart, WorldScene
from servers import START_S, on_a_thread, recorder, until, with_modbus

Pictures = list[tuple[Image, Image]]

BLOCKS = (geometry.translation(0.0, 0.0, 0.0075), geometry.translation(0.08, 0.03, 0.0075),
          geometry.translation(-0.07, -0.04, 0.0075))
ENOUGH = 6
"""Cycles after which the watchdog has made up its mind."""
CALIBRATION, ROW_ERROR = 346, 347
"""Registers."""


RIG = staged.small_exam_rig()


def photographed(drifted: Drift = NONE, marks: tuple[Mark, ...] = (), shots: int = 3) -> Pictures:
    """The same blocks, taken several times by cameras that have moved since they were calibrated."""
    renderer, light = Renderer(RIG, "B", drifted=drifted, marks=marks), settings.resolve(exam.cell("B")).recipe.lights[0]
    scene = WorldScene("B", tuple(ScenePart(i, "block", T) for i, T in enumerate(BLOCKS, start=1)), 1, 1)
    return [(renderer.expose(scene, 0, light, shot), renderer.expose(scene, 1, light, shot)) for shot in range(1, shots + 1)]


@pytest.fixture(scope="module")
def pictures() -> Pictures:
    return photographed()


@pytest.fixture(scope="module")
def marked() -> dict[str, Pictures]:
    """With tags beside the bin: as calibrated, with the second camera turned so that rows do not show it, and with the mount
    bumped."""
    drifts = {"still": NONE, "yawed": Drift(yaw_rad=np.radians(0.02)), "bumped": Drift(shift_m=(0.005, 0.0, 0.0))}
    return {name: photographed(drifted, layout("B"), 2) for name, drifted in drifts.items()}


def lowered(image: Image, rows_px: float) -> Image:
    """The picture of a camera that looks further up."""
    way = np.array([[1, 0, 0], [0, 1, rows_px]], dtype=float)
    return frozen(cv2.warpAffine(image, way, image.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT))


@dataclass
class Drifting(staged.Cameras):
    """Cameras of which the right one's picture is moved down by `rows_px`."""

    pictures: Pictures
    rows_px: float = 0.0

    def images(self, light: Light) -> tuple[Image, Image]:
        left, right = self.pictures[(self.shots - 1) % len(self.pictures)]
        return left, lowered(right, self.rows_px)


@dataclass
class Daemon:
    """A cell with its servers on a thread of its own."""

    client: httpx.Client
    cell: Cell
    cameras: Drifting
    modbus_port: int

    def cycle(self) -> dict[str, Any]:
        """Over REST; a failure comes as its problem."""
        answer: dict[str, Any] = self.client.post("/v1/cycles", params={"wait": True}, json={"frame": "bin"}).json()
        return answer

    def code(self) -> int:
        answer = self.cycle()
        return int(answer["code"] if "code" in answer else answer["return_code"]["value"])

    def verify(self, **body: object) -> httpx.Response:
        return self.client.post("/v1/calibration/verify", json=body)

    def metric(self, name: str) -> float:
        line = next(line for line in self.client.get("/metrics").text.splitlines() if line.startswith(name + " "))
        return float(line.rsplit(" ", 1)[1])

    def by_plc(self, *commands: str) -> tuple[list[PlcResult], int, list[int]]:
        """What the controller reads of these commands, its status word after them, and the watchdog's registers."""

        async def talk() -> tuple[list[PlcResult], int, list[int]]:
            async with Plc("127.0.0.1", self.modbus_port) as plc:
                results = [await (plc.pick(frame=2, timeout_ms=30_000) if command == "pick" else plc.verify(timeout_ms=30_000))
                           for command in commands]
                return results, await plc.status(), await plc._read(CALIBRATION, 9)

        return asyncio.run(talk())


@contextmanager
def daemon(port: int, pictures: Pictures, folder: Path, recordings: Path | None = None,
           rows_px: float = 0.0, **changes: object) -> Iterator[Daemon]:
    [modbus_port] = ports.free(1)
    cameras = Drifting(pictures, rows_px)
    cameras.gate.set()
    document: dict[str, Any] = {"control": "rest", "publish": {"modbus": {"host": "127.0.0.1", "port": modbus_port}}} | changes
    configured = exam.cell("B", calibration={"directory": folder}, timeout_ms=30_000, **document)
    with recorder(recordings) as recording_it:
        cell = Cell(configured, RIG, cameras, boot_id=7, recorder=recording_it)
        with on_a_thread(with_modbus(cell, configured), cell, port) as client:
            until(lambda: cell.snapshot().phase == "ready", START_S)
            yield Daemon(client, cell, cameras, modbus_port)


@pytest.mark.parametrize(("rows_px", "code", "level"), [
    (0.0, Code.OK, 0), (0.45, Code.CALIBRATION_WARNING, 1), (-0.45, Code.CALIBRATION_WARNING, 1),
    (1.4, Code.CALIBRATION_FAULT, 2)])
def test_the_level_is_the_same_on_every_interface(free_port: int, pictures: Pictures, rows_px: float,
                                                   code: Code, level: int, tmp_path: Path) -> None:
    with daemon(free_port, pictures, tmp_path, rows_px=rows_px) as served:
        assert [served.code() for _ in range(ENOUGH)][-1] == code
        latest = served.client.get("/v1/cycles/latest").json()
        assert latest["return_code"]["value"] == code
        assert bool(latest["grasps"]) is code.carries_poses
        assert latest["calibration"]["level"] == ("ok", "warn", "fault")[level]
        assert abs(latest["calibration"]["row_px"] - rows_px) < 0.1
        state = served.client.get("/v1/health").json()
        assert state["status"] == ("ok", "degraded", "fault")[level]
        assert bool(state["reasons"]) is (level > 0)
        assert state["unseen"]
        assert served.metric("binpick_calibration_level") == level
        assert abs(served.metric("binpick_calibration_row_px") - rows_px) < 0.1
        with served.client.stream("GET", "/v1/events") as events:
            told = next(line for line in events.iter_lines() if line.startswith("data:"))
        assert json.loads(told.removeprefix("data:"))["calibration"] == ("ok", "warn", "fault")[level]
        drift = served.client.get("/v1/calibration/drift").json()
        assert (drift["level"], len(drift["row_px"])) == (("ok", "warn", "fault")[level], ENOUGH)


@pytest.mark.parametrize(("rows_px", "code"), [(0.0, Code.OK), (0.45, Code.CALIBRATION_WARNING), (1.4, Code.CALIBRATION_FAULT)])
def test_a_controller_reads_it_from_the_registers(free_port: int, pictures: Pictures, rows_px: float,
                                                  code: Code, tmp_path: Path) -> None:
    with daemon(free_port, pictures, tmp_path, rows_px=rows_px, control="modbus") as served:
        *_, last = served.by_plc(*["pick"] * ENOUGH)[0]
        assert last.return_code == code
        assert bool(last.records) is code.carries_poses
        (verified,), status, registers = served.by_plc("verify")
        assert (verified.return_code, verified.records) == (code, ())
        assert bool(status & Status.CALIB_WARN) is (code is not Code.OK)
        assert registers[0] == {Code.OK: 1, Code.CALIBRATION_WARNING: 2, Code.CALIBRATION_FAULT: 3}[code]
        row_error = registers[ROW_ERROR - CALIBRATION]
        assert abs((row_error - 0x10000 if row_error & 0x8000 else row_error) / 1000 - rows_px) < 0.1


@pytest.mark.slow
def test_a_camera_that_is_turned_back_is_trusted_again(free_port: int, pictures: Pictures, tmp_path: Path) -> None:
    with daemon(free_port, pictures, tmp_path, rows_px=1.4) as served:
        assert [served.code() for _ in range(ENOUGH)][-1] == Code.CALIBRATION_FAULT
        served.cameras.rows_px = 0.0
        assert Code.OK in [served.code() for _ in range(10)]
        assert served.client.get("/v1/health").json()["status"] == "ok"


@pytest.mark.slow
def test_recorded_cycles_compute_to_the_same_bytes(free_port: int, pictures: Pictures, tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    with daemon(free_port, pictures, tmp_path / "state", kept, rows_px=0.7, watchdog={"self_correct": True}) as served:
        for _ in range(ENOUGH + 2):
            served.cycle()
        assert served.verify().json()["verdict"]["correction"] is not None
    folders = sorted(kept.iterdir())
    assert len(folders) >= ENOUGH
    for folder in folders:
        inputs, stored = recording.load(folder)
        assert pipeline.run(inputs).result.timeless_bytes() == stored.timeless_bytes()
    corrected, stored = recording.load(folders[-1])
    assert corrected.guard is not None
    assert corrected.guard.correction is not None
    assert stored.calibration is not None
    assert stored.calibration.correction is not None
    assert stored.inputs is not None
    assert stored.inputs.rig_sha256 == RIG.sha256 != stored.calibration.correction.rig_sha256


@pytest.mark.slow
def test_a_correction_takes_effect_and_is_never_silent(free_port: int, pictures: Pictures, tmp_path: Path,
                                                       caplog: pytest.LogCaptureFixture) -> None:
    with daemon(free_port, pictures, tmp_path, rows_px=0.7, watchdog={"self_correct": True}) as served:
        answers = [served.cycle() for _ in range(ENOUGH + 4)]
        last = answers[-1]
        assert last["return_code"]["value"] == Code.CALIBRATION_WARNING
        assert abs(last["calibration"]["row_px"]) < 0.1 < abs(answers[0]["calibration"]["row_px"])
        assert "calibrate again" in last["return_code"]["message"]
        assert served.client.get("/v1/health").json()["status"] == "degraded"
        assert served.metric("binpick_calibration_correction_rad") > 0
        assert any("corrected from the next cycle on" in record.getMessage() for record in caplog.records)
    with daemon(free_port, pictures, tmp_path, rows_px=0.7, watchdog={"self_correct": True}) as served:
        first = served.cycle()                                              # remembered by the next daemon
        assert first["return_code"]["value"] == Code.CALIBRATION_WARNING
        assert abs(first["calibration"]["row_px"]) < 0.1


@pytest.mark.slow
def test_a_drift_beyond_a_fault_is_not_corrected_by_rows_alone(free_port: int, pictures: Pictures, tmp_path: Path) -> None:
    with daemon(free_port, pictures, tmp_path, rows_px=1.6, watchdog={"self_correct": True}) as served:
        assert [served.code() for _ in range(ENOUGH + 2)][-1] == Code.CALIBRATION_FAULT
        assert served.metric("binpick_calibration_correction_rad") == 0


@pytest.mark.slow
def test_a_restart_forgets_no_fault(free_port: int, pictures: Pictures, tmp_path: Path) -> None:
    with daemon(free_port, pictures, tmp_path, rows_px=1.4) as served:
        assert [served.code() for _ in range(ENOUGH)][-1] == Code.CALIBRATION_FAULT
    with daemon(free_port, pictures, tmp_path, rows_px=1.4) as served:
        assert served.client.get("/v1/health").json()["status"] == "fault"
        assert served.code() == Code.CALIBRATION_FAULT
    (tmp_path / NAME).write_bytes(b'{"format": "binpick-watch')
    with daemon(free_port, pictures, tmp_path) as served:
        assert any("watchdog.json is damaged" in reason for reason in served.client.get("/v1/health").json()["reasons"])
        assert (tmp_path / DAMAGED).exists()
        assert served.code() == Code.OK


def test_a_verification_is_no_pick(free_port: int, pictures: Pictures, tmp_path: Path) -> None:
    with daemon(free_port, pictures, tmp_path) as served:
        answer = served.verify()
        assert answer.status_code == 200
        document = answer.json()
        assert (document["cycle_id"], document["verdict"]["level"], document["marks_stored"]) == (1, "ok", False)
        assert document["verdict"]["sentence"].startswith("No drift")
        cycle = served.client.get("/v1/cycles/1").json()
        assert (cycle["return_code"]["value"], cycle["grasps"], cycle["bin"]) == (0, [], None)
        assert served.client.get("/v1/cycles/1/left.png").status_code == 200
        assert served.code() == Code.OK
        served.cameras.rows_px = 1.4
        assert served.verify().json()["verdict"]["level"] == "fault"       # at once, whatever the cycles before it said
        blank = np.zeros_like(pictures[0][0])
        served.cameras.pictures = [(blank, blank)]
        refused = served.verify()
        assert (refused.status_code, refused.json()["code"]) == (409, Code.NOT_APPLICABLE)
        assert "tells nothing of the calibration" in refused.json()["detail"]


def test_who_does_not_control_the_cell_verifies_while_it_is_idle(free_port: int, pictures: Pictures, tmp_path: Path) -> None:
    with daemon(free_port, pictures, tmp_path, control="modbus") as served:
        served.by_plc("pick")
        assert served.verify().status_code == 200
        served.cameras.gate.clear()
        served.cell.start(Request(), "modbus")
        refused = served.verify()
        assert refused.status_code == 409
        assert "modbus runs a cycle" in refused.json()["detail"]
        served.cameras.gate.set()
        until(lambda: served.cell.snapshot().phase == "ready", START_S)
        with pytest.raises(NotInControl, match="has a result to read"):
            served.cell.verify(Verify(), Request(), "rest")
        assert served.cell.snapshot().valid


def test_what_cannot_be_verified_is_refused_by_name(free_port: int, pictures: Pictures, tmp_path: Path) -> None:
    with daemon(free_port, pictures, tmp_path) as served:
        for body, said in (({"store_marks": True}, "reference_marks"), ({"board": "chess"}, "chessboard:9x6"),
                           ({"bord": ""}, "unknown key"), ({"board": "charuco:9x6:0.025"}, "not seen by the left camera")):
            refused = served.verify(**body)
            assert refused.status_code == 422
            assert said in refused.json()["detail"]
        with pytest.raises(InputError):
            served.cell.verify(Verify(store_marks=True), Request(), "rest")
        assert served.code() == Code.OK


def test_marks_are_stored_on_demand_and_outlive_the_daemon(free_port: int, marked: dict[str, Pictures], tmp_path: Path) -> None:
    with daemon(free_port, marked["still"], tmp_path, reference_marks={}) as served:
        assert any("not stored yet" in reason for reason in served.client.get("/v1/health").json()["reasons"])
        stored = served.verify(store_marks=True).json()
        assert (stored["marks_stored"], stored["verdict"]["marks"]["seen"]) == (True, 6)
        assert served.client.get("/v1/health").json()["status"] == "ok"
    with daemon(free_port, marked["still"], tmp_path, reference_marks={}) as served:
        seen = served.cycle()["calibration"]["marks"]
        assert (seen["seen"], seen["missing"]) == (6, [])
        assert seen["shift_m"] < 0.0002
        assert served.client.get("/v1/calibration/drift").json()["marks"] == "stored"
        few = served.verify(board="charuco:9x6:0.025")
        assert few.status_code == 422
    with daemon(free_port, marked["still"], tmp_path, reference_marks={"family": "4x4_50"}) as served:
        assert any("stored as apriltag_36h11" in reason for reason in served.client.get("/v1/health").json()["reasons"])
        refused = served.verify(store_marks=True)
        assert refused.status_code == 422
        assert "0 marks of 4x4_50 are seen" in refused.json()["detail"]
        assert served.client.get("/v1/calibration/drift").json()["marks"] == "to be stored"


@pytest.mark.slow
@pytest.mark.parametrize(("drift", "code", "said"), [
    ("yawed", Code.CALIBRATION_WARNING, "depths are off"), ("bumped", Code.CALIBRATION_FAULT, "mount has moved by 5.0 mm")])
def test_marks_tell_what_rows_do_not(free_port: int, marked: dict[str, Pictures], tmp_path: Path, drift: str, code: Code,
                                     said: str) -> None:
    with daemon(free_port, marked["still"], tmp_path, reference_marks={}) as served:
        assert served.verify(store_marks=True).status_code == 200
        served.cameras.pictures = marked[drift]
        assert [served.code() for _ in range(10)][-1] == code
        latest = served.client.get("/v1/cycles/latest").json()["calibration"]
        assert abs(latest["row_px"]) < 0.1
        assert said in latest["sentence"]
        assert served.metric("binpick_calibration_marks_seen") == 6


@pytest.mark.slow
def test_depth_is_right_again_when_marks_correct_it(free_port: int, marked: dict[str, Pictures], tmp_path: Path) -> None:
    def top_m(answer: dict[str, Any]) -> float:
        return float(np.median([grasp["position_m"][2] for grasp in answer["grasps"]]))

    with daemon(free_port, marked["still"], tmp_path, reference_marks={}, watchdog={"self_correct": True}) as served:
        assert served.verify(store_marks=True).status_code == 200
        before = top_m(served.cycle())
        served.cameras.pictures = marked["yawed"]
        wrong, *_, right = (served.cycle() for _ in range(8))
        assert abs(top_m(wrong) - before) > 0.001
        assert abs(top_m(right) - before) < 0.0003
        assert right["return_code"]["value"] == Code.CALIBRATION_WARNING
        assert abs(right["calibration"]["correction"]["rotation_rad"][1] - np.radians(0.02)) < np.radians(0.003)
        refused = served.verify(store_marks=True)
        assert "calibrate first" in refused.json()["detail"]
