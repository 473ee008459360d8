"""How soon a cell finds that a camera is gone, how soon after its return a pair is good, and what reconnects leave behind."""

import statistics
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any

from rich.table import Table

from binpick import settings
from binpick.camera import backends
from binpick.cell import machine, worker
from binpick.cell.board import Board
from binpick.cell.gallery import Gallery
from binpick.cell.meter import Meter
from binpick.cell.worker import Worker
from binpick.cycle import CycleInput, CycleResult
from binpick.errors import Code, CycleRefused, NotReady
from binpick.lab import footprint
from binpick.lab.rig import SMALL, Plan, Rig, free
from binpick.result import Request, Result, ReturnCode
from binpick.rig import Rig as RigFile
from binpick.settings.cell import AravisCameras

FAULTS = ("unplug", "power=off", "reboot=1", "stolen")
OUTAGES_S = (0.5, 6.0, 0.5, 0.5)
"""After it was found: shorter, or longer than what the driver takes to let go of a dead camera, and the camera of its owner."""
PATIENCE_S = 60.0
NEVER_NS = 10**15
WARM = 10
"""Reconnects before what is left behind counts."""
EYE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
K = ((600.0, 0.0, 320.0), (0.0, 600.0, 200.0), (0.0, 0.0, 1.0))
POSE = settings.Pose(position_m=(0.0, 0.0, 1.0), rotvec_rad=(0.0, 0.0, 0.0))


class Cell:
    """A cell's thread over these cameras, without perception: a cycle is its pair."""

    def __init__(self, cameras: AravisCameras) -> None:
        self._settings = settings.Cell(
            bins=(settings.Bin(inner_size_m=(0.6, 0.4, 0.18), pose=POSE),), recipes=(settings.Recipe(frame="camera"),),
            cameras=cameras, control="rest")
        rig = RigFile.model_validate({"image_size_px": SMALL, "cameras": [
            {"name": name, "K": K, "distortion": (0, 0, 0, 0), "T_cam_rig": T}
            for name, T in (("left", EYE), ("right", ((1.0, 0.0, 0.0, -0.15), *EYE[1:])))]})
        self._board = Board(machine.State(max_age_ns=NEVER_NS), 1, "rest")
        self._thread = worker.thread(Worker(self._board, Gallery(), backends.group(cameras), rig, _accept,
                                            lambda _, cycle, __: cycle, None, time.monotonic_ns, Meter(rig)))

    def __enter__(self) -> "Cell":
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._board.step(machine.stop, time.monotonic_ns())
        self._thread.join(PATIENCE_S)

    @property
    def ready(self) -> bool:
        """Whether a cycle can be started."""
        return self._board.state.phase == "ready"

    def good(self) -> bool:
        """Whether one was started, and ended well."""
        try:
            number = self._board.step(machine.start, Request(), settings.resolve(self._settings), time.monotonic_ns(),
                                      NEVER_NS).last_id
        except CycleRefused:
            return False
        found = machine.find(self._board.wait(lambda state: state.ticket is None, PATIENCE_S), number)
        return found is not None and found.result.return_code.code is Code.BIN_EMPTY


def _accept(inputs: CycleInput, _proceed: Callable[[], None]) -> CycleResult:
    return CycleResult(Result(cycle_id=inputs.cycle_id, request=inputs.request, captured_at=inputs.pair.captured_at,
                              simulated=True, return_code=ReturnCode.of(Code.BIN_EMPTY), bin=None))


def run(reconnects: int, tick: Callable[[float], None] = lambda _: None) -> dict[str, Any]:
    """So many outages of the right camera: one fault after the other, of an idle cell and of one in a cycle, long and short."""
    plan = Plan(free(), SMALL)
    outages = [(fault, step, outage_s) for outage_s in OUTAGES_S for step in ("idle", "cycle") for fault in FAULTS]
    times: dict[tuple[str, str], list[tuple[float, float]]] = {}
    memory: list[tuple[float, float]] = []
    with Rig(plan) as rig, Cell(plan.cameras(max_skew_us=1_000_000.0)) as cell:
        _wait(cell.good)
        before = footprint.settled(2)
        for turn in range(reconnects):
            fault, step, outage_s = outages[turn % len(outages)]
            times.setdefault((fault, step), []).append(_suffer(rig, cell, fault, step, outage_s))
            memory.append((turn / 100, footprint.now().memory_mb))
            if turn + 1 == min(WARM, reconnects):
                before = footprint.settled(2)
            tick((turn + 1) / reconnects)
        after = footprint.settled(2)
    return {"reconnects": reconnects, "before": before.row(), "after": after.row(),
            "memory_mb_per_100": footprint.growth_mb(memory), "faults": [
        {"fault": fault, "step": step, "times": len(found), **_medians(found)} for (fault, step), found in times.items()]}


def _suffer(rig: Rig, cell: Cell, fault: str, step: str, outage_s: float) -> tuple[float, float]:
    """Seconds from the fault until the cell says so, and from its end to a good pair."""
    began = time.monotonic()
    rig.fault(f"{fault}@right")
    if step == "cycle":
        cell.good()
    _wait(lambda: not cell.ready or (fault.startswith("reboot") and rig.powered(1) and time.monotonic() - began > 3))
    found_s = time.monotonic() - began
    if fault.startswith("reboot"):
        _wait(lambda: rig.powered(1))
    else:
        time.sleep(outage_s)
        rig.fault("clear@right")
    ended = time.monotonic()
    _wait(cell.good)
    return found_s, time.monotonic() - ended


def _wait(until: Callable[[], bool]) -> None:
    limit = time.monotonic() + PATIENCE_S
    while not until():
        if time.monotonic() > limit:
            raise NotReady(f"the cell did not recover within {PATIENCE_S:.0f} s of a fault: run it again with nothing else "
                           "running; if it ends here again, it is the service that does not recover")
        time.sleep(0.005)


def _medians(found: list[tuple[float, float]]) -> dict[str, float]:
    named = zip(("found", "back"), zip(*found, strict=True), strict=True)
    return {f"{name}_{kind}_s": round(figure(seconds), 2) for name, seconds in named
            for kind, figure in (("median", statistics.median), ("max", max))}


def table(run: dict[str, Any]) -> Table:
    """Simulator figures, one row a fault; what 10 and all reconnects left behind below."""
    left = "; ".join(f"{when}: {', '.join(f'{value} {name}' for name, value in run[when].items())}"
                     for when in ("before", "after"))
    grown = "" if run["memory_mb_per_100"] is None else f", {run['memory_mb_per_100']:+.2f} MB in 100 reconnects"
    sheet = Table("right camera", "the cell is", "times", "found s, median / max", "good pair after its return s, median / max",
                  title="Recovery on simulated cameras (simulator figures, not a camera's)",
                  caption=f"{run['reconnects']} reconnects, {left}{grown}")
    for row in run["faults"]:
        sheet.add_row(row["fault"], row["step"], str(row["times"]), f"{row['found_median_s']:.2f} / {row['found_max_s']:.2f}",
                      f"{row['back_median_s']:.2f} / {row['back_max_s']:.2f}")
    return sheet
