"""Calibrating in the running cell, over REST and Modbus: cameras that see a drawn board where a robot holds it."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import ports
import printed
import staged
from binpick import calibration, geometry, settings
from binpick import rig as rig_file
from binpick.cell import Cell
from binpick.cycle import CycleInput, CycleResult
from binpick.data import Image, Light, frozen
from binpick.errors import Busy, Code, NotInControl, RigError
from binpick.geometry import Transform
from binpick.result import PoseMessage, Request, Result, ReturnCode
from binpick.rig import Rig
from binpick.rigcheck import board as boards
from binpick.settings import Bin, Pose, Recipe
from binpick.settings.cell import ModbusSettings
from binpick.sim.plc import Plc
from servers import START_S, RestServer, with_modbus

BOARD = "charuco:6x4:0.03"
SIZE = (480, 320)
FOCAL_PX = 500.0
BASELINE_M = 0.08
T_BASE_RIG = geometry.make(Rotation.from_euler("xyz", [175, 4, 30], degrees=True).as_matrix(), np.array([0.4, -0.1, 0.9]))
T_FLANGE_BOARD = geometry.make(Rotation.from_euler("xyz", [3, -4, 80], degrees=True).as_matrix(), np.array([-0.06, 0.05, 0.12]))
TURNS_DEG = [(0, 0, 0), (22, 0, 5), (-20, 6, 0), (0, 24, -8), (4, -22, 30), (18, 16, -30), (-16, 18, 60), (15, -17, -60),
             (-18, -15, 20), (8, 5, 90)]


def rig(**changes: object) -> Rig:
    return staged.rig(SIZE, FOCAL_PX, BASELINE_M, **{"quality": {"rms_px": 0.1, "row_error_px": 0.05}, **changes})


def flange(number: int) -> Transform:
    """Where the robot holds the board: it faces the cameras, turned and moved from stand to stand."""
    turn = Rotation.from_euler("xyz", TURNS_DEG[number], degrees=True).as_matrix()
    off = np.array([0.02 * np.cos(number), 0.02 * np.sin(2 * number), 0.55 + 0.02 * np.sin(number)])
    points = boards.parse(BOARD).points_m
    T_rig_middle = geometry.make(turn, off + np.array([BASELINE_M / 2, 0, 0]))
    T_rig_board = T_rig_middle @ geometry.translation(*(-points.mean(0)).tolist())
    T_base_flange: Transform = T_BASE_RIG @ T_rig_board @ geometry.inverse(T_FLANGE_BOARD)
    return T_base_flange


def seen(T_cam_board: Transform) -> np.ndarray:
    """A camera's view of the board; its first inner corner is the board's origin."""
    board = boards.parse(BOARD)
    return printed.seen(printed.charuco(board.charuco), board.square_m, rig().cameras[0].K_px, T_cam_board, SIZE, 3, 1.5)


@cache
def pictures(number: int) -> tuple[np.ndarray, np.ndarray]:
    """What both cameras see at a stand; at -1 there is no board."""
    if number < 0:
        blank = frozen(np.full(SIZE[::-1], 120, np.uint8))
        return blank, blank
    T_rig_board = geometry.inverse(T_BASE_RIG) @ flange(number) @ T_FLANGE_BOARD
    right = geometry.translation(-BASELINE_M, 0.0, 0.0) @ T_rig_board
    return frozen(seen(T_rig_board)), frozen(seen(right))


@dataclass
class StandCameras(staged.Cameras):
    """Cameras that see the board at the robot's `stand`; `covered` hides it from the right one.

    With `usual_us` an image is as bright as it was exposed.
    """

    stand: int = -1
    covered: bool = False
    usual_us: float = 0.0
    lights: list[Light] = field(default_factory=list)

    def images(self, light: Light) -> tuple[Image, Image]:
        self.lights.append(light)
        left, right = pictures(self.stand)
        images = left, pictures(-1)[0] if self.covered else right
        if self.usual_us:
            left, right = (cv2.convertScaleAbs(image, alpha=light.exposure_us / self.usual_us) for image in images)
            return left, right
        return images


@dataclass
class Site:
    """A cell with both servers, a client of each, and the rig that the last cycle ran on."""

    cell: Cell
    cameras: StandCameras
    client: httpx.AsyncClient
    plc: Plc
    rigs: list[Rig]

    async def sample(self, stand: int, posed: bool = True, **body: object) -> httpx.Response:
        """The robot goes to a stand, and a sample is taken."""
        self.cameras.stand = stand
        pose = calibration.message(flange(max(stand, 0))).model_dump() if posed else None
        return await self.client.post("/v1/calibration/samples", json={"board": BOARD, "T_base_flange": pose, **body})

    async def ask(self, path: str, body: object, status: int = 200) -> Any:
        response = await self.client.post(f"/v1/{path}", json=body)
        assert response.status_code == status, response.text
        return response.json()

    async def refused(self, path: str, body: object, status: int, code: Code) -> str:
        return problem(await self.client.post(f"/v1/{path}", json=body), status, code)

    async def told(self, path: str = "calibration") -> Any:
        response = await self.client.get(f"/v1/{path}")
        assert response.status_code == 200, response.text
        return response.json()


@asynccontextmanager
async def site(port: int, folder: Path, given: Rig | None = None, *, hold: bool = False, control: str = "rest",
               **changes: object) -> AsyncIterator[Site]:
    cameras, rigs = StandCameras(), list[Rig]()
    if not hold:
        cameras.gate.set()

    def run(inputs: CycleInput, proceed: Callable[[], None]) -> CycleResult:
        proceed()
        rigs.append(inputs.rig)
        return CycleResult(Result(cycle_id=inputs.cycle_id, request=inputs.request, captured_at=inputs.pair.captured_at,
                                  return_code=ReturnCode.of(Code.BIN_EMPTY), bin=None))

    modbus = ModbusSettings(host="127.0.0.1", port=ports.free(1)[0])
    configured = settings.Cell.model_validate({
        "bins": [Bin(inner_size_m=(0.3, 0.2, 0.1), pose=Pose(position_m=(0, 0, 0.6)))], "recipes": [Recipe(frame="camera")],
        "control": control, "rig": folder / "rig.json", "publish": {"modbus": modbus}, "timeout_ms": 20000, **changes})
    living = Cell(configured, given or rig(), cameras, run, boot_id=7)
    server = RestServer(living, port)
    async with with_modbus(living, configured):
        serving = asyncio.create_task(server.serve())
        try:
            async with asyncio.timeout(START_S):
                while not (server.started and living.snapshot().phase == "ready"):
                    await asyncio.sleep(0.005)
            async with (httpx.AsyncClient(base_url=f"http://127.0.0.1:{port}", timeout=50) as client,
                        Plc("127.0.0.1", modbus.port) as plc):
                yield Site(living, cameras, client, plc, rigs)
        finally:
            cameras.gate.set()
            server.should_exit = True
            await serving


def holds(scenario: Callable[[], Any]) -> None:
    asyncio.run(scenario())


def problem(response: httpx.Response, status: int, code: Code) -> str:
    assert response.status_code == status, response.text
    document = response.json()
    assert document["code"] == code.value, document
    return str(document["detail"])


def test_from_samples_to_a_rig_that_knows_the_robot(free_port: int, tmp_path: Path) -> None:
    async def scenario() -> None:
        async with site(free_port, tmp_path) as here:
            assert "no board is named" in await here.refused("calibration/samples", {}, 422, Code.BAD_ARGUMENT)
            assert "no sample" in await here.refused("calibration/handeye", {"mounting": "base"}, 422, Code.BAD_ARGUMENT)
            millimetres = {"board": BOARD, "T_base_flange": {"position_m": [400, 0, 300], "quaternion_xyzw": [0, 0, 0, 1]}}
            said = await here.refused("calibration/samples", millimetres, 422, Code.BAD_ARGUMENT)
            assert "the flange would be 500 m from its base: positions are in metres" in said
            for stand in range(6):
                response = await here.sample(stand)
                assert response.status_code == 201, response.text
                answer = response.json()
                assert [one["found"] for one in answer["sample"]["sightings"]] == [True, True]
                assert answer["progress"]["missing"][-1].startswith(f"{9 - stand} more samples with a flange pose")
                if stand == 3:
                    refused = await here.refused("calibration/handeye", {"mounting": "base"}, 422, Code.BAD_ARGUMENT)
                    assert "5 are needed" in refused
            assert not any(light.projector for light in here.cameras.lights)
            assert not here.rigs
            listed = await here.told("calibration/samples")
            assert [one["id"] for one in listed["samples"]] == list(range(1, 7))
            solved = await here.ask("calibration/handeye", {"mounting": "base"})
            version = solved["version"]
            assert (version["version"], version["active"], version["hand_eye"]) == (2, False, "base")
            found = calibration.transform(PoseMessage.model_validate(version["T_hand_eye"]))
            np.testing.assert_allclose(found[:3, 3], T_BASE_RIG[:3, 3], atol=1e-3)
            assert solved["rms_m"] < 1e-3
            assert version["quality"]["hand_eye_rms_m"] == solved["rms_m"]
            assert (await here.told())["active"]["version"] == 1
            assert solved["outliers"] == {}
    holds(scenario)


def test_versions_are_activated_and_gone_back_from_over_restarts(free_port: int, tmp_path: Path) -> None:
    async def scenario() -> None:
        async with site(free_port, tmp_path) as here:
            assert here.cell.calibration.rigs.add(rig(T_base_rig=T_BASE_RIG.tolist())) == 2
            state = await here.told()
            assert (state["active"]["version"], [one["version"] for one in state["versions"]]) == (1, [1, 2])
            await here.refused("cycles", {"frame": "base"}, 422, Code.FRAME_UNAVAILABLE)
            state = await here.ask("calibration/activate", {"version": 2})
            assert state["active"]["version"] == 2
            assert (await here.client.post("/v1/cycles", params={"wait": True}, json={"frame": "base"})).status_code == 200
            assert here.rigs[-1].sha256 == state["active"]["sha256"]
            assert (await here.told("health"))["rig"].startswith("version 2, ")
            assert "there are 1, 2" in await here.refused("calibration/activate", {"version": 7}, 404, Code.UNKNOWN_ITEM)
        async with site(free_port, tmp_path) as here:      # the same rig file
            state = await here.told()
            assert (state["active"]["version"], state["samples"]) == (2, 0)
            assert (await here.ask("calibration/activate", {"version": 1}))["active"]["sha256"] == rig().sha256
            await here.refused("cycles", {"frame": "base"}, 422, Code.FRAME_UNAVAILABLE)
        replaced = rig(created="2026-02-02T00:00:00+00:00")
        async with site(free_port, tmp_path, replaced) as here:
            state = await here.told()
            assert (state["active"]["version"], state["active"]["sha256"]) == (3, replaced.sha256)
            assert "was replaced after version 1 was activated" in state["note"]
            assert any("was replaced" in why for why in (await here.told("health"))["reasons"])
            state = await here.ask("calibration/activate", {"version": 3})
            assert state["note"] == ""
            assert (await here.told("health"))["status"] == "ok"
            assert [one["version"] for one in state["versions"]] == [1, 2, 3]
    holds(scenario)


def test_a_sample_says_who_did_not_see_the_board_and_what_it_is_worth(free_port: int, tmp_path: Path) -> None:
    async def scenario() -> None:
        async with site(free_port, tmp_path, calibration={"board": BOARD}) as here:
            blank = (await here.sample(-1, board="")).json()["sample"]
            assert [one["found"] for one in blank["sightings"]] == [False, False]
            assert "all one grey" in blank["sightings"][0]["reason"]
            assert blank["board"] == str(boards.parse(BOARD))
            latest = (await here.told("cycles/latest"))["return_code"]
            assert (latest["value"], latest["name"]) == (110, "board_not_found")
            here.cameras.covered = True
            one = (await here.sample(1)).json()
            assert [sight["found"] for sight in one["sample"]["sightings"]] == [True, False]
            here.cameras.covered = False
            assert (await here.sample(2)).json()["sample"]["useful"]
            again = (await here.sample(2)).json()["sample"]
            assert not again["useful"]
            assert "like view" in again["reason"]
            picture = await here.client.get("/v1/calibration/samples/4/right.png")
            decoded = cv2.imdecode(np.frombuffer(picture.content, np.uint8), cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(decoded, pictures(2)[1])
            problem(await here.client.get("/v1/calibration/samples/9/right.png"), 404, Code.NOT_APPLICABLE)
            problem(await here.client.get("/v1/calibration/samples/4/third.png"), 404, Code.NOT_APPLICABLE)
            assert (await here.client.delete("/v1/calibration/samples/2")).status_code == 204
            problem(await here.client.delete("/v1/calibration/samples/2"), 404, Code.NOT_APPLICABLE)
            assert [one["id"] for one in (await here.told("calibration/samples"))["samples"]] == [1, 3, 4]
            assert (await here.client.delete("/v1/calibration/samples")).status_code == 204
            assert (await here.told("calibration/samples"))["samples"] == []
            assert "write it as" in problem(await here.sample(1, board="what"), 422, Code.BAD_ARGUMENT)
    holds(scenario)


def test_images_that_do_not_belong_to_the_rig_are_refused_and_not_kept(free_port: int, tmp_path: Path) -> None:
    async def scenario() -> None:
        async with site(free_port, tmp_path, rig(image_size_px=(640, 480))) as here:
            refused = problem(await here.sample(0), 422, Code.BAD_ARGUMENT)
            assert "gives 480x320 pixels and the rig was calibrated with 640x480" in refused
            assert (await here.told("calibration/samples"))["samples"] == []
    holds(scenario)


def test_the_rig_is_never_changed_under_a_cycle_nor_under_a_result_of_others(free_port: int, tmp_path: Path) -> None:
    async def scenario() -> None:
        async with site(free_port, tmp_path, hold=True, control="modbus") as here:
            number = here.cell.calibration.rigs.add(rig(T_base_rig=np.eye(4).tolist()))
            cycle = here.cell.start(Request(), "modbus")
            asked: list[tuple[str, object]] = [("activate", {"version": number}), ("samples", {"board": BOARD})]
            for path, body in asked:
                assert "controlled by modbus" in await here.refused(f"calibration/{path}", body, 409, Code.NOT_IN_CONTROL)
            with pytest.raises(Busy, match="between cycles only"):
                here.cell.calibration.activate(number, "modbus")
            here.cameras.gate.set()
            while here.cell.snapshot().phase != "ready":
                await asyncio.sleep(0.005)
            assert here.rigs[-1].sha256 == rig().sha256
            with pytest.raises(NotInControl, match="has a result to read"):
                here.cell.calibration.activate(number, "rest")
            assert await here.plc._read(8, 1) == [1]
            here.cell.calibration.activate(number, "modbus")       # its own result is withdrawn
            await asyncio.sleep(0.1)
            assert await here.plc._read(8, 1) == [2]
            snapshot = here.cell.snapshot()
            assert (snapshot.valid, snapshot.withdrawn) == (False, "the rig was changed to version 2")
            assert cycle == 1
            assert (await here.ask("calibration/activate", {"version": 1}))["active"]["version"] == 1     # idle: anybody may
            taken = (await here.sample(0)).json()
            assert taken["sample"]["useful"]
            assert not here.cell.snapshot().valid       # what was taken aside is nothing for the controller to acknowledge
            assert (await here.plc.pick()).return_code == Code.BIN_EMPTY
    holds(scenario)


def test_command_7_takes_samples_with_the_flange_pose_of_the_registers(free_port: int, tmp_path: Path) -> None:
    async def scenario() -> None:
        async with site(free_port, tmp_path, rig(board=BOARD), control="modbus") as here:
            assert await here.plc.sample(None) == (Code.NO_FLANGE_POSE, 0)
            await here.plc.clear()
            assert await here.plc.sample(flange(0)) == (Code.BOARD_NOT_FOUND, 12)
            millimetres = flange(0).copy()
            millimetres[:3, 3] *= 1000
            assert (await here.plc.sample(millimetres))[0] == Code.BAD_ARGUMENT
            await here.plc.clear()
            here.cameras.stand, here.cameras.covered = 0, True
            assert await here.plc.sample(flange(0)) == (Code.BOARD_NOT_FOUND, 11)
            here.cameras.covered = False
            details = []
            for here.cameras.stand in (0, 0, *range(1, 10)):
                code, detail = await here.plc.sample(flange(here.cameras.stand))
                assert code == Code.OK
                details.append(detail)
            assert details[:3] == [8, 10, 8]
            assert details[-1] == 9
            sample = (await here.told("calibration/samples"))["samples"][-1]
            kept = calibration.transform(PoseMessage.model_validate(sample["T_base_flange"]))
            np.testing.assert_allclose(kept, flange(9), atol=1e-6)
            assert (await here.plc.pick()).return_code == Code.BIN_EMPTY
    holds(scenario)


def test_samples_are_exposed_by_the_recipe_without_the_pattern(free_port: int, tmp_path: Path) -> None:
    async def scenario() -> None:
        recipes = [Recipe(frame="camera", exposure_us="auto", projector="alternate", hdr=4),
                   Recipe(number=2, shots=({"exposure_us": 900}, {"projector": False, "exposure_us": 700, "gain_db": 3}))]
        in_base = Bin(inner_size_m=(0.3, 0.2, 0.1), pose=Pose(frame="base", position_m=(0, 0, 0.6)))
        async with site(free_port, tmp_path, recipes=recipes, bins=[in_base]) as here:      # before anybody knows where that is
            here.cameras.usual_us = 9000
            assert (await here.sample(0)).json()["sample"]["useful"]
            metered = len(here.cameras.lights)
            assert metered > 1
            assert (await here.sample(1)).status_code == 201
            assert len(here.cameras.lights) == metered + 1      # what was found out is kept
            assert (await here.sample(2, recipe=2)).status_code == 201
            light = here.cameras.lights[-1]
            assert (light.exposure_us, light.gain_db) == (700, 3)
            assert not any(light.projector for light in here.cameras.lights)
    holds(scenario)


def test_samples_that_do_not_belong_together_are_refused_by_name(free_port: int, tmp_path: Path) -> None:
    async def scenario() -> None:
        async with site(free_port, tmp_path) as here:
            for stand in range(6):
                await here.sample(stand)
        moved = rig().model_dump(mode="json")
        moved["cameras"][1]["T_cam_rig"][0][3] -= 0.001
        async with site(free_port, tmp_path, Rig.model_validate(moved)) as here:
            assert (await here.told("calibration/samples"))["progress"]["coverage"]["views"] == 0      # those of others
            await here.sample(6)
            refused = await here.refused("calibration/handeye", {"mounting": "base"}, 422, Code.BAD_ARGUMENT)
            assert "samples 1, 2, 3, 4, 5, 6 were taken when the cameras were calibrated otherwise" in refused
            await here.client.delete("/v1/calibration/samples")
            await here.sample(0, board="charuco:6x4:0.031")
            await here.sample(1)
            refused = await here.refused("calibration/handeye", {"mounting": "base"}, 422, Code.BAD_ARGUMENT)
            assert "do not show one board" in refused
        cameras = rig().model_dump()["cameras"]
        async with site(free_port, tmp_path, rig(cameras=(*cameras, {**cameras[1], "name": "third"}))) as here:
            for stand in range(5):      # of three cameras two are there
                assert (await here.sample(stand)).status_code == 201
            await here.client.delete("/v1/calibration/samples/1")
            await here.client.delete("/v1/calibration/samples/2")
            assert (await here.told("calibration/samples"))["progress"]["coverage"]["views"] == 5
            assert (await here.ask("calibration/handeye", {"mounting": "base"}))["rms_m"] < 1e-3
    holds(scenario)


def test_a_version_that_is_active_and_damaged_stops_the_start(free_port: int, tmp_path: Path) -> None:
    async def scenario() -> None:
        async with site(free_port, tmp_path) as here:
            here.cell.calibration.activate(here.cell.calibration.rigs.add(rig(T_base_rig=np.eye(4).tolist())), "rest")
        path = tmp_path / "calibration" / "rigs" / "0002.json"
        whole = path.read_bytes()
        path.write_bytes(whole.replace(b"500.0", b"501.0"))
        with pytest.raises(RigError, match=r"version 2 of the rig is active and cannot be used.*delete .*active\.json to run"):
            async with site(free_port, tmp_path):
                pass
        path.write_bytes(whole)
        async with site(free_port, tmp_path) as here:
            assert (await here.told())["active"]["version"] == 2
        assert rig_file.load(path)[0].T_base_rig is not None      # versions are rig files for every other command
    holds(scenario)
