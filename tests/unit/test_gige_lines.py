"""Wires and edges, and who is meant by an action command."""

import struct

import pytest

from binpick.sim.gige import action
from binpick.sim.gige.action import Action
from binpick.sim.gige.gvcp import Code, Command, Fault
from binpick.sim.gige.wiring import DELAY_NS, JITTER_NS, Edge, Wire, fires, harness, pulse


def test_a_pulse_is_as_long_as_the_exposure() -> None:
    assert pulse(1000, 2.5, inverted=False) == (Edge(1000, True), Edge(3500, False))
    assert pulse(1000, 2.5, inverted=True) == (Edge(1000, False), Edge(3500, True))


def test_a_wire_delays_by_a_fixed_time_and_a_little_jitter() -> None:
    wire = Wire(0, 1, 1, 0)
    delays = [wire.carry(Edge(at * 77_777, True)).at_ns - at * 77_777 for at in range(500)]
    assert all(abs(delay - DELAY_NS) <= JITTER_NS for delay in delays)
    assert len(set(delays)) > 100
    assert wire.carry(Edge(5, False)) == wire.carry(Edge(5, False))
    assert Wire(0, 1, 1, 0, delay_ns=7, jitter_ns=0).carry(Edge(5, False)) == Edge(12, False)


def test_the_harness_reaches_every_other_head() -> None:
    assert {(wire.source, wire.target) for wire in harness(4)} == {(0, 1), (0, 2), (0, 3)}
    assert {(wire.output, wire.input) for wire in harness(2)} == {(1, 0), (2, 3)}


@pytest.mark.parametrize(("rising", "inverted", "activation", "taken"), [
    (True, False, "RisingEdge", True), (False, False, "RisingEdge", False), (True, True, "RisingEdge", False),
    (False, True, "RisingEdge", True), (False, False, "FallingEdge", True), (True, False, "AnyEdge", True),
    (False, False, "AnyEdge", True)])
def test_which_edge_is_a_trigger(rising: bool, inverted: bool, activation: str, taken: bool) -> None:
    assert fires(Edge(0, rising), inverted, activation) is taken


@pytest.mark.parametrize(("device_key", "group_key", "mask", "signals"), [
    (9, 5, 1, (0,)), (9, 5, 3, (0,)), (9, 6, 2, (1,)), (9, 6, 1, ()), (9, 5, 4, ()), (8, 5, 1, ()), (9, 7, 1, ())])
def test_an_action_means_the_groups_whose_key_and_mask_it_fits(device_key: int, group_key: int, mask: int,
                                                               signals: tuple[int, ...]) -> None:
    assert Action(device_key, group_key, mask).signals(9, [(5, 1), (6, 2)]) == signals


def test_actions_are_read_with_or_without_a_time() -> None:
    keys = struct.pack(">III", 1, 2, 3)
    assert action.parse(Command(Code.ACTION, 0x01, 1, keys)) == Action(1, 2, 3)
    assert action.parse(Command(Code.ACTION, 0x81, 1, keys + bytes(7) + b"\x09")) == Action(1, 2, 3, 9)
    for flags, payload in ((0x81, keys), (0x01, keys + bytes(8)), (0x01, b"")):
        with pytest.raises(Fault, match="INVALID_PARAMETER"):
            action.parse(Command(Code.ACTION, flags, 1, payload))
