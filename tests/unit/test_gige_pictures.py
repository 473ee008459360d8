"""What a picture becomes on its way: packed pixels, packets in another order, a number that can be read again."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from binpick.data import Light
from binpick.sim.gige import auto, numbered, pixels
from binpick.sim.gige.conditions import Conditions
from binpick.sim.gige.ledger import Ledger
from binpick.sim.gige.numbered import Numbered
from binpick.sim.gige.registers import Registers
from binpick.sim.gige.sensor import Shot
from binpick.sim.gige.stream import Stream
from binpick.sim.gige.transit import REACH, Transit

LIGHT = Light(1000.0, 0.0, False)
IMAGE = np.arange(256, dtype=np.uint8).reshape(16, 16)


def unpacked(payload: pixels.Payload, name: str) -> list[int]:
    """The pixels as numbers, read off bit by bit from the format's definition."""
    data = payload.data.tobytes()
    if name in ("Mono10", "Mono12"):
        return [data[i] | data[i + 1] << 8 for i in range(0, len(data), 2)]
    if name == "Mono12Packed":
        return [value for i in range(0, len(data), 3)
                for value in (data[i] << 4 | data[i + 1] & 15, data[i + 2] << 4 | data[i + 1] >> 4)]
    width = int(name[4:6])
    stream = int.from_bytes(data, "little")
    return [stream >> width * i & (1 << width) - 1 for i in range(len(data) * 8 // width)]


@pytest.mark.parametrize("name", [name for name in pixels.FORMATS if name.startswith("Mono1")])
def test_packing_keeps_every_grey(name: str) -> None:
    payload = pixels.pack(IMAGE, pixels.FORMATS[name])
    depth = int(name[4:6])
    assert payload.data.size == pixels.size(16, 16, payload.format)
    values = unpacked(payload, name)
    assert [value >> depth - 8 for value in values] == list(range(256))
    assert (values[0], values[-1]) == (0, (1 << depth) - 1)


@pytest.mark.parametrize("name", list(pixels.FORMATS))
def test_an_odd_number_of_pixels_is_as_long_as_the_payload_says(name: str) -> None:
    number = pixels.FORMATS[name]
    assert pixels.pack(IMAGE[:3, :5], number).data.size == pixels.size(5, 3, number)


def test_an_unharmed_way() -> None:
    order, late = Transit().plan(1000, np.random.default_rng(1))
    assert np.array_equal(order, np.arange(1000))
    assert late.size == 0


@given(st.floats(0, 0.6), st.floats(0, 0.6), st.floats(0, 0.6), st.floats(0, 0.6), st.integers(0, 99))
def test_what_the_way_does_to_packets(loss: float, duplicate: float, reorder: float, delayed: float, seed: int) -> None:
    transit = Transit(loss, duplicate, reorder, delayed)
    order, late = transit.plan(300, np.random.default_rng(seed))
    again, _ = transit.plan(300, np.random.default_rng(seed))
    assert np.array_equal(order, again)
    assert not set(order) & set(late)
    first = list(dict.fromkeys(order.tolist()))
    assert all(first.index(packet) - len([p for p in first if p < packet]) <= REACH for packet in first)
    if not loss:
        assert sorted({*order, *late}) == list(range(300))


def test_shares_are_what_is_asked_for() -> None:
    order, late = Transit(loss=0.1, duplicate=0.2, late=0.05).plan(20_000, np.random.default_rng(2))
    assert len(late) == pytest.approx(900, rel=0.15)
    assert len(set(order)) == pytest.approx(17_100, rel=0.02)
    assert len(order) - len(set(order)) == pytest.approx(3_420, rel=0.1)


@given(st.integers(0, 4), st.integers(1, 2**32 - 1))
def test_a_numbered_picture_is_read_again(head: int, shot: int) -> None:
    assert numbered.read(PICTURES(head, LIGHT, shot)) == (head, shot)


PICTURES = Numbered(5, (160, 40))


def test_a_torn_numbered_picture_is_noticed() -> None:
    torn, other = PICTURES(0, LIGHT, 7), PICTURES(1, LIGHT, 8)
    torn[:, 80:] = other[:, 80:]
    for image in (torn, np.zeros((40, 160), np.uint8)):
        with pytest.raises(ValueError, match="no number"):
            numbered.read(image)
    with pytest.raises(ValueError, match="48 pixels"):
        Numbered(2, (40, 40))


@pytest.mark.parametrize("start_us", [30.0, 90_000.0])
def test_auto_exposure_settles(start_us: float) -> None:
    exposure = start_us
    for _ in range(4):
        mean = min(255.0, exposure / 80)
        exposure = auto.exposure_us(exposure, mean, 20.0, 100_000.0)
    assert auto.settled(min(255.0, exposure / 80))
    assert auto.exposure_us(exposure, auto.TARGET_GREY, 20.0, 100_000.0) == exposure
    assert auto.exposure_us(5000.0, 0.0, 20.0, 100_000.0) == 100_000.0
    assert auto.gain_db(0.0, 50.0, 0.0, 24.0) == pytest.approx(6.0)
    assert auto.gain_db(3.0, 250.0, 0.0, 24.0) == 0.0


def test_an_image_whose_channel_was_closed_meanwhile_goes_nowhere() -> None:
    stream = Stream(0, "127.0.0.1", Registers("127.0.0.1", 16, 16, "S"), Ledger(1), lambda ns: ns)
    try:
        stream.deliver(Shot(1, 1, 0, LIGHT), IMAGE, Conditions(), wanted=True)
    finally:
        stream.sender.close()
