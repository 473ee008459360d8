"""What the page says in words, and in which tone: pure, from a snapshot."""

from dataclasses import dataclass
from typing import Literal

from binpick.health import Health
from binpick.result import ReturnCode, Snapshot

Tone = Literal["good", "busy", "warn", "bad", "off"]

OWNERS = {"modbus": "Modbus/TCP", "rest": "REST", "none": "nobody"}
SURVIVORS = {"parts": "parts seen", "faces": "faces on them", "spots": "spots tried", "sealed": "the cup seals",
             "clear": "the tool is clear", "published": "published"}
LOSSES = {"rim_not_on_one_part": "lip off the part", "no_seal": "too uneven to seal", "tilt": "tilted too far",
          "collide": "tool would collide", "history": "failed here before", "gate_not_finite": "last gate: not a number",
          "gate_quaternion": "last gate: no unit quaternion", "gate_pregrasp": "last gate: pre-grasp is elsewhere",
          "gate_outside_bin": "last gate: outside the bin", "gate_out_of_reach": "last gate: out of reach",
          "gate_tilt": "last gate: tilted too far", "gate_older_than_trigger": "last gate: older than its trigger"}


@dataclass(frozen=True, slots=True)
class Banner:
    """The state in a word one reads from across the hall, and why."""

    word: str
    tone: Tone
    reason: str


def banner(snapshot: Snapshot, health: Health) -> Banner:
    """A running cycle is told first, then what is wrong, then that all is well."""
    reasons = "; ".join(health.reasons)
    match snapshot.phase:
        case "stopping":
            return Banner("STOPPING", "off", "the daemon is shutting down")
        case "acquiring":
            return Banner("CAPTURING", "busy", f"cycle {snapshot.current}: keep out of the cameras' view")
        case "computing":
            return Banner("COMPUTING", "busy", f"cycle {snapshot.current}: images taken, the robot may move")
    if health.status == "fault":
        return Banner("FAULT", "bad", reasons)
    if snapshot.phase == "starting":
        return Banner("STARTING", "warn", reasons)
    if health.status == "degraded":
        return Banner("READY", "warn", reasons)
    return Banner("READY", "good", "nobody may trigger: control is none in the cell file" if snapshot.owner == "none" else
                  f"waiting for a trigger over {OWNERS[snapshot.owner]}")


def tone(code: ReturnCode) -> Tone:
    """Poses are good, poses with a warning and scenes without are to be looked at, failures are bad."""
    return "good" if code.value == 0 else "bad" if code.value < 0 else "warn"


def hold(snapshot: Snapshot) -> str:
    """Whether the last result still holds."""
    return "valid" if snapshot.valid else f"no longer valid: {snapshot.withdrawn}" if snapshot.withdrawn else "no longer valid"


def stage(name: str) -> str:
    """A funnel stage for people; one without a word of its own shows its name."""
    return SURVIVORS.get(name) or LOSSES.get(name) or name.replace("_", " ")


def is_loss(name: str) -> bool:
    """Whether the stage counts what fell out."""
    return name in LOSSES or name.startswith("gate_")


def age(seconds: float) -> str:
    """How long ago, no finer than one reads it."""
    if seconds < 1:
        return "now"
    if seconds < 120:
        return f"{seconds:.0f} s ago"
    return f"{seconds / 60:.0f} min ago" if seconds < 7200 else f"{seconds / 3600:.0f} h ago"
