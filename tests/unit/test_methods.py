"""Both segmenters and both tools, from images to published poses: good ones, and the same bytes in every run."""

import cv2
import pytest

from binpick import pipeline, recording
from binpick.errors import Code
from binpick.lab import exam, grasps

CASES = [(method, tool) for method in ("grid", "open3d") for tool in ("suction", "two_finger")]


@pytest.fixture(scope="module")
def bins():
    """A small bin of few parts: its first cycle by each method and tool."""
    paper = exam.paper("A", 2, parts=10)

    def by(method, tool):
        asked = exam.for_method(exam.for_tool(paper, tool), method)
        return asked, pipeline.run(asked.inputs).result

    return {case: by(*case) for case in CASES}


@pytest.mark.parametrize("case", CASES, ids="-".join)
def test_published_poses_are_good(bins, case):
    paper, result = bins[case]
    assert result.return_code.code is Code.OK
    verdicts = grasps.judged(paper, [grasps.taken(grasp) for grasp in result.grasps])
    assert verdicts[0].ok
    assert sum(verdict.ok for verdict in verdicts) >= 0.8 * len(verdicts)


@pytest.mark.parametrize("case", CASES, ids="-".join)
@pytest.mark.parametrize("threads", [1, 2])
def test_a_replay_gives_the_same_bytes_whatever_the_threads(bins, case, threads, tmp_path):
    paper, result = bins[case]
    recording.save(tmp_path / "cycle", paper.inputs, result)
    inputs, stored = recording.load(tmp_path / "cycle")
    before = cv2.getNumThreads()
    cv2.setNumThreads(threads)
    try:
        again = pipeline.run(inputs).result
    finally:
        cv2.setNumThreads(before)
    assert again.timeless_bytes() == stored.timeless_bytes() == result.timeless_bytes()
