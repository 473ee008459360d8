"""The control channel: who may change the camera, for how long after its last word, and what each command does."""

import struct
import threading
from collections.abc import Callable

from binpick.sim.gige import action
from binpick.sim.gige.action import Action
from binpick.sim.gige.gvcp import Code, Command, Fault, Status, acknowledge, parse, refuse, words
from binpick.sim.gige.registers import Registers

Peer = tuple[str, int]
HARMLESS = (Code.DISCOVERY, Code.READREG, Code.READMEM)
"""Carried out as often as they come."""


class Control:
    """Answers datagrams; reading is free, writing is for the one peer that took control and keeps talking.

    A datagram that comes twice, since its sender missed the acknowledge, is acknowledged again and not carried out again.
    `written(feature, arrived_ns)` is called after every successful write, `resend(block, first, last)` when the controller's
    host asks for packets again, `released()` when control ends. `act(action, arrived_ns)` gets the action commands, which may
    come from anybody once the camera is controlled: True when it is meant; it raises Fault when it cannot.
    """

    def __init__(self, registers: Registers, written: Callable[[str, int], None], resend: Callable[[int, int, int], None],
                 released: Callable[[], None], act: Callable[[Action, int], bool]) -> None:
        self._registers = registers
        self._written = written
        self._resend = resend
        self._released = released
        self._act = act
        self._controller: Peer | None = None
        self.stolen = False
        self._lock = threading.RLock()       # one camera hears on several sockets
        self._heard_ns = 0
        self._last: tuple[bytes, Peer, bytes] = (b"", ("", 0), b"")

    def answer(self, datagram: bytes, peer: Peer, arrived_ns: int) -> bytes | None:
        """The acknowledge, or None when there is nothing to say."""
        command = parse(datagram)
        if command is None:
            return None
        with self._lock:
            return self._answer(command, datagram, peer, arrived_ns)

    def _answer(self, command: Command, datagram: bytes, peer: Peer, arrived_ns: int) -> bytes | None:
        if peer == self._controller:
            self._heard_ns = arrived_ns
        if self._last[:2] == (datagram, peer):
            return self._last[2]
        reply = self._carry_out(command, peer, arrived_ns)
        if reply is not None and command.code not in HARMLESS:
            self._last = datagram, peer, reply
        return reply

    def _carry_out(self, command: Command, peer: Peer, arrived_ns: int) -> bytes | None:
        try:
            payload = self._execute(command, peer, arrived_ns)
        except Fault as fault:
            return refuse(command, fault.status)
        return acknowledge(command, payload) if payload is not None and command.wants_answer else None

    def expire(self, now_ns: int) -> None:
        """Frees the camera of a controller that has been silent for longer than the heartbeat timeout."""
        limit_ns = self._registers.integer("GevHeartbeatTimeout") * 1_000_000
        with self._lock:
            if self._controller and not self.stolen and now_ns - self._heard_ns > limit_ns:
                self._release()

    def steal(self, thief: Peer | None) -> None:
        """Another program has control from now on and never falls silent; None: it lets go."""
        with self._lock:
            self.stolen = thief is not None
            self._release()
            if thief is not None:
                self._controller = thief
                self._registers.set("GevCCP", 2)

    def _release(self) -> None:
        self._controller = None
        self._registers.set("GevCCP", 0)
        self._released()

    def _execute(self, command: Command, peer: Peer, arrived_ns: int) -> bytes | None:
        match command.code:
            case Code.DISCOVERY:
                return self._registers.discovery
            case Code.READREG:
                return b"".join(self._registers.read(address, 4) for address in words(command.payload))
            case Code.READMEM:
                address, count = _exactly(">II", command.payload)
                return command.payload[:4] + self._registers.read(address, count & 0xFFFF)
            case Code.WRITEREG | Code.WRITEMEM:
                return self._write_all(command, peer, arrived_ns)
            case Code.PACKETRESEND:
                if self._controller and self._controller[0] == peer[0]:
                    _channel, block, first, last = _exactly(">HHII", command.payload)
                    self._resend(block, first & 0xFFFFFF, last & 0xFFFFFF)
                return None
            case Code.ACTION:
                # to whom it is not meant, it is none: many hear a broadcast
                return b"" if self._controller and self._act(action.parse(command), arrived_ns) else None
        raise Fault(Status.NOT_IMPLEMENTED)

    def _write_all(self, command: Command, peer: Peer, arrived_ns: int) -> bytes:
        if command.code == Code.WRITEMEM:
            (address,) = words(command.payload[:4])
            self._write(address, command.payload[4:], peer, arrived_ns)
            return struct.pack(">HH", 0, len(command.payload) - 4)
        numbers = words(command.payload)
        if len(numbers) % 2:
            raise Fault(Status.INVALID_PARAMETER)
        for address, value in zip(numbers[::2], numbers[1::2], strict=True):
            self._write(address, struct.pack(">I", value), peer, arrived_ns)
        return struct.pack(">HH", 0, len(numbers) // 2)

    def _write(self, address: int, data: bytes, peer: Peer, arrived_ns: int) -> None:
        takes_control = address == 0xA00
        if self._controller != peer and (self._controller or not takes_control):
            raise Fault(Status.ACCESS_DENIED)
        name = self._registers.write(address, data)
        if takes_control:
            if any(data):
                self._controller, self._heard_ns = peer, arrived_ns
            else:
                self._release()
        self._written(name, arrived_ns)


def _exactly(layout: str, payload: bytes) -> tuple[int, ...]:
    if len(payload) != struct.calcsize(layout):
        raise Fault(Status.INVALID_PARAMETER)
    return struct.unpack(layout, payload)
