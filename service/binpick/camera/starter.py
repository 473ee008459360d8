"""How one shot is started on all cameras: which of them get a trigger of their own, and what starts the others."""

from collections.abc import Sequence
from dataclasses import dataclass

from binpick.camera import action, proof
from binpick.camera.action import Action
from binpick.camera.base import Camera, Clock
from binpick.data import CameraStatus
from binpick.settings.cell import Sync

LEAD_NS = 8_000_000
"""From sending a scheduled action to its time: longer than a busy host takes to send it."""


@dataclass(frozen=True, slots=True)
class Starter:
    """One of the sync modes; `device_key` is what the cameras were told to listen for."""

    sync: Sync = "software"
    device_key: int = 0

    def follows(self, index: int) -> bool:
        """Whether something else than its own software trigger starts that camera."""
        return self.sync in ("action", "scheduled_action") or (self.sync == "line" and index > 0)

    def order(self, cameras: int) -> Sequence[int]:
        """Whom to prepare or trigger first: the one that starts the others by a wire comes last."""
        return range(cameras)[::-1] if self.sync == "line" else range(cameras)

    def unready(self, statuses: Sequence[CameraStatus]) -> str:
        """Why no shot can be started, "" when one can: a time for all means nothing without PTP."""
        states = [status.ptp for status in statuses]
        if self.sync != "scheduled_action" or proof.together(states):
            return ""
        said = ", ".join(f"{status.name} {status.ptp or 'without PTP'}" for status in statuses)
        return f"the cameras' clocks do not keep together by PTP ({said}): are they on one switch?"

    def fire(self, cameras: Sequence[Camera], clock: Clock) -> str:
        """Sends the action command, if that is the mode; why not every camera accepted it, "" when all did."""
        if self.sync not in ("action", "scheduled_action"):
            return ""
        at_ns = 0
        if self.sync == "scheduled_action":
            times = [time_ns for camera in cameras if (time_ns := camera.device_ns(clock() + LEAD_NS)) is not None]
            if not times:
                return "the cameras' time is not known yet"
            at_ns = max(times)
        names = {camera.status().address: camera.name for camera in cameras}
        try:
            said = action.broadcast(Action(self.device_key, at_ns=at_ns), tuple(names))
        except OSError as error:
            return f"the action command cannot be sent ({error.strerror or error}): check this host's network"
        return "; ".join(f"camera {names[address]} did not take the action command: {why}"
                         for address, why in said.items() if why)
