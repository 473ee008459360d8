"""The PLC's rule: it hands the robot nothing unless every proof holds."""

import asyncio
import struct
from collections.abc import Callable

import numpy as np
import pytest

from binpick.errors import NotReady
from binpick.sim.plc import Plc, PlcResult

Block = list[int]


def sealed(block: Block) -> Block:
    """With every check right again."""
    for first, last in ((0, 19), (20, 45), (46, 71), (72, 97), (98, 123), (0, 124)):
        block[last] = (0x5A5A + sum(block[first:last])) % 65536
    return block


def block() -> Block:
    words = [0] * 125
    words[:20] = [5, 1, 77, 1, 0b110010, 0, 0, 1, 1, 3, 4, 1, 1, 1, 0, 0, 60, 250, 500, 0]
    words[20:22] = [5, 1]
    words[22:36] = struct.unpack(">14H", struct.pack(">7f", 100.0, -50.0, 950.0, 0.0, 0.0, 90.0, 0.0))
    words[36:45] = [1, 1, 3, 900, 562, 401, 800, 30, 10]
    return sealed(words)


async def read(words: Block, cmd_seq: int = 77) -> PlcResult:
    """What the PLC makes of a block that it reads when VALID is up."""
    plc = Plc("192.0.2.1", 1)
    plc._cmd_seq = cmd_seq

    async def from_memory(address: int, count: int) -> Block:
        assert (address, count) == (100, 125)
        return words

    plc._read = from_memory  # type: ignore[method-assign]
    return await plc._result(valid=True)


def test_a_whole_block_is_believed() -> None:
    result = asyncio.run(read(block()))
    assert (result.return_code, result.seq, result.frame, result.acquire_ms, result.total_ms) == (0, 5, 3, 60, 250)
    record, = result.records
    expected = [[0, -1, 0, 0.1], [1, 0, 0, -0.05], [0, 0, 1, 0.95], [0, 0, 0, 1]]
    np.testing.assert_allclose(record.T_frame_tcp, expected, atol=1e-7)
    assert (record.grasp_id, record.tool, record.quality, record.approach_m) == (1, 1, 0.9, 0.08)
    assert (record.open_m, record.close_m) == (0.0562, 0.0401)


def changed(index: int, word: int) -> Callable[[Block], None]:
    return lambda words: words.__setitem__(index, word)


@pytest.mark.parametrize("spoil", [
    changed(2, 78), changed(4, 0b010010), changed(5, 102), changed(5, 0x10000 - 26), changed(13, 0), changed(36, 0),
    changed(20, 4)])
def test_what_the_rule_forbids_moves_nothing(spoil: Callable[[Block], None]) -> None:
    words = block()
    spoil(words)
    assert asyncio.run(read(sealed(words))).records == ()


@pytest.mark.parametrize("index", [0, 2, 19, 22, 45, 60, 123, 124])
def test_one_wrong_bit_anywhere_is_noticed(index: int) -> None:
    words = block()
    words[index] ^= 0x0100
    with pytest.raises(NotReady, match="check is wrong"):
        asyncio.run(read(words))


def test_an_unknown_pose_format_is_an_error() -> None:
    words = block()
    words[10] = 9
    with pytest.raises(NotReady, match="9"):
        asyncio.run(read(sealed(words)))
