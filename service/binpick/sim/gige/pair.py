"""The two simulated cameras as one rig: one clock, one projector, discovery, and the faults that tests and demos ask for."""

import errno
import socket
import threading
from collections.abc import Callable
from types import TracebackType
from typing import TypeAlias

from binpick.data import Image, Light
from binpick.errors import PortInUse
from binpick.sim.gige import gvcp
from binpick.sim.gige.device import POLL_S, Device, Identity, device_clock_ns

ImageFn: TypeAlias = Callable[[int, Light, int], Image]
"""(camera index, light, shot number) -> the image; called at the exposure's end on that camera's thread."""
NAMES = ("left", "right")


class GigePair:
    """Cameras 0 (left, whose output line fires the projector for both) and 1 (right).

    `start` raises PortInUse when another program has an address's port 3956.
    """

    def __init__(self, image: ImageFn, addresses: tuple[str, str] = ("127.0.0.2", "127.0.0.3"),
                 size_px: tuple[int, int] = (1936, 1216), serials: tuple[str, str] = ("SIM-LEFT", "SIM-RIGHT")) -> None:
        self._image = image
        width, height = size_px
        self.identities = tuple(Identity(i, NAMES[i], addresses[i], serials[i], width, height) for i in (0, 1))
        self._devices: dict[int, Device] = {}
        self._loss = (0.0, 0, True)
        self._stop = threading.Event()
        self._discovery: threading.Thread | None = None

    def __enter__(self) -> "GigePair":
        self.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.stop()

    def start(self) -> None:
        """Power on both, and answer broadcasts for both."""
        self._stop.clear()
        try:
            for index in (0, 1):
                self.restart(index)
        except PortInUse:
            self.stop()
            raise
        self._discovery = threading.Thread(target=self._answer_broadcasts, name="binpick-gige-discovery", daemon=True)
        self._discovery.start()

    def stop(self) -> None:
        """Power off; at most 1 s."""
        self._stop.set()
        for index in (0, 1):
            self.kill(index)
        if self._discovery is not None:
            self._discovery.join(2 * POLL_S)
            self._discovery = None

    def kill(self, index: int) -> None:
        """Camera `index` loses power: silent from this moment, mid-packet if need be."""
        device = self._devices.pop(index, None)
        if device is not None:
            device.stop(0.4)

    def restart(self, index: int) -> None:
        """It gets power again, everything at its defaults. Raises PortInUse."""
        self.kill(index)
        identity = self.identities[index]
        try:
            device = Device(identity, lambda light, shot: self._image(index, light, shot), self._projector)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            raise PortInUse(f"{identity.address}:{gvcp.PORT} (udp) is in use: is another simulator running?") from error
        device.sender.drop(*self._loss)
        self._devices[index] = device
        device.start()

    def freeze(self, index: int) -> None:
        """It still answers, but its images stay away until it is restarted."""
        self._devices[index].frozen = True

    def misfire(self, index: int) -> None:
        """It exposes once without having been asked."""
        self._devices[index].trigger(device_clock_ns())

    def drop_packets(self, fraction: float, seed: int, resends: bool = True) -> None:
        """Both lose that share of their stream packets from now on, resent ones included, or send none again; 0 ends it."""
        self._loss = (fraction, seed, resends)
        for index, device in self._devices.items():
            device.sender.drop(fraction, seed + index, resends)

    def resent(self, index: int) -> int:
        """Packets it was asked for again since power-up."""
        return self._devices[index].sender.resent

    def missed_triggers(self, index: int) -> int:
        """Triggers since power-up that came when it could not take them."""
        return self._devices[index].missed_triggers

    def _projector(self) -> bool:
        left = self._devices.get(0)
        return left is not None and left.strobes()

    def _answer_broadcasts(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as broadcast:
            broadcast.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            broadcast.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            broadcast.settimeout(POLL_S)
            broadcast.bind(("255.255.255.255", gvcp.PORT))
            while not self._stop.is_set():
                try:
                    datagram, peer = broadcast.recvfrom(2048)
                except TimeoutError:
                    continue
                command = gvcp.parse(datagram)
                if command is not None and command.code == gvcp.Code.DISCOVERY:
                    for device in list(self._devices.values()):
                        device.receive(datagram, peer, device_clock_ns())
