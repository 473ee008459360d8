"""The simulated cameras as one rig: wires, clocks, projector and discovery, and the faults that tests and demos ask for."""

import errno
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from types import TracebackType
from typing import TypeAlias

from binpick.camera.base import NAMES
from binpick.data import Image, Light
from binpick.errors import PortInUse
from binpick.sim.gige import channel, gvcp
from binpick.sim.gige.clock import host_ns
from binpick.sim.gige.conditions import Conditions
from binpick.sim.gige.control import Peer
from binpick.sim.gige.device import POLL_S, Device, Identity, Surroundings
from binpick.sim.gige.features import SIZE_PX
from binpick.sim.gige.ledger import Entry, Ledger
from binpick.sim.gige.pixels import Bytes
from binpick.sim.gige.ptp import OSCILLATORS, SETTLE_S, Ptp
from binpick.sim.gige.sensor import Shot
from binpick.sim.gige.timer import Timer
from binpick.sim.gige.wiring import Edge, Wire, harness, pulse

ImageFn: TypeAlias = Callable[[int, Light, int], Image]
"""(camera index, light, shot number) -> the image; called at the exposure's end on that camera's thread."""
THIEF: Peer = ("203.0.113.1", 1)
"""Nobody: an address that is reserved for documentation (RFC 5737)."""
REBOOT_S = 1.0
NOW_NS = 500_000
"""An edge this close need not wait for the timer: what counts is its own time."""


class GigeGroup:
    """Two to five cameras; the first one's output line fires the projector for all, and triggers the others by wire.

    `apart`: each head on a port of its own that hears no other, so that PTP makes every one a master. `settle_s` is what PTP
    takes. `start` raises PortInUse when another program has an address's port 3956.
    """

    def __init__(self, image: ImageFn, addresses: Sequence[str], size_px: tuple[int, int] = SIZE_PX,
                 serials: Sequence[str] = (), settle_s: float = SETTLE_S, apart: bool = False) -> None:
        width, height = size_px
        heads = len(addresses)
        if not 2 <= heads <= len(NAMES):
            raise ValueError(f"2 to {len(NAMES)} cameras, not {heads}")
        serials = serials or [f"SIM-{name.upper()}" for name in NAMES]
        self.identities = tuple(Identity(index, NAMES[index], address, serials[index], width, height)
                                for index, address in enumerate(addresses))
        self.ptp = Ptp(OSCILLATORS[:heads], settle_s, apart)
        self._wires = harness(heads)
        self._timer = Timer()
        self._ledger = Ledger(heads)
        self._around = Surroundings(expose=image, projector=self._projector, began=self._carry, reset=self.reboot, ptp=self.ptp,
                                    timer=self._timer, ledger=self._ledger)
        self._devices: dict[int, Device] = {}
        self._conditions = [Conditions()] * heads
        self._lock = threading.RLock()
        self._stop = threading.Event()
        self._listeners: list[threading.Thread] = []

    def __enter__(self) -> "GigeGroup":
        self.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.stop()

    @property
    def heads(self) -> range:
        """Their indices."""
        return range(len(self.identities))

    def start(self) -> None:
        """Power on all, and answer broadcasts for all."""
        self._stop.clear()
        self._timer.start()
        try:
            for index in self.heads:
                self.restart(index)
        except PortInUse:
            self.stop()
            raise
        for address in channel.BROADCASTS:
            listener = threading.Thread(target=self._answer_broadcasts, args=(address,), daemon=True,
                                        name=f"binpick-gige-{address}")
            self._listeners.append(listener)
            listener.start()

    def stop(self) -> None:
        """Power off; at most 1 s."""
        self._stop.set()
        self._timer.stop()
        for index in self.heads:
            self.kill(index)
        for listener in self._listeners:
            listener.join(2 * POLL_S)
        self._listeners.clear()

    def kill(self, index: int) -> None:
        """Camera `index` loses power: silent from this moment, mid-packet if need be."""
        with self._lock:
            device = self._devices.pop(index, None)
            self.ptp.enable(index, False, host_ns())
        if device is not None:
            device.stop(0.4)

    def restart(self, index: int) -> None:
        """It gets power again, everything at its defaults; its cable and network stay as they are. Raises PortInUse."""
        self.kill(index)
        identity = self.identities[index]
        with self._lock:
            self._meet(index, self._conditions[index].rebooted())
            try:
                device = self._devices[index] = Device(identity, self._around, self._conditions[index])
            except OSError as error:
                if error.errno != errno.EADDRINUSE:
                    raise
                raise PortInUse(
                    f"{identity.address}:{gvcp.PORT} (udp) is in use: is another simulator running?") from error
        device.start()

    def reboot(self, index: int, after_s: float = REBOOT_S) -> None:
        """It goes dark at once and comes back after that time, at its defaults."""
        self._timer.call(host_ns(), lambda: self.kill(index))
        self._timer.call(host_ns() + int(after_s * 1e9), lambda: self._revive(index))

    def misfire(self, index: int) -> None:
        """It exposes once without having been asked."""
        self._devices[index].trigger(host_ns())

    def steal(self, index: int, on: bool = True) -> None:
        """Another program takes control of it, as it may after a missed heartbeat, and keeps it until it is told to let go."""
        self._devices[index].control.steal(THIEF if on else None)

    def stolen(self, index: int) -> bool:
        """Whether another program has it that way."""
        return self._devices[index].control.stolen

    def drop_packets(self, fraction: float, seed: int, resends: bool = True) -> None:
        """All lose that share of their stream packets from now on, resent ones included, or send none again; 0 ends it."""
        for index in self.heads:
            transit = replace(self._conditions[index].transit, loss=fraction, resends=resends)
            self.change(index, transit=transit, seed=seed)

    def change(self, index: int, **changes: object) -> None:
        """Other conditions (fields of Conditions) for one head, from now on."""
        with self._lock:
            self._meet(index, replace(self._conditions[index], **changes))      # type: ignore[arg-type]

    def _meet(self, index: int, conditions: Conditions) -> None:
        self._conditions[index] = conditions
        self.ptp.cut(index, not conditions.reachable, host_ns())
        if index in self._devices:
            self._devices[index].meet(conditions)

    def conditions(self, index: int) -> Conditions:
        """What besets it now."""
        return self._conditions[index]

    def powered(self, index: int) -> bool:
        """Whether it is on."""
        return index in self._devices

    def truth(self, index: int) -> tuple[Entry, ...]:
        """All images of that head, oldest first: when each was really exposed, and what was sent."""
        return self._ledger.truth(index)

    def sent(self, index: int, block: int) -> Bytes:
        """The payload of the head's last image with that block number, of the last few. Raises KeyError."""
        return self._ledger.image(index, block)

    def resent(self, index: int) -> int:
        """Packets it was asked for again since power-up."""
        return self._devices[index].stream.sender.resent

    def missed_triggers(self, index: int) -> int:
        """Triggers since power-up that came when it could not take them."""
        return self._devices[index].sensor.missed

    def _projector(self) -> bool:
        first = self._devices.get(0)
        return first is not None and first.strobes()

    def _carry(self, source: int, shot: Shot) -> None:
        """An exposure's pulse goes along the wires of lines that show it."""
        device = self._devices.get(source)
        for wire in self._wires:
            if device is not None and wire.source == source and device.strobes(wire.output):
                inverted = bool(device.registers.integer("LineInverter", wire.output))
                for edge in pulse(shot.started_ns, shot.light.exposure_us, inverted):
                    self._arrive(wire, wire.carry(edge))

    def _arrive(self, wire: Wire, edge: Edge) -> None:
        def feel() -> None:
            target = self._devices.get(wire.target)
            if target is not None and self._conditions[wire.target].wired:
                target.feel(wire.input, edge)

        if edge.at_ns - host_ns() < NOW_NS:
            feel()
        else:
            self._timer.call(edge.at_ns, feel)

    def _revive(self, index: int) -> None:
        if not self._stop.is_set():
            self.restart(index)

    def _answer_broadcasts(self, address: str) -> None:
        with channel.control_socket(address) as broadcast:
            broadcast.settimeout(POLL_S)
            while not self._stop.is_set():
                try:
                    datagram, peer, arrived_ns = channel.receive(broadcast)
                except TimeoutError:
                    continue
                command = gvcp.parse(datagram)
                if command is not None and command.code in (gvcp.Code.DISCOVERY, gvcp.Code.ACTION):
                    for device in list(self._devices.values()):
                        device.receive(datagram, peer, arrived_ns)
