"""Parts fall the same way every time, stay in the bin, and come to rest."""

import numpy as np
import pytest

from binpick.sim import collision, exam
from binpick.sim.world import World


@pytest.fixture(scope="module")
def settled():
    return World("B", "mixed", 10, 4).scene()


def test_the_same_arguments_make_the_same_world(settled):
    assert World("B", "mixed", 10, 4).scene().digest == settled.digest
    assert World("B", "mixed", 10, 5).scene().digest != settled.digest


def test_every_part_lies_in_the_bin(settled):
    length, width, _ = exam.setup("B").bin_size_m
    assert len(settled.parts) == 10
    for part in settled.parts:
        corners = collision._skin(part.kind) @ part.T_bin_part[:3, :3].T + part.T_bin_part[:3, 3]
        # contacts are a little soft
        assert (np.abs(corners[:, :2]) < np.array([length, width]) / 2 + 5e-4).all()
        assert corners[:, 2].min() > -5e-4


def test_what_has_settled_stays_where_it_is(settled):
    world = World("B", "mixed", 10, 4)
    world.settle()
    for before, after in zip(settled.parts, world.scene().parts, strict=True):
        assert np.linalg.norm(after.T_bin_part[:3, 3] - before.T_bin_part[:3, 3]) < 1e-3


def test_a_removed_part_is_gone_and_the_others_fall():
    world = World("B", "block", 12, 1)
    before = world.scene()
    for part in sorted(before.parts, key=lambda p: p.T_bin_part[2, 3])[:6]:
        world.remove(part.part_id)
    lifted = world.scene()
    assert len(lifted.parts) == 6
    assert lifted.revision > before.revision
    world.settle()
    after = {p.part_id: p.T_bin_part for p in world.scene().parts}
    assert set(after) == {p.part_id for p in lifted.parts}
    assert sum(T[2, 3] for T in after.values()) <= sum(p.T_bin_part[2, 3] for p in lifted.parts) + 1e-3
    with pytest.raises(KeyError):
        world.remove(99)


def test_an_emptied_world_is_empty():
    world = World("B", "cylinder", 1, 1)
    world.remove(1)
    world.settle()
    assert world.scene().parts == ()
