"""The control channel without a network: datagrams in, datagrams out, time as a number."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from binpick.sim.gige.action import Action
from binpick.sim.gige.control import Control
from binpick.sim.gige.gvcp import Code, Status
from binpick.sim.gige.registers import Registers

OWNER, OTHER = ("10.0.0.1", 5000), ("10.0.0.9", 5000)
CCP, HEARTBEAT, VENDOR = 0xA00, 0x938, 0x48
KEY = 0xB1D0


class Bench:
    """A control channel and what it reported."""

    def __init__(self) -> None:
        self.registers = Registers("127.0.9.2", 640, 400, "S1")
        self.written: list[str] = []
        self.resends: list[tuple[int, int, int]] = []
        self.actions: list[Action] = []
        self.releases = 0
        self.control = Control(self.registers, lambda name, _at: self.written.append(name),
                               lambda *request: self.resends.append(request), self._released, self._act)

    def _act(self, action: Action, _arrived_ns: int) -> bool:
        self.actions.append(action)
        return action.device_key == KEY

    def _released(self) -> None:
        self.releases += 1

    def ask(self, code: int, payload: bytes, peer: tuple[str, int] = OWNER, at_ns: int = 0, flags: int = 1) -> bytes | None:
        datagram = struct.pack(">BBHHH", 0x42, flags, code, len(payload), 77) + payload
        return self.control.answer(datagram, peer, at_ns)

    def write(self, address: int, value: int, peer: tuple[str, int] = OWNER, at_ns: int = 0) -> int:
        """The status of a register write."""
        answer = self.ask(Code.WRITEREG, struct.pack(">II", address, value), peer, at_ns)
        assert answer is not None
        return int(struct.unpack_from(">H", answer)[0])


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_discovery_carries_the_bootstrap_registers(bench: Bench) -> None:
    answer = bench.ask(Code.DISCOVERY, b"")
    assert answer is not None
    assert answer[:8] == bytes.fromhex("00000003 00f8 004d")
    assert answer[8 + 0x24:8 + 0x28] == bytes([127, 0, 9, 2])
    assert answer[8 + VENDOR:].startswith(b"Allied Vision\0")
    assert answer[8 + 0xD8:].startswith(b"S1\0")


def test_several_registers_in_one_read(bench: Bench) -> None:
    answer = bench.ask(Code.READREG, struct.pack(">II", HEARTBEAT, 0x904))
    assert answer == bytes.fromhex("00000081 0008 004d") + struct.pack(">II", 3000, 1)


def test_memory_read_gives_the_description(bench: Bench) -> None:
    url = bench.ask(Code.READMEM, struct.pack(">II", 0x200, 512))
    assert url is not None
    _name, address, length = url[12:].rstrip(b"\0").decode().split(";")
    start = bench.ask(Code.READMEM, struct.pack(">II", int(address, 16), 64))
    assert start is not None
    assert start[12:].startswith(b"<?xml")
    assert int(length, 16) > 5000


def test_writing_needs_control_and_one_may_have_it(bench: Bench) -> None:
    assert bench.write(HEARTBEAT, 2000) == Status.ACCESS_DENIED
    assert bench.write(CCP, 2) == 0
    assert bench.write(HEARTBEAT, 2000) == 0
    assert bench.write(CCP, 2, OTHER) == Status.ACCESS_DENIED
    assert bench.write(HEARTBEAT, 900, OTHER) == Status.ACCESS_DENIED
    assert bench.ask(Code.READREG, struct.pack(">I", HEARTBEAT), OTHER) is not None
    assert bench.write(CCP, 0) == 0
    assert bench.releases == 1
    assert bench.write(CCP, 2, OTHER) == 0


def test_a_silent_controller_loses_control(bench: Bench) -> None:
    bench.write(CCP, 2)
    bench.control.expire(2_900_000_000)
    bench.ask(Code.READREG, struct.pack(">I", CCP), at_ns=2_900_000_000)
    bench.control.expire(5_800_000_000)
    assert bench.releases == 0
    bench.control.expire(6_000_000_000)
    assert bench.releases == 1
    assert bench.write(CCP, 2, OTHER) == 0


@pytest.mark.parametrize(("address", "value", "status"), [
    (HEARTBEAT, 1, Status.INVALID_PARAMETER),          # below its minimum
    (HEARTBEAT + 1, 3000, Status.BAD_ALIGNMENT),
    (VENDOR, 0, Status.WRITE_PROTECT),
    (0x7FFFFFF0, 0, Status.INVALID_ADDRESS),
    (0x944, 1, Status.INVALID_PARAMETER),              # not the value that executes the command
])
def test_refused_writes_change_nothing(bench: Bench, address: int, value: int, status: Status) -> None:
    bench.write(CCP, 2)
    before = bench.registers.read(HEARTBEAT, 4), bench.registers.read(VENDOR, 32)
    assert bench.write(address, value) == status
    assert (bench.registers.read(HEARTBEAT, 4), bench.registers.read(VENDOR, 32)) == before


def test_a_repeated_command_is_acknowledged_again_and_not_carried_out_again(bench: Bench) -> None:
    bench.write(CCP, 2)
    request = struct.pack(">II", HEARTBEAT, 2000)
    first = bench.ask(Code.WRITEREG, request)
    bench.ask(Code.PACKETRESEND, struct.pack(">HHII", 0, 5, 17, 20), flags=0)      # the stream's own, meanwhile
    assert bench.ask(Code.WRITEREG, request) == first
    assert bench.written == ["GevCCP", "GevHeartbeatTimeout"]


def test_resend_requests_count_for_the_controllers_host_only(bench: Bench) -> None:
    request = struct.pack(">HHII", 0, 5, 17, 20)
    assert bench.ask(Code.PACKETRESEND, request) is None
    bench.write(CCP, 2)
    assert bench.ask(Code.PACKETRESEND, request, (OWNER[0], 6001), flags=0) is None
    assert bench.ask(Code.PACKETRESEND, request, OTHER, flags=0) is None
    assert bench.resends == [(5, 17, 20)]


def test_actions_are_for_controlled_cameras_that_are_meant_and_may_come_from_anybody(bench: Bench) -> None:
    meant, other = struct.pack(">III", KEY, 1, 1), struct.pack(">III", KEY + 1, 1, 1)
    assert bench.ask(Code.ACTION, meant, OTHER) is None
    bench.write(CCP, 2)
    assert bench.ask(Code.ACTION, meant, OTHER) == bytes.fromhex("00000101 0000 004d")
    assert bench.ask(Code.ACTION, other, OTHER) is None
    assert bench.ask(Code.ACTION, meant, flags=0) is None             # nobody asked for an acknowledge
    assert bench.ask(Code.ACTION, meant + struct.pack(">Q", 5), flags=0x81) is not None
    assert bench.actions == [Action(KEY, 1, 1), Action(KEY + 1, 1, 1), Action(KEY, 1, 1), Action(KEY, 1, 1, 5)]
    short = bench.ask(Code.ACTION, meant, flags=0x81)
    assert short is not None
    assert struct.unpack_from(">H", short)[0] == Status.INVALID_PARAMETER


def test_a_stolen_camera_obeys_nobody_else_until_the_thief_lets_go(bench: Bench) -> None:
    bench.write(CCP, 2)
    bench.control.steal(("203.0.113.1", 1))
    assert bench.releases == 1
    bench.control.expire(60_000_000_000)
    assert bench.write(HEARTBEAT, 2000) == Status.ACCESS_DENIED
    assert bench.write(CCP, 2, OTHER) == Status.ACCESS_DENIED
    bench.control.steal(None)
    assert bench.write(CCP, 2) == 0


def test_an_unknown_command_is_refused_and_noise_is_not_answered(bench: Bench) -> None:
    answer = bench.ask(0x0777, b"")
    assert answer is not None
    assert struct.unpack_from(">H", answer)[0] == Status.NOT_IMPLEMENTED
    assert bench.control.answer(b"\x42\x01", OWNER, 0) is None
    assert bench.control.answer(b"\x41" + bytes(7), OWNER, 0) is None


BENCH = Bench()


@given(st.sampled_from([*Code, 0x4]), st.binary(max_size=40), st.booleans())
def test_no_datagram_breaks_it(code: int, payload: bytes, controlled: bool) -> None:
    bench = BENCH
    bench.write(CCP, 2 if controlled else 0)
    answer = bench.ask(int(code), payload, OTHER)
    assert answer is None or len(answer) >= 8
