"""What the cell remembers of each of its bins: transitions of its state, like the machine's own."""

from dataclasses import replace
from types import MappingProxyType

from binpick.cell import machine
from binpick.cell.machine import ACKNOWLEDGED, TRIGGERED_AGAIN, State
from binpick.errors import Busy
from binpick.grasp import memory as laws
from binpick.outcomes import NO_MEMORY, Memory

READ = (ACKNOWLEDGED, TRIGGERED_AGAIN)
"""The ends of a result that its controller has read: the robot may have acted on it."""


def report(state: State, cycle_id: int, grasp: int, outcome: int) -> State:
    """`machine.report`, and the bin remembers it, unless it was exchanged since."""
    reported = machine.report(state, cycle_id, grasp, outcome)
    kept = machine.find(reported, cycle_id)
    if reported is state or kept is None or kept.result.bin is None:
        return reported
    number = kept.result.bin.number
    attempt = next((attempt for attempt in kept.attempts if attempt.grasp == grasp), None)
    if attempt is None or cycle_id <= state.exchanged.get(number, 0):
        return reported
    return _kept(reported, number, laws.told(reported.memories.get(number, NO_MEMORY), attempt, outcome))


def recall(state: State, bin_number: int) -> Memory:
    """The memory that a cycle starts from.

    What was seen last is in it only if the robot may have acted since: the controller has read the result that came of it, and
    that was the last one.
    """
    memory, last = state.memories.get(bin_number, NO_MEMORY), state.published
    if memory.look is None:
        return memory
    acted = last is not None and not state.valid and state.withdrawn in READ
    if acted and last is not None and last.result.cycle_id == memory.look.attempts[0].cycle_id:
        return memory
    return Memory(attempts=memory.attempts)


def remember(state: State, cycle_id: int, bin_number: int, before: Memory, after: Memory) -> State:
    """A cycle that started from `before` left `after`; what was told of the bin meanwhile holds as well."""
    if cycle_id <= state.exchanged.get(bin_number, 0):
        return state
    return _kept(state, bin_number, laws.merged(before, after, state.memories.get(bin_number, NO_MEMORY)))


def forget(state: State, bin_number: int) -> State:
    """The bin was exchanged: nothing is known of the new one. What is published is withdrawn, as by any new command.

    Raises Busy while a cycle runs: nobody could say which of the two it saw.
    """
    if state.ticket is not None:
        raise Busy(f"cycle {state.ticket.cycle_id} is running: say that the bin was exchanged when it has ended")
    state = machine.invalidate(state, f"bin {bin_number} was exchanged")
    exchanged = MappingProxyType({**state.exchanged, bin_number: state.last_id})
    return _kept(replace(state, exchanged=exchanged), bin_number, NO_MEMORY)


def _kept(state: State, bin_number: int, memory: Memory) -> State:
    if state.memories.get(bin_number, NO_MEMORY) == memory:
        return state
    return replace(state, memories=MappingProxyType({**state.memories, bin_number: memory}))
