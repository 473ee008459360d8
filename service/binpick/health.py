"""Whether the cell is well, as a pure judgement of its facts; every reason says what is wrong and where."""

from dataclasses import dataclass
from typing import Literal

from binpick.result import Snapshot


@dataclass(frozen=True, slots=True)
class Health:
    """`live`: restarting the daemon would not help; `ready`: a cycle would start now, or runs. `reasons` is empty when ok.

    `unseen`: what no check of the calibration in this cell would notice; no reason to worry, but to know.
    """

    status: Literal["ok", "degraded", "fault"]
    live: bool
    ready: bool
    reasons: tuple[str, ...]
    unseen: tuple[str, ...] = ()
    rig: str = ""
    """The version of the rig that the cell runs on."""


def judge(snapshot: Snapshot, *, alive: bool = True, recording: str = "") -> Health:
    """The health of a cell: `alive` says whether its worker thread is, `recording` why the last cycle is not on disk.

    fault: no cycle can run and somebody has to act. degraded: cycles run or soon will, but something wants attention.
    """
    faults = [] if alive else ["the cell's thread has died: restart the daemon and report the log"]
    faults += [f"camera {camera.name} is down: {camera.error}" for camera in snapshot.cameras
               if not camera.connected and camera.error]
    waiting = _waiting(snapshot, bool(faults))
    known = snapshot.drift
    drifted = known is not None and known.level == "fault"
    if known is not None and drifted:
        faults += known.attention
    attention = [*waiting, *snapshot.faults, *(known.attention if known is not None and not drifted else ())]
    if snapshot.rig_note:
        attention.append(f"rig: {snapshot.rig_note}")
    if recording:
        attention.append(f"recording: {recording}")
    return Health(
        status="fault" if faults else "degraded" if attention else "ok", live=alive,
        ready=alive and snapshot.phase in ("ready", "acquiring", "computing"), reasons=(*faults, *attention),
        unseen=known.unseen if known is not None else (),
        rig=f"version {snapshot.rig.version}, sha256 {snapshot.rig.sha256}" if snapshot.rig is not None else "")


def _waiting(snapshot: Snapshot, faulted: bool) -> list[str]:
    """Why a cell without a fault is not ready."""
    if snapshot.phase == "stopping":
        return ["the cell is stopping"]
    if snapshot.phase != "starting" or faulted:
        return []
    if all(camera.connected for camera in snapshot.cameras) and snapshot.cameras:
        return ["a withdrawn cycle is still being cleared away"]
    return ["the cameras are being opened"]
