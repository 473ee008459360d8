"""The simulator's back door: datagrams of one line of JSON, from this host, that break cameras or ask how they are."""

import json
import socket
import threading
from types import TracebackType
from typing import Any

from binpick.errors import BinpickError, InputError, PortInUse
from binpick.sim.gige import faults
from binpick.sim.gige.clock import host_ns
from binpick.sim.gige.device import POLL_S
from binpick.sim.gige.group import GigeGroup

PORT = 3957
"""Beside GigE Vision's own, at the first camera's address."""
ANSWER_S = 3.0


class Door:
    """Serves while it is entered. `{"fault": "loss=0.05@left"}` does that; every answer tells the state of all heads, or an
    `error`. Raises PortInUse."""

    def __init__(self, group: GigeGroup) -> None:
        self._group = group
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="binpick-gige-door", daemon=True)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def __enter__(self) -> "Door":
        address = self._group.identities[0].address
        try:
            self._socket.bind((address, PORT))
        except OSError as error:
            self._socket.close()
            raise PortInUse(f"{address}:{PORT} (udp) is in use: is another simulator running?") from error
        self._socket.settimeout(POLL_S)
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._stop.set()
        self._thread.join(1.0)
        self._socket.close()

    def _serve(self) -> None:
        while not self._stop.is_set():
            try:
                line, peer = self._socket.recvfrom(4096)
            except TimeoutError:
                continue
            except OSError:          # the last answer found nobody
                continue
            try:
                answer = self._answer(line)
            except BinpickError as error:
                answer = {"error": str(error)}
            self._socket.sendto(json.dumps(answer).encode(), peer)

    def _answer(self, line: bytes) -> dict[str, Any]:
        try:
            asked = json.loads(line)
            fault = asked.get("fault", "")
        except (ValueError, AttributeError):
            raise InputError("not an object in one line of JSON") from None
        if fault:
            faults.apply(self._group, faults.parse(str(fault), len(self._group.heads)))
        return {"heads": [self._state(head) for head in self._group.heads]}

    def _state(self, head: int) -> dict[str, Any]:
        group, identity = self._group, self._group.identities[head]
        images = group.truth(head)
        state: dict[str, Any] = {"name": identity.name, "address": identity.address, "powered": group.powered(head),
                                 "ptp": group.ptp.state(head, host_ns()), "images": len(images)}
        if group.powered(head):
            state |= {"missed_triggers": group.missed_triggers(head), "resent": group.resent(head)}
        if images:
            last = images[-1]
            state["last"] = {"shot": last.shot, "block": last.block, "started_ns": last.started_ns,
                             "timestamp_ns": last.timestamp_ns, "crc32": last.crc32, "sent": last.sent}
        return state


def ask(address: str, fault: str = "") -> list[dict[str, Any]]:
    """The state of the heads of the simulator there, after the fault has been done. Raises InputError."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(ANSWER_S)
        try:
            client.connect((address, PORT))
            client.send(json.dumps({"fault": fault}).encode())
            answer = json.loads(client.recv(65536))
        except (OSError, ValueError) as error:
            raise InputError(f"no simulator answers at {address}:{PORT}: start one with `binpick sim --out DIR`, or the "
                             "demo") from error
    if "error" in answer:
        raise InputError(answer["error"])
    return list(answer["heads"])
