"""The messages of REST that are not a result: what goes in, and the state that comes out."""

from typing import Annotated, Literal

from pydantic import Field

from binpick.data import CameraStatus
from binpick.message import Level, Wire
from binpick.result import Owner, Phase, Published, Snapshot

NS_PER_MS = 1_000_000
UNKNOWN_AGE = b'\n "age_ms": null'


class Outcome(Wire):
    """What became of a grasp."""

    code: Annotated[int, Field(ge=1, le=7)]
    """1 ok, 2 missed, 3 dropped, 4 collision, 5 skipped, 6 double, 7 unreachable."""


class Accepted(Wire):
    """A cycle that runs: its result will be at /v1/cycles/{cycle_id}."""

    cycle_id: int
    phase: Literal["acquiring", "computing"]


class State(Wire):
    """The cell at one instant, as /v1/events tells it."""

    boot_id: int
    phase: Phase
    cycle_id: int
    """The cycle in flight; 0: none."""
    acquired: bool
    """The pair of the cycle in flight was accepted: the robot may move."""
    latest: int
    """The last finished cycle; 0: none."""
    valid: bool
    """The published result holds."""
    withdrawn: str
    """Why it does not."""
    rig_version: int
    """The version of the rig that the next cycle runs on."""
    owner: Owner
    simulated: bool
    faults: tuple[str, ...]
    calibration: Level | None
    """What the watchdog says of the calibration; null: nobody watches it."""
    cameras: tuple[CameraStatus, ...]
    counts: dict[str, int]

    @classmethod
    def of(cls, snapshot: Snapshot) -> "State":
        """The snapshot as a message."""
        return cls(
            boot_id=snapshot.boot_id, phase=snapshot.phase, cycle_id=snapshot.current, acquired=snapshot.acquired,
            latest=snapshot.latest.result.cycle_id if snapshot.latest else 0, valid=snapshot.valid,
            withdrawn=snapshot.withdrawn, rig_version=snapshot.rig_version, owner=snapshot.owner,
            simulated=snapshot.simulated, faults=snapshot.faults, cameras=snapshot.cameras, counts=dict(snapshot.counts),
            calibration=snapshot.drift.level if snapshot.drift is not None else None)


def age_ms(published: Published, now_ns: int) -> float | None:
    """Milliseconds since the trigger (monotonic clock); None for a cycle that took no images."""
    if published.result.captured_at is None:
        return None
    return round((now_ns - published.triggered_ns) / NS_PER_MS, 1)


def aged(published: Published, now_ns: int) -> bytes:
    """The stored bytes of a result with its age of this moment filled in; nothing is serialised again."""
    age = age_ms(published, now_ns)
    if age is None:
        return published.body
    if UNKNOWN_AGE not in published.body:
        raise ValueError("a stored result already has an age")
    return published.body.replace(UNKNOWN_AGE, b'\n "age_ms": %.1f' % age, 1)
