"""What the handshake exchanges: the levels of the control words and a few facts of the cell in, actions on the cell out."""

from dataclasses import dataclass
from typing import TypeAlias

from binpick.calibration import SampleAnswer
from binpick.errors import Code
from binpick.publish.registers import Ctrl, Detail
from binpick.result import Snapshot

NO_CTRL = Ctrl(0)


@dataclass(frozen=True, slots=True)
class Facts:
    """The cell as the handshake needs it: `fault` is why it takes no cycle (0: it does), `finished` the last finished cycle."""

    fault: int = 0
    controlled: bool = True
    current: int = 0
    acquired: bool = False
    finished: int = 0
    code: int = 0
    detail: Detail = Detail.NONE
    valid: bool = False
    grasps: int = 0
    degraded: bool = False
    drifting: bool = False
    simulated: bool = False

    @classmethod
    def of(cls, snapshot: Snapshot) -> "Facts":
        """What a snapshot says."""
        latest = snapshot.latest.result if snapshot.latest else None
        published = snapshot.published.result if snapshot.published and snapshot.valid else None
        if snapshot.owner != "modbus":
            fault = Code.NOT_IN_CONTROL
        elif snapshot.phase in ("starting", "stopping"):
            fault = Code.CAMERAS if any(camera.error for camera in snapshot.cameras) else Code.NOT_READY
        else:
            fault = Code.BUSY if snapshot.phase != "ready" else Code.OK
        return cls(fault=fault.value, controlled=snapshot.owner == "modbus", current=snapshot.current,
                   acquired=snapshot.acquired, finished=latest.cycle_id if latest else 0,
                   code=latest.return_code.value if latest else 0,
                   detail=_detail(snapshot.latest.sample if snapshot.latest else None),
                   valid=latest is not None and published is not None and published.cycle_id == latest.cycle_id,
                   grasps=len(latest.grasps) if latest else 0, degraded=bool(snapshot.faults),
                   drifting=snapshot.drift is not None and snapshot.drift.level != "ok",
                   simulated=snapshot.simulated or (published is not None and published.simulated))


def _detail(answer: SampleAnswer | None) -> Detail:
    """What a sample is worth."""
    if answer is None:
        return Detail.NONE
    sample = answer.sample
    if sample.found < len(sample.sightings):
        return Detail.BOARD_SEEN_BY_SOME if sample.found else Detail.BOARD_SEEN_BY_NONE
    if answer.progress.enough:
        return Detail.SAMPLE_ENOUGH
    return Detail.SAMPLE_NEW if sample.useful else Detail.SAMPLE_NOT_NEW


@dataclass(frozen=True, slots=True)
class Inputs:
    """All that a step looks at. `written`: the control word was written since start. `feedback` is (seq, grasp, outcome)."""

    now_ns: int
    ctrl: Ctrl = NO_CTRL
    written: bool = False
    command: int = 0
    cmd_seq: int = 0
    heartbeat: int = 0
    feedback: tuple[int, int, int] = (0, 0, 0)
    connected: bool = True
    reconnect_ns: int = 2_000_000_000
    facts: Facts = Facts()

    @property
    def trig(self) -> bool:
        """TRIG."""
        return Ctrl.TRIG in self.ctrl

    @property
    def res_ack(self) -> bool:
        """RES_ACK."""
        return Ctrl.RES_ACK in self.ctrl

    @property
    def low(self) -> bool:
        """TRIG and RES_ACK have both fallen."""
        return not self.trig and not self.res_ack


@dataclass(frozen=True, slots=True)
class Start:
    """Latch the arguments and start a cycle; answer with `started` or `refused` before the next step."""


@dataclass(frozen=True, slots=True)
class Abort:
    """End this cycle; its failure stays published until it is acknowledged."""

    cycle_id: int


@dataclass(frozen=True, slots=True)
class Acknowledge:
    """This result was read."""

    cycle_id: int


@dataclass(frozen=True, slots=True)
class Withdraw:
    """Take back what runs or is published."""

    reason: str


@dataclass(frozen=True, slots=True)
class Forget:
    """The bin was exchanged; answer with `done` or `refused` before the next step."""


@dataclass(frozen=True, slots=True)
class Report:
    """What became of a grasp."""

    seq: int
    grasp_id: int
    outcome: int


Action: TypeAlias = Start | Abort | Acknowledge | Withdraw | Forget | Report
