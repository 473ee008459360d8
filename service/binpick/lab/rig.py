"""The simulated cameras in a process of their own, so that nothing but packets lies between; a pipe tells their truth."""

import multiprocessing
import os
import socket
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any

import numpy as np

from binpick.data import Image, Light
from binpick.errors import PortInUse
from binpick.settings.cell import AravisCameras, CameraAddress
from binpick.sim.gige import GigeGroup, faults
from binpick.sim.gige.clock import host_ns
from binpick.sim.gige.gvcp import PORT
from binpick.sim.gige.ledger import Entry
from binpick.sim.gige.numbered import Numbered
from binpick.sim.gige.ptp import Oscillator

START_S = 30.0
FULL, SMALL = (1936, 1216), (640, 400)
"""Sizes of images: a real camera's, and one for what does not depend on it."""
LIGHT = Light(exposure_us=3000.0, gain_db=0.0, projector=True)


@dataclass(frozen=True, slots=True)
class Plan:
    """What is simulated. `apart`: each camera on a port of its own, where no PTP is heard; drift and offset are of the
    second camera's clock against the host's; `numbered`: pictures carry their number."""

    addresses: tuple[str, ...]
    size_px: tuple[int, int] = FULL
    apart: bool = False
    offset_s: float = 0.78
    drift_ppm: float = 40.0
    numbered: bool = False

    def cameras(self, **settings: Any) -> AravisCameras:
        """A cell's settings of the first two."""
        left, right = (CameraAddress(address=address) for address in self.addresses)
        return AravisCameras(left=left, right=right, **settings)


def free(cameras: int = 2) -> tuple[str, ...]:
    """Loopback addresses whose GigE Vision port, which is fixed, was free a moment ago. Raises PortInUse.

    Each process begins elsewhere to look, so that two at once seldom meet.
    """
    for number in (20 + (os.getpid() + further) % 230 for further in range(230)):
        addresses = tuple(f"127.0.{number}.{2 + index}" for index in range(cameras))
        with ExitStack() as probes:
            try:
                for address in addresses:
                    probes.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)).bind((address, PORT))
            except OSError:
                continue
            return addresses
    raise PortInUse(f"no loopback addresses are free for {cameras} simulated cameras (udp port {PORT}): end other simulators")


class Rig:
    """Runs while it is entered."""

    def __init__(self, plan: Plan) -> None:
        context = multiprocessing.get_context("spawn")
        self._plan = plan
        self._pipe, self._other = context.Pipe()
        self._process = context.Process(target=_serve, args=(self._other, plan), daemon=True, name="binpick-rig")

    def __enter__(self) -> "Rig":
        self._process.start()
        self._other.close()
        try:
            if self._pipe.poll(START_S) and self._pipe.recv() == "up":
                return self
        except EOFError:
            pass
        self._process.terminate()
        raise PortInUse(f"the simulated cameras at {', '.join(self._plan.addresses)} did not start: if no error is told above, "
                        f"another program took udp port {PORT} there; run it again, with nothing else running")

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        with suppress(BrokenPipeError):         # it ended before: what was asked last has failed, and says so
            self._pipe.send(("stop",))
        self._process.join(5)

    def change(self, index: int, **changes: Any) -> None:
        """Other conditions (fields of sim.gige.conditions.Conditions) for one camera."""
        self._ask("change", index, changes)

    def lose(self, fraction: float, seed: int) -> None:
        """All cameras lose that share of their packets from now on, resent ones too."""
        self._ask("lose", fraction, seed)

    def truth(self, index: int) -> dict[int, Entry]:
        """That camera's images by frame id."""
        truth: dict[int, Entry] = self._ask("truth", index)
        return truth

    def sent(self, index: int) -> dict[int, int]:
        """The checksums of that camera's images by their number since it got power."""
        sent: dict[int, int] = self._ask("sent", index)
        return sent

    def fault(self, words: str) -> None:
        """As `binpick sim --fault` has it."""
        self._ask("fault", words)

    def powered(self, index: int) -> bool:
        """Whether that camera is on."""
        powered: bool = self._ask("powered", index)
        return powered

    def _ask(self, *what: Any) -> Any:
        self._pipe.send(what)
        return self._pipe.recv()


def _serve(pipe: Connection, plan: Plan) -> None:
    width, height = plan.size_px
    scenes = [_scene(index, width, height) for index in range(len(plan.addresses))]
    pictures = Numbered(len(plan.addresses), plan.size_px) if plan.numbered else None

    def image(index: int, _light: Light, shot: int) -> Image:
        return scenes[index] + np.uint8(shot & 0xFF)

    with GigeGroup(pictures or image, plan.addresses, plan.size_px, apart=plan.apart) as group:
        for index in range(1, len(plan.addresses)):
            group.ptp.tune(index, Oscillator(int(plan.offset_s * 1e9), int(plan.drift_ppm * 1000)), host_ns())
        pipe.send("up")
        while (what := pipe.recv())[0] != "stop":
            pipe.send(_answer(group, *what))


def _answer(group: GigeGroup, verb: str, *arguments: Any) -> dict[int, Entry] | dict[int, int] | bool | None:
    match verb:
        case "change":
            index, changes = arguments
            group.change(index, **changes)
        case "lose":
            group.drop_packets(*arguments)
        case "fault":
            faults.apply(group, faults.parse(*arguments))
        case "powered":
            return group.powered(*arguments)
        case "truth":
            return {entry.block: entry for entry in group.truth(*arguments) if entry.sent}
        case "sent":
            return {entry.shot: entry.crc32 for entry in group.truth(*arguments) if entry.sent}
    return None


def _scene(index: int, width: int, height: int) -> Image:
    """A picture without repetition from packet to packet."""
    ramp = np.arange(width * height, dtype=np.uint32).reshape(height, width)
    return ((ramp * np.uint32(2654435761) >> np.uint32(24)) + np.uint32(index * 101)).astype(np.uint8)
