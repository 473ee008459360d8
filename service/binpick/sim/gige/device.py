"""One simulated camera while it has power: registers, control channel, exposures and stream, on two threads."""

import socket
import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from binpick.data import Image, Light
from binpick.sim.gige import gvcp
from binpick.sim.gige.control import Control, Peer
from binpick.sim.gige.features import LINE_SOURCES, PTP_STATES
from binpick.sim.gige.gvsp import MAX_BLOCK, Block, Sender
from binpick.sim.gige.registers import Registers

PROJECTOR_LINE = 2
"""Line2, the opto-isolated output, strobes the projector."""
LINK_BITS_PER_S = 2e9
"""Twice a GigE camera's wire: fast, and a receiver with 4 MB of socket buffer keeps up."""
SO_TIMESTAMPNS = 35
"""The socket option of asm-generic/socket.h, which Python does not name: when did the datagram arrive?"""
POLL_S = 0.1
CONTROL_BYTES = 4 << 20
"""What may wait at the control socket; the kernel clips it to net.core.rmem_max."""


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
class Shot:
    """An accepted trigger."""

    number: int
    started_ns: int
    light: Light


def device_clock_ns() -> int:
    """The clock that all simulated cameras share, as if by PTP; nanoseconds."""
    return time.clock_gettime_ns(time.CLOCK_REALTIME)


class Device:
    """Runs from `start` to `stop`; a camera that gets power again is a new Device.

    `expose(light, shot)` makes the image at the end of the exposure. `projector()` says whether the projector strobes.
    """

    def __init__(self, identity: Identity, expose: Callable[[Light, int], Image], projector: Callable[[], bool]) -> None:
        self.identity = identity
        self.frozen = False
        self.missed_triggers = 0
        self._expose = expose
        self._projector = projector
        self.registers = Registers(identity.address, identity.width, identity.height, identity.serial)
        self._socket = _control_socket(identity.address)
        self.sender = Sender(identity.address, LINK_BITS_PER_S)
        self.registers.set("GevSCSP", self.sender.port)
        self._control = Control(self.registers, self._written, self._resend, self._stop_acquisition)
        self._off = threading.Event()
        self._state = threading.Condition()
        self._acquiring = False
        self._shots = 0
        self._blocks = 0
        self._pending: Shot | None = None
        self._threads = [threading.Thread(target=target, name=f"binpick-gige-{identity.name}-{role}", daemon=True)
                         for role, target in (("control", self._serve), ("exposure", self._run_exposures))]

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
        self.sender.close()
        with self._state:
            self._state.notify_all()

    def stop(self, timeout_s: float = 1.0) -> None:
        """Power off, and waits for the threads; one that is making an image longer than that is left to end alone."""
        self.power_off()
        deadline = time.monotonic() + timeout_s
        for thread in self._threads:
            thread.join(max(0.0, deadline - time.monotonic()))

    def strobes(self) -> bool:
        """Whether this camera's output line fires the projector during exposure."""
        return self.registers.integer("LineSource", PROJECTOR_LINE) == LINE_SOURCES["ExposureActive"]

    def receive(self, datagram: bytes, peer: Peer, arrived_ns: int) -> None:
        """Answers one datagram."""
        reply = self._control.answer(datagram, peer, arrived_ns)
        if reply is not None:
            with suppress(OSError):    # the peer, or this camera, is gone
                self._socket.sendto(reply, peer)

    def _serve(self) -> None:
        requests: dict[tuple[Peer, bytes], tuple[bytes, int]] = {}       # by what they ask for: repeated, one counts once
        while not self._off.is_set():
            try:
                self._socket.settimeout(0 if requests else POLL_S)
                datagram, ancillary, _flags, peer = self._socket.recvmsg(2048, 64)
            except BlockingIOError:
                peer, _ = oldest = next(iter(requests))
                datagram, arrived_ns = requests.pop(oldest)
                self.receive(datagram, peer, arrived_ns)
                continue
            except TimeoutError:
                self._control.expire(device_clock_ns())
                continue
            except OSError:
                if self._off.is_set():
                    return
                raise
            self._control.expire(device_clock_ns())
            if gvcp.is_resend(datagram):
                requests[peer, datagram[gvcp.HEADER.size:]] = datagram, _arrival_ns(ancillary)
            elif datagram:
                self.receive(datagram, peer, _arrival_ns(ancillary))

    def _written(self, feature: str, arrived_ns: int) -> None:
        match feature:
            case "AcquisitionStart":
                self._start_acquisition()
            case "AcquisitionStop":
                self._stop_acquisition()
            case "TriggerSoftware":
                self.trigger(arrived_ns)
            case "GevTimestampControlLatch":
                self.registers.set("GevTimestampValue", device_clock_ns())
            case "PtpEnable":
                enabled = self.registers.integer("PtpEnable")
                master = PTP_STATES["Master"] if self.identity.index == 0 else PTP_STATES["Slave"]
                self.registers.set("PtpStatus", master if enabled else PTP_STATES["Disabled"])
            case "GevSCPSPacketSize" if self.registers.integer("GevSCPSFireTestPacket"):
                self.registers.set("GevSCPSFireTestPacket", 0)
                with suppress(OSError):      # too large for the interface: exactly what the test is to find out
                    self.sender.test(self._target(), self.registers.integer("GevSCPSPacketSize"))

    def _target(self) -> tuple[str, int]:
        return (socket.inet_ntoa(self.registers.integer("GevSCDA").to_bytes(4, "big")),
                self.registers.integer("GevSCPHostPort"))

    def _resend(self, block: int, first: int, last: int) -> None:
        with suppress(OSError):
            self.sender.resend(self._target(), block, first, last)

    def _start_acquisition(self) -> None:
        with self._state:
            self._acquiring, self._blocks, self._pending = True, 0, None
        self.sender.forget()

    def _stop_acquisition(self) -> None:
        with self._state:
            self._acquiring, self._pending = False, None

    def trigger(self, arrived_ns: int) -> None:
        """Starts one exposure, if it is ready for one."""
        read = self.registers.integer
        with self._state:
            ready = self._acquiring and self._pending is None and read("TriggerMode") == 1
            if not ready:
                self.missed_triggers += 1
                return
            self._shots += 1
            light = Light(exposure_us=self.registers.number("ExposureTime"), gain_db=self.registers.number("Gain"),
                          projector=self._projector())
            self._pending = Shot(self._shots, arrived_ns, light)
            self._state.notify_all()

    def _run_exposures(self) -> None:
        while not self._off.is_set():
            with self._state:
                self._state.wait_for(lambda: self._off.is_set() or self._pending is not None)
                shot = self._pending
            if shot is None:
                continue
            ends_ns = shot.started_ns + int(shot.light.exposure_us * 1000)
            self._off.wait(max(0.0, (ends_ns - device_clock_ns()) / 1e9))
            with self._state:
                if self._pending is not shot:      # acquisition ended meanwhile
                    continue
                self._pending = None
                self._blocks = self._blocks % MAX_BLOCK + 1
                block = self._blocks
            self._deliver(shot, block)

    def _deliver(self, shot: Shot, block: int) -> None:
        image = self._expose(shot.light, shot.number)
        if self.frozen or self._off.is_set() or not self._acquiring:
            return
        packets = Block(block, shot.started_ns, image, self.registers.integer("GevSCPSPacketSize"))
        try:
            self.sender.send(packets, self._target())
        except OSError:
            if not self._off.is_set():
                raise


def _control_socket(address: str) -> socket.socket:
    control = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    control.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    control.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, CONTROL_BYTES)
    try:
        control.bind((address, gvcp.PORT))
    except OSError:
        control.close()
        raise
    return control


def _arrival_ns(ancillary: list[tuple[int, int, bytes]]) -> int:
    """When the kernel got the datagram: an exposure starts then, however late this process looks."""
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == SO_TIMESTAMPNS:
            seconds, nanoseconds = struct.unpack("@qq", data)
            return int(seconds * 1_000_000_000 + nanoseconds)
    return device_clock_ns()
