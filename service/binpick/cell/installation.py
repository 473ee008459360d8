"""Which rig the cell runs on, and who may change it or look at a board: transitions of its state, like the machine's own."""

from dataclasses import replace
from types import MappingProxyType

from binpick.calibration import Installed, SampleRequest
from binpick.cell import machine
from binpick.cell.machine import State
from binpick.errors import Busy, NotInControl, NotReady
from binpick.result import Owner, Request, Source
from binpick.settings import Job


def admit(state: State, source: Source, owner: Owner) -> None:
    """Whoever does not control the cell may act only while the one who does waits for nothing. Raises NotInControl."""
    if source == owner or not (state.valid or state.ticket is not None):
        return
    why = "runs a cycle" if state.ticket is not None else "has a result to read"
    raise NotInControl(f"this cell is controlled by {owner}, not by {source}, and {owner} {why}: try again when the cell is "
                       "idle")


def sample(state: State, request: Request, job: Job, now_ns: int, timeout_ns: int, wanted: SampleRequest, source: Source,
           owner: Owner) -> State:
    """Starts a look at a board. Raises NotInControl, and like `machine.start`."""
    admit(state, source, owner)
    return machine.start(state, request, job, now_ns, timeout_ns, sample=wanted, aside=source != owner)


def hold(state: State, why: str, source: Source, owner: Owner) -> State:
    """No cycle starts from here on, until `install` or `release`. Raises NotInControl, NotReady, Busy."""
    admit(state, source, owner)
    if state.stopping:
        raise NotReady("the cell is stopping")
    if state.ticket is not None or state.held:
        busy = state.held or f"cycle {state.ticket.cycle_id if state.ticket else 0} is running or being cleared away"
        raise Busy(f"{busy}: the rig is changed between cycles only; try again when the cell is ready")
    return replace(state, held=why)


def install(state: State, rig: Installed) -> State:
    """The next cycle runs on this rig. What is published was made with another one and is withdrawn; the pick memory keeps
    what failed, but not what was seen last, which it would compare with."""
    if state.rig is None or state.rig.rig.sha256 != rig.rig.sha256:
        state = machine.invalidate(state, f"the rig was changed to version {rig.told.version}")
        memories = {number: memory.model_copy(update={"look": None}) for number, memory in state.memories.items()}
        state = replace(state, memories=MappingProxyType(memories))
    return replace(state, rig=rig, held="")


def release(state: State) -> State:
    """Nothing has changed after all; cycles may start again."""
    return replace(state, held="")
