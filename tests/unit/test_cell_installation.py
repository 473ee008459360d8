"""Which rig the cell runs on, as transitions: never under a cycle, never under somebody else's result."""

from dataclasses import replace

import numpy as np
import pytest

from binpick import calibration, settings
from binpick.calibration import Installed, SampleRequest
from binpick.cell import installation, machine
from binpick.cell.machine import State
from binpick.data import CameraStatus
from binpick.errors import Busy, Code, NotInControl, NotReady
from binpick.geometry import translation
from binpick.outcomes import Grid, Look, Memory
from binpick.result import Published, Request, Result, ReturnCode
from binpick.rig import Rig
from binpick.settings import Bin, Pose

S = 1_000_000_000
JOB = settings.resolve(settings.Cell(bins=(Bin(inner_size_m=(0.6, 0.4, 0.18), pose=Pose()),)))
WANTED = SampleRequest(board="chessboard:9x6:0.025")


def installed(rig: Rig, version: int) -> Installed:
    return Installed(rig, calibration.of_rig(rig, version, "rig.json", active=True))


@pytest.fixture
def ready(rig: Rig) -> State:
    return State(max_age_ns=10 * S, cameras=(CameraStatus("left", True), CameraStatus("right", True)), rig=installed(rig, 1))


@pytest.fixture
def other(rig: Rig) -> Installed:
    return installed(rig.model_copy(update={"T_base_rig": tuple(map(tuple, translation(1.0, 0.0, 0.0).tolist()))}), 2)


def finished(state: State) -> State:
    result = Result(cycle_id=state.last_id, request=Request(), captured_at=None, return_code=ReturnCode.of(Code.BIN_EMPTY),
                    bin=None)
    return machine.finish(state, state.last_id, Published(result, result.json_bytes(), 0))


def started(state: State) -> State:
    return machine.start(state, Request(), JOB, 0, S)


def test_a_held_cell_is_not_ready_and_says_why(ready: State, other: Installed) -> None:
    held = installation.hold(ready, "the rig is being changed to version 2", "modbus", "modbus")
    assert held.phase == "starting"
    with pytest.raises(Busy, match="being changed to version 2"):
        started(held)
    with pytest.raises(Busy, match="being changed to version 2"):
        installation.hold(held, "once more", "modbus", "modbus")
    assert installation.release(held) == ready
    changed = installation.install(held, other)
    assert (changed.phase, machine.snapshot(changed, 7, "modbus").rig) == ("ready", other.told)


def test_nothing_is_changed_under_a_cycle_also_when_it_is_only_being_cleared_away(ready: State) -> None:
    running = started(ready)
    for state in (running, machine.abort(running, 1, 0)):
        with pytest.raises(Busy, match="cycle 1 is running or being cleared away"):
            installation.hold(state, "", "modbus", "modbus")
        with pytest.raises(NotInControl, match="controlled by modbus, not by rest, and modbus runs a cycle"):
            installation.hold(state, "", "rest", "modbus")
    with pytest.raises(NotReady, match="stopping"):
        installation.hold(machine.stop(ready, 0), "", "modbus", "modbus")


@pytest.mark.parametrize("owner", ["modbus", "none"])
def test_others_wait_until_the_result_is_read(ready: State, owner: str) -> None:
    unread = finished(started(ready))
    with pytest.raises(NotInControl, match="has a result to read"):
        installation.sample(unread, Request(), JOB, 0, S, WANTED, "rest", owner)  # type: ignore[arg-type]
    read = machine.acknowledge(unread, 1)
    taken = installation.sample(read, Request(), JOB, 0, S, WANTED, "rest", owner)  # type: ignore[arg-type]
    assert taken.ticket is not None
    assert (taken.ticket.sample, taken.ticket.aside) == (WANTED, True)
    after = finished(taken)
    assert (after.valid, after.withdrawn, after.finished[-1].result.cycle_id) == (False, "acknowledged", 2)
    late = machine.tick(taken, 2 * S)
    assert (late.valid, late.finished[-1].result.return_code.code) == (False, Code.TIMEOUT)


def test_what_was_made_with_another_rig_is_withdrawn_and_not_compared_with(ready: State, other: Installed) -> None:
    cells = Grid.of(np.zeros((20, 20), dtype=np.int16))
    memory = Memory(look=Look(heights=cells, parts=cells, attempts=()))
    unread = replace(finished(started(ready)), memories={1: memory})
    same = installation.install(installation.hold(unread, "", "modbus", "modbus"), ready.installed)
    assert (same.valid, same.memories[1]) == (True, memory)
    changed = installation.install(installation.hold(unread, "", "modbus", "modbus"), other)
    assert (changed.valid, changed.withdrawn) == (False, "the rig was changed to version 2")
    assert changed.memories[1].look is None
