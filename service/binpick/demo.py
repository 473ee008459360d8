"""The simulated cell: a world of settled parts, two GigE Vision cameras looking at it, the daemon, and a PLC that picks.

The daemon is a process of its own, started as a user would start it; the only ways between it and this one are GigE Vision
packets, Modbus and HTTP. The world moves the tool to the pose that the PLC decoded from the registers, and decides by its own
truth what was picked.
"""

import asyncio
import contextlib
import logging
import signal
import socket
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
from rich.status import Status

from binpick import geometry, settings
from binpick import rig as rig_file
from binpick.errors import Code, NotReady, PortInUse
from binpick.geometry import Transform
from binpick.poses import PoseFormat, encode
from binpick.sim import exam, score
from binpick.sim.gige import Door, GigePair, gvcp
from binpick.sim.plc import Plc, PlcResult
from binpick.sim.score import Verdict
from binpick.sim.twin import Twin

BASE_FRAME = 3
"""Number of the robot's base in the registers."""
READY_S = 60.0
"""For the daemon's first READY; importing its libraries takes seconds on a cold disk."""
OUTCOME_OK, OUTCOME_MISSED, OUTCOME_COLLISION = 1, 2, 4
BARREN = 3
"""Cycles in a row without a pick, after which the picking ends."""
KINDS = "block+cylinder+tee"
"""What lies in the demo's bin: parts that its one cup can take however they come to lie. A bolt offers no cup a place."""
TOOL = {
    "number": 1, "name": "bellows cup 12 mm on a lance",
    # a cup of 1.5 folds follows a round bar: 0.75 mm either way on Ø24
    "cups": [{"radius_m": 0.006}], "compliance_m": 0.002,
    "bodies": [
        {"shape": "cylinder", "radius_m": 0.006, "length_m": 0.016, "T_tcp_body": {"position_m": [0.0, 0.0, -0.010]}},
        {"shape": "cylinder", "radius_m": 0.005, "length_m": 0.190, "T_tcp_body": {"position_m": [0.0, 0.0, -0.105]}},
        {"shape": "cylinder", "radius_m": 0.040, "length_m": 0.050, "T_tcp_body": {"position_m": [0.0, 0.0, -0.225]}}]}


@dataclass(frozen=True, slots=True)
class Plan:
    """One run of the demo; `cycles` 0: until the bin is empty. The defaults are the addresses a person finds in the README."""

    cycles: int = 0
    world: str = "A"
    parts: int = 25
    seed: int = 4
    cameras: tuple[str, str] = ("127.0.0.2", "127.0.0.3")
    rest_port: int = 8080
    modbus_port: int = 5020
    recording: Path | None = None


@dataclass(frozen=True, slots=True)
class Pick:
    """One cycle: what the daemon answered, where the tool went (None: nowhere), and what the world says became of it."""

    code: Code
    recipe: int
    acquire_ms: int
    total_ms: int
    T_base_tcp: Transform | None = None
    verdict: Verdict | None = None

    @property
    def picked(self) -> bool:
        """Whether a part left the bin."""
        return self.verdict is not None and self.verdict.ok

    @property
    def collided(self) -> bool:
        """Whether the tool ran into something."""
        return self.verdict is not None and self.verdict.penetration_m > score.MAX_PENETRATION_M

    def row(self, number: int) -> str:
        """The printed line under HEADING; why nothing was picked follows on a line of its own."""
        if self.T_base_tcp is None or self.verdict is None:
            return f"{number:5d}  {self.code.value} {self.code.name.lower()}: {self.code.message}"
        x, y, z = 1000 * self.T_base_tcp[:3, 3]
        outcome = f"picked {self.verdict.kind}" if self.picked else "MISSED"
        spoken = PoseFormat.ur_rxryrz_rad if self.recipe == 1 else PoseFormat.quaternion_xyzw
        numbers = encode(geometry.quaternion(self.T_base_tcp), spoken)
        orientation = ("UR" if self.recipe == 1 else "quat").ljust(5) + "".join(f"{n:8.4f}" for n in numbers)
        error = f"{1000 * self.verdict.distance_m:+8.2f}{np.degrees(self.verdict.angle_rad):7.1f}°"
        line = f"{number:5d}  {outcome:<16}{x:8.1f}{y:8.1f}{z:8.1f}  {orientation:<37}{error}"
        line += f"{self.acquire_ms:6d} ms{self.total_ms:5d} ms"
        return line if self.picked else f"{line}\n       {self.verdict.reason}"


HEADING = (f"cycle  {'outcome':<16}{'x':>8}{'y':>8}{'z mm':>8}  {'orientation, as the recipe speaks':<37}"
           f"{'error mm':>8}{'angle':>8}{'images':>9}{'poses':>8}")


def run(plan: Plan, headless: bool) -> int:
    """Plays the cell; returns 0 when all went well, or Ctrl-C or SIGTERM ended it.

    Returns 1 when the tool ran into something, nothing could be picked, the picking ended before the plan's last cycle with
    parts in the bin, or the bin was called empty and was not. Raises PortInUse, NotReady and the like when it cannot go on.
    """
    say = Console(highlight=False, markup=False, emoji=False, soft_wrap=True)
    _require_free(plan)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    # an answer that comes after Ctrl-C is no news
    logging.getLogger("pymodbus.logging").setLevel(logging.CRITICAL)
    try:
        with _waiting(say, f"Letting {plan.parts} parts fall into the bin, and drawing it ..."):
            twin = Twin(plan.world, KINDS, plan.parts, plan.seed)
        return asyncio.run(_play(plan, twin, headless, say))
    except (KeyboardInterrupt, asyncio.CancelledError):
        # everything has ended; an impatient second Ctrl-C must not spoil that
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
        say.print("stopped")
        return 0


def _require_free(plan: Plan) -> None:
    """Raises PortInUse, before anything slow begins."""
    wanted = [("127.0.0.1", port, socket.SOCK_STREAM) for port in (plan.rest_port, plan.modbus_port)]
    wanted += [(address, gvcp.PORT, socket.SOCK_DGRAM) for address in plan.cameras]
    for host, port, kind in wanted:
        with socket.socket(socket.AF_INET, kind) as probe:
            if kind is socket.SOCK_STREAM:
                # as servers do: connections of a demo that ended a moment ago do not matter
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, port))
            except OSError as error:
                raise PortInUse(f"the demo cannot use {host}:{port} ({error.strerror}): end the program that has it, "
                                "perhaps another demo, and start again") from error


@contextlib.contextmanager
def _waiting(say: Console, what: str) -> Iterator[Status]:
    """Says what takes time: beside a spinner on a terminal, as a line elsewhere."""
    if not say.is_terminal:
        say.print(what)
    with say.status(what) as status:
        yield status


async def _play(plan: Plan, twin: Twin, headless: bool, say: Console) -> int:
    _cancel_on_signals(say)
    with tempfile.TemporaryDirectory(prefix="binpick-demo-") as folder, GigePair(twin.image, plan.cameras) as pair, Door(pair):
        cell = files(plan, Path(folder))
        say.print(f"cameras     {plan.cameras[0]} and {plan.cameras[1]} (GigE Vision, simulated)")
        with _daemon(Path(folder)) as alive:
            with _waiting(say, "Starting the daemon ..."):
                await _wait_listening(plan.modbus_port, alive)
            say.print(f"page        http://127.0.0.1:{plan.rest_port}/ui")
            say.print(f"REST        http://127.0.0.1:{plan.rest_port}/v1")
            say.print(f"Modbus/TCP  127.0.0.1:{plan.modbus_port}")
            try:
                picks = await _picks(plan, twin, cell.tools[0], say)
            except NotReady:
                # when the daemon has died, its own last word tells more
                alive()
                raise
            code = _sum_up(plan, picks, twin.parts_left, say)
            if not headless:
                say.print("The daemon stays up for you to look at; Ctrl-C ends it.")
                while alive():
                    await asyncio.sleep(0.5)
    return code


def _cancel_on_signals(say: Console) -> None:
    """From here on Ctrl-C and SIGTERM unwind this task; the unwinding itself cannot be interrupted, and is short."""
    loop, task = asyncio.get_running_loop(), asyncio.current_task()

    def stop() -> None:
        if task is not None and not task.cancelling() and task.cancel():
            say.print("stopping ...")

    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop)


async def _picks(plan: Plan, twin: Twin, tool: settings.Tool, say: Console) -> list[Pick]:
    """Cycles until the plan's number, the empty bin, or three without a pick in a row."""
    picks: list[Pick] = []
    barren = 0
    with _waiting(say, "Waiting until the cell is ready ...") as status:
        async with Plc("127.0.0.1", plan.modbus_port) as plc:
            await plc.clear(READY_S)
            say.print(f"\n{HEADING}")
            while len(picks) < (plan.cycles or 10 * plan.parts + 1) and barren < BARREN:
                recipe = 1 + len(picks) % 2
                status.update("The PLC has triggered; the daemon looks ...")
                result = await plc.pick(recipe=recipe)
                status.update("The robot moves; what is left settles and is drawn anew ...")
                pick = await asyncio.to_thread(_move, twin, result, recipe, tool)
                picks.append(pick)
                say.print(pick.row(len(picks)))
                barren = 0 if pick.picked else barren + 1
                if result.records:
                    outcome = OUTCOME_COLLISION if pick.collided else OUTCOME_OK if pick.picked else OUTCOME_MISSED
                    await plc.report(result.seq, result.records[0].grasp_id, outcome)
                if pick.code is Code.BIN_EMPTY:
                    break
    return picks


def _move(twin: Twin, result: PlcResult, recipe: int, tool: settings.Tool) -> Pick:
    """Sends the tool to the first pose of a result. Raises NotReady for a pose that a robot could not use."""
    code = Code(result.return_code)
    if not result.records:
        return Pick(code, recipe, result.acquire_ms, result.total_ms)
    if result.frame != BASE_FRAME:
        raise NotReady(f"the registers give poses in frame {result.frame}, the robot needs its base ({BASE_FRAME})")
    first = result.records[0]
    verdict = twin.move(first.T_frame_tcp, tool, first.open_m, first.close_m)
    return Pick(code, recipe, result.acquire_ms, result.total_ms, first.T_frame_tcp, verdict)


def _sum_up(plan: Plan, picks: list[Pick], left: int, say: Console) -> int:
    """The last line, and the exit code as `run` tells it."""
    picked, hit = sum(p.picked for p in picks), sum(p.collided for p in picks)
    missed = sum(p.verdict is not None for p in picks) - picked
    state = f"{left} parts left in the bin" if left else "the bin is empty"
    say.print(f"\n{len(picks)} cycles: {picked} parts picked, {missed} missed, {hit} collisions; {state}")
    well = not left if picks[-1].code is Code.BIN_EMPTY else picked > 0 and len(picks) == plan.cycles
    return 0 if well and not hit else 1


def files(plan: Plan, folder: Path) -> settings.Cell:
    """Writes the cell file and the rig file that the daemon runs on, as a user would have them."""
    cell = exam.cell(
        plan.world,
        bin_frame="base",
        cameras={"backend": "aravis", "left": {"address": plan.cameras[0]}, "right": {"address": plan.cameras[1]},
                 "packet_size": 9000},
        tools=[TOOL],
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
