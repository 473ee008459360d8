"""The measure of segmentation: overlaps counted by hand, visibility of parts that hide each other."""

import math

import numpy as np
import pytest

from binpick import geometry, settings
from binpick.cycle import CycleInput
from binpick.data import Frame, StereoPair, Window
from binpick.lab import parts
from binpick.lab.exam import Paper
from binpick.lab.parts import PartScore
from binpick.result import Request
from binpick.sim import exam
from binpick.sim.world import ScenePart, WorldScene


def test_overlaps_are_counted_in_full_pixels():
    truth = np.zeros((9, 12), dtype=np.int32)
    truth[0:8, 0:4], truth[0:8, 4:8], truth[8, 0:4] = 1, 2, 1
    labels = np.zeros((4, 6), dtype=np.int32)
    labels[:, 0:2], labels[:, 2] = 3, 1
    found = parts.overlaps(labels, truth)
    # 32 of 36 pixels, the odd last row belongs to nobody; half of part 2
    assert found[1] == (pytest.approx(32 / 36), 1.0)
    assert found[2] == (pytest.approx(16 / 32), 1.0)
    labels[:, 2] = 3
    merged = parts.overlaps(labels, truth)
    assert merged[1] == (pytest.approx(32 / (48 + 36 - 32)), pytest.approx(32 / 48))
    assert merged[2][0] == pytest.approx(16 / (48 + 32 - 16))


def test_a_part_without_a_segment_is_not_found():
    truth = np.ones((4, 4), dtype=np.int32)
    iou, purity = parts.overlaps(np.zeros((2, 2), dtype=np.int32), truth)[1]
    assert iou == 0
    assert math.isnan(purity)


def test_recall_asks_for_parts_in_plain_view():
    scores = [PartScore(1, "block", 1.0, 0.8, 1.0), PartScore(2, "block", 0.9, 0.5, 1.0), PartScore(3, "block", 0.6, 0.9, 1.0)]
    assert parts.recall(scores) == (1, 2)
    assert parts.recall(scores, 0.75, 0.5, 0.85) == (1, 1)


def test_a_part_under_another_is_seen_in_part():
    paper = _paper(ScenePart(1, "block", geometry.translation(0.0, 0.0, 0.0075)),
                   ScenePart(2, "block", geometry.translation(0.03, 0.0, 0.0225)))
    alone = _paper(paper.scene.parts[0])
    whole, seen = ((p.truth(WINDOW).part_id == 1).sum() for p in (alone, paper))
    shares = parts.visibility(paper, paper.truth(WINDOW), WINDOW)
    assert shares == {1: seen / whole, 2: 1.0}
    # half of its top is hidden, its side is not
    assert 0.5 < shares[1] < 0.75


WINDOW = Window(x=800, y=400, width=320, height=320, min_disparity=200, num_disparities=128)


def _paper(*lying: ScenePart) -> Paper:
    dark = np.zeros((2, 2), dtype=np.uint8)
    left, right = (Frame(image=dark, camera=name, sequence=1, frame_id=1, timestamp_ns=0, triggered_ns=0, received_ns=1,
                         exposure_us=1.0, gain_db=0.0) for name in ("left", "right"))
    pair = StereoPair(left, right, "2026-01-01T00:00:00Z", 0.0, 0.0, "simulated")
    inputs = CycleInput(1, pair, exam.rig("A"), settings.resolve(exam.cell("A"), 1), Request(), simulated=True)
    return Paper(inputs, WorldScene("A", lying, 1, 1))
