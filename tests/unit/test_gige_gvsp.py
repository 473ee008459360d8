"""Images as packets: nothing lost, nothing twice, and resends only of what was sent."""

import socket
import struct
from collections.abc import Iterator

import numpy as np
import pytest

from binpick.sim.gige import pixels
from binpick.sim.gige.gvsp import KEPT_BLOCKS, Block, Sender
from binpick.sim.gige.pixels import Payload
from binpick.sim.gige.transit import Transit


@pytest.fixture
def receiver() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(0.05)
        yield receiver


@pytest.fixture
def sender() -> Iterator[Sender]:
    sender = Sender("127.0.0.1", 1e9)
    yield sender
    sender.close()


def received(receiver: socket.socket) -> dict[int, bytes]:
    """Packets by number until there is silence."""
    packets = {}
    try:
        while True:
            packet = receiver.recv(20000)
            packets[int.from_bytes(packet[5:8], "big")] = packet
    except TimeoutError:
        return packets


def image_of(height: int, width: int) -> Payload:
    return pixels.pack(np.random.default_rng(3).integers(0, 256, (height, width), np.uint8), pixels.FORMATS["Mono8"])


def body(packets: dict[int, bytes], block: Block) -> bytes:
    return b"".join(packets[index][8:] for index in range(1, block.count - 1))


@pytest.mark.parametrize("shape", [(60, 80), (61, 91), (1, 7), (8, 1464 // 8)])
def test_payload_is_the_image(shape: tuple[int, int]) -> None:
    image = image_of(*shape)
    block = Block(9, (5 << 32) + 6, image, 540 + 36)
    packets = {index: block.packet(index) for index in range(block.count)}
    assert body(packets, block) == image.data.tobytes()
    assert [packet[4] for packet in packets.values()] == [1, *[3] * (block.count - 2), 2]
    assert all(struct.unpack_from(">HH", packet) == (0, 9) for packet in packets.values())
    assert all(len(packet) <= 540 + 8 for packet in packets.values())
    assert struct.unpack(">HHIIIII", packets[0][8:32]) == (0, 1, 5, 6, 0x01080001, shape[1], shape[0])


def test_what_is_sent_is_the_block(sender: Sender, receiver: socket.socket) -> None:
    block = Block(1, 0, image_of(120, 160), 1500)
    sender.send(block, receiver.getsockname())
    packets = received(receiver)
    assert packets == {index: block.packet(index) for index in range(block.count)}


def test_lost_packets_come_when_asked_for(sender: Sender, receiver: socket.socket) -> None:
    block = Block(1, 0, image_of(120, 160), 600)
    sender.disturb(Transit(loss=0.3), seed=4)
    sender.send(block, receiver.getsockname())
    packets = received(receiver)
    assert 0 < len(packets) < block.count
    sender.disturb(Transit(), seed=0)
    for index in set(range(block.count)) - set(packets):
        sender.resend(receiver.getsockname(), 1, index, index)
    packets |= received(receiver)
    assert body(packets, block) == block.rows[:, 8:].tobytes() + b"".join(part[8:] for part in block.tail[:-1])


def test_no_resend_of_what_was_never_sent_or_is_forgotten(sender: Sender, receiver: socket.socket) -> None:
    target = receiver.getsockname()
    for number in range(1, KEPT_BLOCKS + 2):
        sender.send(Block(number, 0, image_of(4, 4), 600), target)
    received(receiver)
    sender.resend(target, 1, 0, 9)                  # pushed out by newer ones
    sender.resend(target, 99, 0, 9)                 # never was
    sender.resend(target, KEPT_BLOCKS, 0, 0xFFFFFF)
    assert len(received(receiver)) == 3
    assert sender.resent == 3
    sender.forget()
    sender.resend(target, KEPT_BLOCKS, 0, 9)
    assert not received(receiver)
