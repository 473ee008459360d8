"""Health names what is wrong, and calls nothing a fault that ends by itself."""

import pytest

from binpick import health
from binpick.data import CameraStatus
from binpick.result import Drift, Snapshot

UP = (CameraStatus("left", True), CameraStatus("right", True))
DOWN = (CameraStatus("left", True), CameraStatus("right", False, error="no camera answers at 10.0.0.2"))
DRIFTED, GONE = (Drift(level=level, attention=(f"rows are off: {level}",)) for level in ("warn", "fault"))


@pytest.mark.parametrize(("snapshot", "expected"), [
    (Snapshot(1, "ready", cameras=UP), ("ok", True, ())),
    (Snapshot(1, "computing", cameras=UP), ("ok", True, ())),
    (Snapshot(1, "starting"), ("degraded", False, ("the cameras are being opened",))),
    (Snapshot(1, "starting", cameras=DOWN), ("fault", False, ("camera right is down: no camera answers at 10.0.0.2",))),
    (Snapshot(1, "starting", cameras=UP), ("degraded", False, ("a withdrawn cycle is still being cleared away",))),
    (Snapshot(1, "stopping", cameras=UP), ("degraded", False, ("the cell is stopping",))),
    (Snapshot(1, "ready", cameras=UP, faults=("internal error",)), ("degraded", True, ("internal error",))),
    (Snapshot(1, "ready", cameras=UP, drift=Drift(unseen=("a turn about the vertical",))), ("ok", True, ())),
    (Snapshot(1, "ready", cameras=UP, drift=Drift(marks="to be stored", attention=("store them",))),
     ("degraded", True, ("store them",))),
    (Snapshot(1, "ready", cameras=UP, drift=DRIFTED), ("degraded", True, ("rows are off: warn",))),
    (Snapshot(1, "ready", cameras=UP, drift=GONE), ("fault", True, ("rows are off: fault",))),
])
def test_the_facts_give_the_judgement(snapshot: Snapshot, expected: tuple[str, bool, tuple[str, ...]]) -> None:
    judged = health.judge(snapshot)
    assert (judged.status, judged.ready, judged.reasons) == expected
    assert judged.live


def test_a_dead_thread_is_the_only_reason_to_restart() -> None:
    judged = health.judge(Snapshot(1, "ready", cameras=UP), alive=False)
    assert (judged.status, judged.live, judged.ready) == ("fault", False, False)


def test_lost_recordings_are_told() -> None:
    judged = health.judge(Snapshot(1, "ready", cameras=UP), recording="the disk is full")
    assert (judged.status, judged.reasons) == ("degraded", ("recording: the disk is full",))
