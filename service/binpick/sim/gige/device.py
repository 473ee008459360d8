"""One simulated camera while it has power: registers, control channel, sensor and stream, on two threads."""

import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from binpick.data import Image, Light
from binpick.sim.gige import channel, gvcp, pixels
from binpick.sim.gige.action import SIGNALS, Action
from binpick.sim.gige.clock import host_ns
from binpick.sim.gige.conditions import Conditions
from binpick.sim.gige.control import Control, Peer
from binpick.sim.gige.gvcp import Fault, Status
from binpick.sim.gige.ledger import Ledger
from binpick.sim.gige.ptp import Ptp
from binpick.sim.gige.registers import Registers
from binpick.sim.gige.sensor import Sensor, Shot
from binpick.sim.gige.stream import Stream
from binpick.sim.gige.timer import Timer
from binpick.sim.gige.wiring import Edge, fires

PROJECTOR_LINE = 2
"""Line2, the opto-isolated output, strobes the projector."""
POLL_S = 0.1


@dataclass(frozen=True, slots=True)
class Identity:
    """What makes one camera this camera."""

    index: int
    name: str
    address: str
    serial: str
    width: int
    height: int


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What a camera has around it. `expose(head, light, shot)` makes the image at the exposure's end, `projector()` says
    whether the projector strobes, `began(head, shot)` hears of exposures, `reset(head)` of the wish to start anew."""

    expose: Callable[[int, Light, int], Image]
    projector: Callable[[], bool]
    began: Callable[[int, Shot], None]
    reset: Callable[[int], None]
    ptp: Ptp
    timer: Timer
    ledger: Ledger


class Device:
    """Runs from `start` to `stop`; a camera that gets power again is a new Device."""

    def __init__(self, identity: Identity, around: Surroundings, conditions: Conditions) -> None:
        self.identity = identity
        self._around = around
        self.registers = Registers(identity.address, identity.width, identity.height, identity.serial)
        self._socket = channel.control_socket(identity.address)
        around.ptp.power(identity.index, host_ns())
        self.conditions = Conditions()
        self.stream = Stream(identity.index, identity.address, self.registers, around.ledger, self._stamp)
        index = identity.index
        self.sensor = Sensor(self.registers, lambda light, shot: around.expose(index, light, shot), around.projector,
                             self._began, self._deliver)
        self.control = Control(self.registers, self._written, self.stream.resend, self.sensor.end, self._act)
        self.meet(conditions)
        self._off = threading.Event()
        self._resets = False
        self._threads = [threading.Thread(target=target, name=f"binpick-gige-{identity.name}-{role}", daemon=True)
                         for role, target in (("control", self._serve), ("exposure", self.sensor.run))]

    def meet(self, conditions: Conditions) -> None:
        """These hold from now on."""
        before, self.conditions = self.conditions, conditions
        self.stream.sender.mtu = conditions.mtu
        self.stream.sender.silent = not conditions.streams
        if (before.transit, before.seed) != (conditions.transit, conditions.seed):     # else chance goes on as it was
            self.stream.sender.disturb(conditions.transit, conditions.seed + self.identity.index)

    def start(self) -> None:
        """Power on."""
        for thread in self._threads:
            thread.start()

    def power_off(self) -> None:
        """Silent at once; does not wait for the threads."""
        self._off.set()
        with suppress(OSError):        # not connected, but it wakes the thread that waits
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        self.stream.sender.close()
        self.sensor.power_off()

    def stop(self, timeout_s: float = 1.0) -> None:
        """Power off, and waits for the threads; one that is making an image longer than that is left to end alone."""
        self.power_off()
        deadline = time.monotonic() + timeout_s
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(max(0.0, deadline - time.monotonic()))

    def strobes(self, line: int = PROJECTOR_LINE) -> bool:
        """Whether that output line shows the exposure."""
        return (self.registers.name("LineSource", line) == "ExposureActive"
                and self.registers.name("LineMode", line) == "Output")

    def feel(self, line: int, edge: Edge) -> None:
        """An edge arrives at one of its inputs."""
        read = self.registers
        if read.name("LineMode", line) == "Input" and read.name("TriggerSource") == f"Line{line}" and fires(
                edge, bool(read.integer("LineInverter", line)), read.name("TriggerActivation")):
            self.trigger(edge.at_ns)

    def trigger(self, at_ns: int) -> None:
        """By whatever cause."""
        if self.conditions.answers and not self._off.is_set():
            self.sensor.trigger(at_ns + int(self.conditions.skew_us * 1000))

    def receive(self, datagram: bytes, peer: Peer, arrived_ns: int) -> None:
        """Answers one datagram, unless its cable is out or it hangs."""
        if not self.conditions.reachable:
            return
        self._look_at_ptp(arrived_ns)
        reply = self.control.answer(datagram, peer, arrived_ns)
        if reply is not None:
            with suppress(OSError):    # the peer, or this camera, is gone
                self._socket.sendto(reply, peer)
        if self._resets:               # not before its acknowledge has left
            self._resets = False
            self._around.reset(self.identity.index)

    def _serve(self) -> None:
        requests: dict[tuple[Peer, bytes], tuple[bytes, int]] = {}       # by what they ask for: repeated, one counts once
        while not self._off.is_set():
            try:
                self._socket.settimeout(0 if requests else POLL_S)
                datagram, peer, arrived_ns = channel.receive(self._socket)
            except BlockingIOError:
                peer, _ = oldest = next(iter(requests))
                datagram, arrived_ns = requests.pop(oldest)
                self.receive(datagram, peer, arrived_ns)
                continue
            except TimeoutError:
                self._expire()
                continue
            except OSError:
                if self._off.is_set():
                    return
                raise
            self._expire()
            if gvcp.is_resend(datagram):
                requests[peer, datagram[gvcp.HEADER.size:]] = datagram, arrived_ns
            elif datagram:
                self.receive(datagram, peer, arrived_ns)

    def _expire(self) -> None:
        if self.conditions.answers:
            self.control.expire(host_ns())

    def _look_at_ptp(self, now_ns: int) -> None:
        """Its state is read live; the offset is latched."""
        state = self._around.ptp.state(self.identity.index, now_ns)
        self.registers.choose("PtpStatus", state)
        self.registers.choose("PtpServoStatus", {"Slave": "Locked", "Disabled": "Disabled"}.get(state, "Unknown"))

    def _written(self, feature: str, arrived_ns: int) -> None:
        read = self.registers
        match feature:
            case "AcquisitionStart":
                self.stream.sender.forget()
                self.sensor.begin()
            case "AcquisitionStop":
                self.sensor.end()
            case "TriggerSoftware" if read.name("TriggerSource") == "Software":
                self.trigger(arrived_ns)
            case "TriggerMode" | "AcquisitionFrameRate":
                self.sensor.wake()
            case "PixelFormat":
                size = pixels.size(self.identity.width, self.identity.height, read.integer("PixelFormat"))
                read.set("PayloadSize", size)
            case "DeviceReset":
                self._resets = True
            case "GevSCPSPacketSize" if read.integer("GevSCPSFireTestPacket"):
                read.set("GevSCPSFireTestPacket", 0)
                self.stream.test()
            case _:
                self._timed(feature, arrived_ns)

    def _timed(self, feature: str, arrived_ns: int) -> None:
        """As `_written`, for what has to do with clocks."""
        ptp, index, read = self._around.ptp, self.identity.index, self.registers
        match feature:
            case "GevTimestampControlLatch" | "TimestampLatch":
                for latched in ("GevTimestampValue", "TimestampLatchValue"):
                    read.set(latched, ptp.clock(index, arrived_ns).at(arrived_ns))
            case "TimestampReset":
                ptp.reset(index, arrived_ns)
            case "PtpEnable":
                ptp.enable(index, bool(read.integer("PtpEnable")), arrived_ns)
            case "PtpDataSetLatch":
                self._latch_ptp(arrived_ns)

    def _latch_ptp(self, now_ns: int) -> None:
        ptp, index = self._around.ptp, self.identity.index
        leader = ptp.leader(index, now_ns)
        self.registers.set("PtpOffsetFromMaster", ptp.offset_ns(index, now_ns))
        self.registers.set("PtpClockID", clock_id(index))
        self.registers.set("PtpGrandmasterClockID", 0 if leader is None else clock_id(leader))

    def _act(self, action: Action, arrived_ns: int) -> bool:
        """Raises Fault: without a common time nothing is scheduled; what comes late is done at once, and said."""
        read, index = self.registers, self.identity.index
        groups = [(read.integer("ActionGroupKey", n), read.integer("ActionGroupMask", n)) for n in range(SIGNALS)]
        signals = action.signals(read.integer("ActionDeviceKey"), groups)
        if not signals:
            return False
        at_ns = arrived_ns
        if action.at_ns is not None:
            if self._around.ptp.state(index, arrived_ns) not in ("Master", "Slave"):
                raise Fault(Status.NO_REF_TIME)
            at_ns = max(arrived_ns, self._around.ptp.clock(index, arrived_ns).when(action.at_ns))
        if read.name("TriggerSource") in [f"Action{signal}" for signal in signals]:
            if at_ns > arrived_ns:
                self._around.timer.call(at_ns, lambda: self.trigger(at_ns))
            else:
                self.trigger(at_ns)
        if action.at_ns is not None and at_ns == arrived_ns:
            raise Fault(Status.ACTION_LATE)
        return True

    def _began(self, shot: Shot) -> None:
        self._around.began(self.identity.index, shot)
        self.stream.began(shot, self.conditions)

    def _stamp(self, at_ns: int) -> int:
        return self._around.ptp.clock(self.identity.index, host_ns()).at(at_ns)

    def _deliver(self, shot: Shot, image: Image) -> None:
        if self._off.is_set():
            return
        try:
            self.stream.deliver(shot, image, self.conditions, self.sensor.acquiring)
        except OSError:
            if not self._off.is_set():
                raise


def clock_id(index: int) -> int:
    """A head's EUI-64."""
    return 0x0242_00FF_FE00_0000 + index
