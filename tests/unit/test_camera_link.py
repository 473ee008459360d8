"""A camera's answers, and its silence, to a socket of our own; for an idle one's, time passes as the test says."""

import select
import socket
import struct
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest

from binpick.camera import probe
from binpick.camera.gvcp import PORT
from binpick.camera.link import PERIOD_NS, Link

FREE, HELD = bytes(4), bytes((0, 0, 0, 2))
DENIED, NO_REGISTER = 0x8006, 0x8003


class Camera:
    """Answers when it is told to."""

    def __init__(self, address: str) -> None:
        self.address, self.now = address, 10**12
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((address, PORT))
        self.socket.settimeout(2)
        self.link = Link(address, lambda: self.now)

    def asked(self) -> tuple[int, tuple[str, int]]:
        """Request id and sender of the next question."""
        question, peer = self.socket.recvfrom(100)
        assert (question[:6], question[8:]) == (bytes.fromhex("420100800004"), bytes.fromhex("00000a00"))
        return int.from_bytes(question[6:8], "big"), peer

    def answer(self, payload: bytes, status: int = 0) -> None:
        number, peer = self.asked()
        self.socket.sendto(struct.pack(">HHHH", status, 0x81, len(payload), number) + payload, peer)
        select.select([self.link._socket], [], [], 2)

    def later(self, periods: int = 1) -> str:
        self.now += periods * PERIOD_NS
        return self.link.feel()


@pytest.fixture
def camera(gige_addresses: tuple[str, str]) -> Iterator[Camera]:
    camera = Camera(gige_addresses[0])
    yield camera
    camera.link.close()
    camera.socket.close()


def test_an_answer_tells_whether_it_is_controlled(camera: Camera) -> None:
    assert camera.link.feel() == "unknown"
    for payload, status, state in ((HELD, 0, "held"), (FREE, 0, "free"), (b"", DENIED, "held")):
        camera.answer(payload, status)
        assert camera.later() == state


def test_it_is_asked_no_more_often_than_needed(camera: Camera) -> None:
    for _ in range(5):
        camera.link.feel()
    camera.asked()
    camera.socket.settimeout(0.02)
    with pytest.raises(TimeoutError):
        camera.asked()


def test_three_questions_without_an_answer_are_silence(camera: Camera) -> None:
    assert camera.link.feel() == "unknown"
    camera.answer(HELD)
    assert [camera.later() for _ in range(5)] == ["held", "held", "held", "silent", "silent"]
    for _ in range(4):
        camera.asked()
    camera.answer(HELD)
    assert camera.later() == "held"


def test_a_long_cycle_between_two_looks_is_no_silence(camera: Camera) -> None:
    camera.link.feel()
    camera.answer(HELD)
    camera.later()
    assert camera.later(100) == "held"         # though the question before it got lost


def test_what_was_asked_before_it_was_opened_counts_no_more(camera: Camera) -> None:
    camera.link.feel()
    camera.answer(FREE)
    camera.link.close()
    camera.link = Link(camera.address, lambda: camera.now)        # as opening does
    assert camera.later() == "unknown"
    camera.answer(HELD)
    assert camera.later() == "held"


def test_nobody_there(gige_addresses: tuple[str, str]) -> None:
    now = [10**12]
    link = Link(gige_addresses[1], lambda: now[0])
    states = []
    for _ in range(5):
        states.append(link.feel())
        now[0] += PERIOD_NS
    assert states[-1] == "silent"
    link.close()


@pytest.mark.parametrize(("replies", "held_by"), [
    ([(0, FREE)], ""), ([(0, HELD), (0, bytes((10, 0, 0, 5)))], "10.0.0.5"), ([(0, HELD), (NO_REGISTER, b"")],
    "another program"), ([(DENIED, b""), (DENIED, b"")], "another program")])
def test_who_controls_it_is_asked_without_opening_it(camera: Camera, replies: list[tuple[int, bytes]], held_by: str) -> None:
    def answer() -> None:
        for status, payload in replies:
            question, peer = camera.socket.recvfrom(100)
            camera.socket.sendto(struct.pack(">HHH", status, 0x81, len(payload)) + question[6:8] + payload, peer)

    with ThreadPoolExecutor(1) as pool:
        answered = pool.submit(answer)
        assert probe.controller(camera.address) == held_by
        answered.result()


def test_where_nobody_is_nobody_answers(gige_addresses: tuple[str, str]) -> None:
    assert not probe.answers(gige_addresses[1])
    assert probe.controller(gige_addresses[1]) is None
