"""Whether the cell is well, as a pure judgement of its facts; every reason says what is wrong and where."""

from dataclasses import dataclass
from typing import Literal

from binpick.errors import Code
from binpick.result import Snapshot


@dataclass(frozen=True, slots=True)
class Health:
    """`live`: restarting the daemon would not help; `ready`: a cycle would start now, or runs. `reasons` is empty when ok."""

    status: Literal["ok", "degraded", "fault"]
    live: bool
    ready: bool
    reasons: tuple[str, ...]


def judge(snapshot: Snapshot, *, alive: bool = True, recording: str = "") -> Health:
    """The health of a cell: `alive` says whether its worker thread is, `recording` why the last cycle is not on disk.

    fault: no cycle can run and somebody has to act. degraded: cycles run or soon will, but something wants attention.
    """
    faults = [] if alive else ["the cell's thread has died: restart the daemon and report the log"]
    faults += [f"camera {camera.name} is down: {camera.error}" for camera in snapshot.cameras
               if not camera.connected and camera.error]
    attention = [*_waiting(snapshot, bool(faults)), *snapshot.faults, *_calibration(snapshot)]
    if recording:
        attention.append(f"recording: {recording}")
    return Health(
        status="fault" if faults else "degraded" if attention else "ok", live=alive,
        ready=alive and snapshot.phase in ("ready", "acquiring", "computing"), reasons=(*faults, *attention))


def _waiting(snapshot: Snapshot, faulted: bool) -> list[str]:
    """Why a cell without a fault is not ready."""
    if snapshot.phase == "stopping":
        return ["the cell is stopping"]
    if snapshot.phase != "starting" or faulted:
        return []
    if all(camera.connected for camera in snapshot.cameras) and snapshot.cameras:
        return ["a withdrawn cycle is still being cleared away"]
    return ["the cameras are being opened"]


def _calibration(snapshot: Snapshot) -> list[str]:
    latest = snapshot.latest
    warned = latest is not None and latest.result.return_code.code in (Code.CALIBRATION_WARNING, Code.CALIBRATION_FAULT)
    return [latest.result.return_code.message] if warned and latest is not None else []
