"""Where a set of samples stands: what it shows of the board and of the robot's turns, and what is missing."""

from collections.abc import Sequence

from binpick.calibration import Progress, transform
from binpick.cell.samples import Stored
from binpick.rigcheck import spread
from binpick.rigcheck.coverage import Coverage

POSES = 10
"""Samples with a flange pose: half of them hold a hand-eye calibration, ten let some that are wrong be told from the others."""


def coverage(samples: Sequence[Stored], cameras: Sequence[str]) -> Coverage:
    """Of the views that were worth taking."""
    covered = Coverage(tuple(cameras))
    for stored in samples:
        if stored.sample.useful:
            covered = covered.add(stored.seen)
    return covered


def judge(samples: Sequence[Stored], cameras: Sequence[str]) -> Progress:
    """What is missing: for a hand-eye calibration when the robot told its flange pose, else for cameras seen by themselves."""
    covered = coverage(samples, cameras)
    posed = [stored for stored in samples if stored.sample.T_base_flange is not None and any(stored.seen)]
    missing = poses_missing([stored for stored in posed if stored.sample.useful]) if posed else covered.missing
    return Progress(enough=not missing, missing=tuple(missing), coverage=covered.summary)


def poses_missing(posed: Sequence[Stored]) -> list[str]:
    """What the next samples with a flange pose should show, as sentences."""
    poses = [transform(pose) for stored in posed if (pose := stored.sample.T_base_flange) is not None]
    missing = []
    if len(poses) > 1 and (why := spread.fault(poses, upright=False)):
        missing.append(why)
    if len(poses) < POSES:
        missing.append(f"{POSES - len(poses)} more samples with a flange pose: there are {len(poses)} of {POSES}")
    return missing
