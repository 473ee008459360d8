"""The simulated cell: a world of settled parts, two GigE Vision cameras looking at it, the daemon, and a PLC that picks.

The daemon is a process of its own, started as a user would start it; the only ways between it and this one are GigE Vision
packets, Modbus and HTTP. The world moves the tool to the pose that the PLC decoded from the registers, and decides by its own
truth what was picked.
"""

import asyncio
import contextlib
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from rich.console import Console

from binpick import geometry, settings
from binpick import rig as rig_file
from binpick.data import Image, Light
from binpick.errors import Code, NotReady
from binpick.geometry import Transform
from binpick.sim import exam, score
from binpick.sim.gige import GigePair
from binpick.sim.plc import Plc, PlcResult
from binpick.sim.render import Renderer
from binpick.sim.world import World

BASE_FRAME = 3
"""Number of the robot's base in the registers."""
READY_S = 60.0
"""For the daemon's first READY; importing its libraries takes seconds on a cold disk."""
OUTCOME_OK, OUTCOME_MISSED, OUTCOME_COLLISION = 1, 2, 4


@dataclass(frozen=True, slots=True)
class Plan:
    """One run of the demo; `cycles` 0: until the bin is empty. The defaults are the addresses a person finds in the README."""

    cycles: int = 0
    world: str = "A"
    parts: int = 25
    seed: int = 7
    cameras: tuple[str, str] = ("127.0.0.2", "127.0.0.3")
    rest_port: int = 8080
    modbus_port: int = 5020
    recording: Path | None = None


@dataclass(frozen=True, slots=True)
class Pick:
    """What the world says of one cycle; `part` is the kind that was picked, "" when none was."""

    code: Code
    part: str
    reason: str
    T_base_tcp: Transform | None
    distance_m: float
    angle_rad: float
    collision: bool
    recipe: int
    acquire_ms: int
    total_ms: int

    def sentence(self, number: int) -> str:
        """The printed line: outcome, pose, true error (signed distance to the surface along the approach, angle), times."""
        if self.T_base_tcp is None:
            return f"{number:3d}  {self.code.value} {self.code.name.lower()}: {self.code.message}"
        x, y, z = 1000 * self.T_base_tcp[:3, 3]
        outcome = f"picked {self.part:<9}" if self.part else f"MISSED ({self.reason})"
        spoken = "rotation vector" if self.recipe == 1 else "quaternion"
        pose = f"at {x:7.1f} {y:7.1f} {z:7.1f} mm ({spoken:<15})"
        error = f"true error {1000 * self.distance_m:+5.2f} mm {np.degrees(self.angle_rad):4.1f}°"
        return f"{number:3d}  {outcome} {pose}  {error}  images {self.acquire_ms:4d} ms  poses {self.total_ms:4d} ms"


class Twin:
    """The world as the cameras see it: renders when it changes, so a shot only adds exposure and noise."""

    def __init__(self, plan: Plan) -> None:
        self.world = World(plan.world, "mixed", plan.parts, plan.seed)
        self.T_base_bin = exam.setup(plan.world).T_base_bin
        self._renderer = Renderer(exam.rig(plan.world), plan.world)
        self._scene = self.world.scene()
        self.render()

    def render(self) -> None:
        """Shows the cameras the world as it is now, with the pattern on as the recipes ask."""
        scene = self.world.scene()
        for index in (0, 1):
            self._renderer.radiance(scene, index, True)
        self._scene = scene

    def image(self, index: int, light: Light, shot: int) -> Image:
        """What a camera's sensor reads out."""
        return self._renderer.expose(self._scene, index, light, shot)

    def move(self, result: PlcResult, recipe: int, tool: settings.Tool) -> Pick:
        """Sends the tool to the first pose of a result; a part that is picked leaves the bin."""
        code = Code(result.return_code)
        if not result.records:
            return Pick(code, "", "", None, np.nan, np.nan, False, recipe, result.acquire_ms, result.total_ms)
        if result.frame != BASE_FRAME:
            raise NotReady(f"the registers give poses in frame {result.frame}, the robot needs its base ({BASE_FRAME})")
        T_base_tcp = result.records[0].T_frame_tcp
        verdict = score.judge(self.world.scene(), geometry.inverse(self.T_base_bin) @ T_base_tcp, tool)
        if verdict.ok:
            self.world.remove(verdict.part_id)
            self.world.settle()
            self.render()
        return Pick(
            code,
            verdict.kind if verdict.ok else "",
            verdict.reason,
            T_base_tcp,
            verdict.distance_m,
            verdict.angle_rad,
            verdict.penetration_m > score.MAX_PENETRATION_M,
            recipe,
            result.acquire_ms,
            result.total_ms,
        )


def run(plan: Plan, headless: bool, say: Console | None = None) -> int:
    """Plays the cell; returns 0 unless a tool collided, nothing could be picked, or something broke.

    Raises PortInUse, NotReady and the like when it cannot start.
    """
    say = say or Console(highlight=False)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        return asyncio.run(_play(plan, headless, say))
    except KeyboardInterrupt:
        say.print("stopped")
        return 0


async def _play(plan: Plan, headless: bool, say: Console) -> int:
    with say.status(f"Letting {plan.parts} parts fall into the bin, and lighting the scene ..."):
        twin = await asyncio.to_thread(Twin, plan)
    with tempfile.TemporaryDirectory(prefix="binpick-demo-") as folder, GigePair(twin.image, plan.cameras):
        cell = files(plan, Path(folder))
        with _daemon(Path(folder)) as alive:
            say.print(f"cameras   {plan.cameras[0]} and {plan.cameras[1]} (GigE Vision, simulated)")
            say.print(
                f"page      http://127.0.0.1:{plan.rest_port}/ui    REST  http://127.0.0.1:{plan.rest_port}/v1    "
                f"Modbus/TCP  127.0.0.1:{plan.modbus_port}"
            )
            with say.status("Starting the daemon ..."):
                await _wait_listening(plan.modbus_port, alive)
            picks = await _picks(plan, twin, cell.tools[0], say)
            code = _sum_up(picks, twin, say)
            if not headless:
                say.print("The daemon stays up for you to look at; Ctrl-C ends it.")
                while alive():
                    await asyncio.sleep(0.5)
    return code


async def _picks(plan: Plan, twin: Twin, tool: settings.Tool, say: Console) -> list[Pick]:
    """Cycles until the plan's number, the empty bin, or three without a pick in a row."""
    picks: list[Pick] = []
    barren = 0
    async with Plc("127.0.0.1", plan.modbus_port) as plc:
        await plc.clear(READY_S)
        while len(picks) < (plan.cycles or 10 * plan.parts) and barren < 3:
            recipe = 1 + len(picks) % 2
            result = await plc.pick(recipe=recipe)
            pick = await asyncio.to_thread(twin.move, result, recipe, tool)
            picks.append(pick)
            say.print(pick.sentence(len(picks)), soft_wrap=True)
            barren = 0 if pick.part else barren + 1
            if result.records:
                outcome = OUTCOME_COLLISION if pick.collision else OUTCOME_OK if pick.part else OUTCOME_MISSED
                await plc.report(result.seq, result.records[0].grasp_id, outcome)
            if pick.code is Code.BIN_EMPTY:
                break
    return picks


def _sum_up(picks: list[Pick], twin: Twin, say: Console) -> int:
    picked, hit = sum(bool(p.part) for p in picks), sum(p.collision for p in picks)
    left = len(twin.world.scene().parts)
    say.print(f"{len(picks)} cycles: {picked} parts picked, {hit} collisions, {left} parts left in the bin")
    return 0 if picked and not hit else 1


def files(plan: Plan, folder: Path) -> settings.Cell:
    """Writes the cell file and the rig file that the daemon runs on, as a user would have them."""
    cell = exam.cell(
        plan.world,
        bin_frame="base",
        cameras={
            "backend": "aravis",
            "left": {"address": plan.cameras[0]},
            "right": {"address": plan.cameras[1]},
            "packet_size": 9000,
        },
        publish={"rest": {"port": plan.rest_port}, "modbus": {"host": "127.0.0.1", "port": plan.modbus_port}},
        recording={"directory": None if plan.recording is None else str(plan.recording.absolute())},
    )
    (folder / "rig.json").write_bytes(rig_file.dump(exam.rig(plan.world)))
    (folder / "cell.yaml").write_text(yaml.safe_dump(cell.model_dump(mode="json", exclude_unset=True)), encoding="utf-8")
    return cell


@contextlib.contextmanager
def _daemon(folder: Path) -> Iterator[Callable[[], bool]]:
    """`binpick run` as a process of its own, ended with SIGTERM; yields a check that raises NotReady when it died."""
    with (folder / "daemon.log").open("w+b") as said:
        process = subprocess.Popen(
            [sys.executable, "-m", "binpick", "run", "--cell", str(folder / "cell.yaml")],
            stdout=said,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        )

        def alive() -> bool:
            if process.poll() is None:
                return True
            said.seek(0)
            last = said.read().decode(errors="replace").strip().splitlines()[-1:] or ["it said nothing"]
            raise NotReady(f"the daemon ended with exit code {process.returncode}: {last[0]}")

        try:
            yield alive
        finally:
            process.terminate()
            try:
                process.wait(5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


async def _wait_listening(port: int, alive: Callable[[], bool]) -> None:
    """Until somebody accepts connections there. Raises NotReady when the daemon ends before."""
    deadline = time.monotonic() + READY_S
    while alive() and time.monotonic() < deadline:
        try:
            _, writer = await asyncio.open_connection("127.0.0.1", port)
        except OSError:
            await asyncio.sleep(0.1)
            continue
        writer.close()
        await writer.wait_closed()
        return
    raise NotReady(f"the daemon did not listen on port {port} within {READY_S:.0f} s")
