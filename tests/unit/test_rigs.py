"""Versions of the rig and samples on disk: there whole or not at all, whenever the process is killed."""

import multiprocessing
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest

from binpick import calibration, geometry
from binpick import rig as rig_file
from binpick.calibration import Sample, Sighting
from binpick.cell import progress
from binpick.cell.rigs import Rigs
from binpick.cell.samples import MOST, SampleStore, Stored
from binpick.errors import InputError, NotApplicable, NotReady, RigError, UnknownItem
from binpick.message import PoseMessage
from binpick.rig import Rig
from binpick.rigcheck import board as boards
from binpick.rigcheck.detection import Detection, Quality

FORK = multiprocessing.get_context("fork")
BOARD = boards.parse("chessboard:5x4:0.03")


def mounted(rig: Rig, x: float) -> Rig:
    return rig.model_copy(update={"T_base_rig": tuple(map(tuple, geometry.translation(x, 0.0, 0.0).tolist()))})


def opened(folder: Path, rig: Rig) -> Rigs:
    return Rigs(folder, folder / "rig.json", rig)


def test_the_rig_file_alone_is_version_1_and_nothing_is_written(tmp_path: Path, rig: Rig) -> None:
    rigs = opened(tmp_path, rig)
    installed = rigs.chosen()
    assert (installed.told.version, installed.rig, installed.note) == (1, rig, "")
    assert [(one.version, one.active, one.file) for one in rigs.told(1)] == [(1, True, str(tmp_path / "rig.json"))]
    assert not list(tmp_path.iterdir())


def test_a_new_version_waits_to_be_activated_and_the_choice_survives(tmp_path: Path, rig: Rig) -> None:
    rigs, better = opened(tmp_path, rig), mounted(rig, 0.5)
    assert rigs.add(better) == 2
    assert opened(tmp_path, rig).chosen().told.version == 1
    assert rigs.activate(2).rig == better
    again = opened(tmp_path, rig)
    assert (again.chosen().rig, again.chosen().told.hand_eye) == (better, "base")
    assert [(one.version, one.active) for one in again.told(2)] == [(1, False), (2, True)]
    assert again.activate(1).rig == rig
    assert opened(tmp_path, rig).chosen().told.version == 1
    with pytest.raises(UnknownItem, match="no version 3 of the rig; there are 1, 2"):
        again.activate(3)
    assert rig_file.load(tmp_path / "rigs" / "0002.json") == (better, [])


def test_a_rig_file_that_was_replaced_is_used_and_said_and_the_old_one_can_be_had_again(tmp_path: Path, rig: Rig) -> None:
    rigs = opened(tmp_path, rig)
    rigs.add(mounted(rig, 0.5))
    rigs.activate(2)
    new = rig.model_copy(update={"created": "2026-02-02"})
    rigs = opened(tmp_path, new)
    installed = rigs.chosen()
    assert (installed.told.version, installed.rig) == (3, new)
    assert "was replaced after version 2 was activated" in installed.note
    assert rigs.activate(1).rig == rig
    assert opened(tmp_path, new).chosen().told.version == 1
    assert opened(tmp_path, rig).chosen().note        # and back again: once more another file than the one that was chosen with
    assert opened(tmp_path, rig).chosen().told.version == 1


@pytest.mark.parametrize(("spoil", "said"), [
    (lambda folder: (folder / "0002.json").write_bytes((folder / "0002.json").read_bytes()[:-40]), "not readable as JSON"),
    (lambda folder: (folder / "0002.json").unlink(), "is gone"),
    (lambda folder: (folder / "0002.json").write_bytes((folder / "0001.json").read_bytes()), "not what was activated"),
    (lambda folder: (folder / "active.json").write_bytes(b"{"), "nobody knows which version"),
])
def test_no_other_version_stands_in_for_a_damaged_one(tmp_path: Path, rig: Rig, spoil: Callable[[Path], object],
                                                      said: str) -> None:
    rigs = opened(tmp_path, rig)
    rigs.add(mounted(rig, 0.5))
    rigs.activate(2)
    spoil(tmp_path / "rigs")
    with pytest.raises(RigError, match=rf"{said}.*delete .*active\.json to run on the rig file"):
        opened(tmp_path, rig).chosen()


def test_a_damaged_version_that_is_not_active_is_named_and_its_number_not_used_again(tmp_path: Path, rig: Rig) -> None:
    rigs = opened(tmp_path, rig)
    rigs.add(mounted(rig, 0.5))
    (tmp_path / "rigs" / "0002.json").write_bytes(b"{}")
    rigs = opened(tmp_path, rig)
    assert rigs.chosen().told.version == 1
    assert list(rigs.damaged) == [2]
    assert rigs.add(mounted(rig, 0.6)) == 3
    with pytest.raises(UnknownItem, match="not a rig file"):
        rigs.activate(2)


def test_a_disk_that_cannot_be_written_is_named(tmp_path: Path, rig: Rig) -> None:
    (tmp_path / "rigs").write_bytes(b"")
    with pytest.raises(RigError, match=r"calibration\.directory"):
        opened(tmp_path, rig)
    rigs = opened(tmp_path / "folder", rig)
    (tmp_path / "folder").write_bytes(b"")
    with pytest.raises(NotReady, match=r"cannot be written.*calibration\.directory"):
        rigs.add(mounted(rig, 0.5))
    assert [one.version for one in rigs.told(1)] == [1]


def _calibrate(folder: Path, rig: Rig, said: Connection) -> None:
    """For ever: a new version, activated; each is announced before and after."""
    rigs = opened(folder, rig)
    x = len(rigs.told(1)) / 1000
    while True:
        x += 0.001
        number = rigs.add(mounted(rig, x))
        said.send(number)
        rigs.activate(number)
        said.send(-number)


def test_a_kill_at_any_moment_leaves_the_old_version_or_the_new_one(tmp_path: Path, rig: Rig) -> None:
    for kill in range(12):
        here, there = FORK.Pipe(duplex=False)
        child = FORK.Process(target=_calibrate, args=(tmp_path, rig, there), daemon=True)
        child.start()
        there.close()
        here.recv()
        time.sleep(0.0007 * kill)
        child.kill()
        child.join()
        told = []
        while True:
            try:
                told.append(here.recv())
            except EOFError:
                break
        here.close()
        rigs = opened(tmp_path, rig)
        active = rigs.chosen().told.version
        assert rigs.damaged == {}
        numbers = [one.version for one in rigs.told(active)]
        assert numbers == list(range(1, len(numbers) + 1))
        done = max((-number for number in told if number < 0), default=0)
        assert done <= active <= numbers[-1]


def stored(number: int, turn_rad: float = 0.0, useful: bool = True, posed: bool = True) -> Stored:
    points = BOARD.points_m[:, :2] * 4000 + 200
    quality = Quality(float("nan"), 150.0, 30.0, 0.1, (1, 1), 0.2, 0.05)
    seen = Detection(BOARD, (640, 480), np.arange(20, dtype=np.int32), points.astype(np.float32), quality)
    turn = (float(np.sin(turn_rad / 2)), 0.0, 0.0, float(np.cos(turn_rad / 2)))
    sample = Sample(
        id=number, captured_at="2026-01-01T00:00:00Z", board=str(BOARD), simulated=False, rig_sha256="a", cameras_sha256="b",
        T_base_flange=PoseMessage(position_m=(0, 0, 1), quaternion_xyzw=turn) if posed else None, useful=useful, reason="new",
        sightings=(Sighting(camera="left", found=True, points=20),
                   Sighting(camera="right", found=False, points=0, reason="dark")))
    return Stored(sample, (seen, None))


def test_samples_come_back_as_they_were(tmp_path: Path) -> None:
    store = SampleStore(tmp_path)
    assert store.next_id == 1
    store.add(stored(1), {"left.png": b"l", "right.png": b"r"})
    store.add(stored(2), {"left.png": b"l2", "right.png": b"r2"})
    again = SampleStore(tmp_path)
    assert [one.sample for one in again.all] == [stored(1).sample, stored(2).sample]
    left, right = again.all[1].seen
    before = stored(2).seen[0]
    assert right is None
    assert left is not None
    assert before is not None
    np.testing.assert_array_equal(left.corners_px, before.corners_px)
    np.testing.assert_array_equal(left.ids, before.ids)
    assert np.isnan(left.quality.blur_px)
    assert (left.board, left.image_size_px) == (BOARD, (640, 480))
    assert (again.image(2, "right"), again.image(2, "third"), again.image(3, "left")) == (b"r2", None, None)
    again.remove(1)
    assert [one.sample.id for one in SampleStore(tmp_path).all] == [2]
    again.remove()
    assert not list((tmp_path / "samples").iterdir())
    with pytest.raises(NotApplicable, match="no sample 2"):
        again.remove(2)


def test_what_a_kill_left_unfinished_is_cleared_away_and_what_is_damaged_is_named(tmp_path: Path) -> None:
    store = SampleStore(tmp_path)
    store.add(stored(1), {"left.png": b"l"})
    store.add(stored(2), {"left.png": b"l"})
    partial = tmp_path / "samples" / ".0003"
    partial.mkdir()
    (partial / "left.png").write_bytes(b"l")
    (tmp_path / "samples" / "0001" / "sample.json").write_bytes(b"{")
    again = SampleStore(tmp_path)
    assert [one.sample.id for one in again.all] == [2]
    assert list(again.damaged) == ["0001"]
    assert not partial.exists()
    assert again.next_id == 3
    again.remove()
    assert (SampleStore(tmp_path).damaged, SampleStore(tmp_path).all) == ({}, ())


def test_samples_are_bounded_in_number(tmp_path: Path) -> None:
    store = SampleStore(tmp_path)
    for number in range(1, MOST + 1):
        store.admit()
        store.add(stored(number), {})
    with pytest.raises(NotApplicable, match="DELETE /v1/calibration/samples"):
        store.admit()


def test_a_folder_that_cannot_be_read_or_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "samples").write_bytes(b"")
    with pytest.raises(InputError, match=r"calibration\.directory"):
        SampleStore(tmp_path)
    store = SampleStore(tmp_path / "folder")
    (tmp_path / "folder").write_bytes(b"")
    with pytest.raises(NotReady, match="cannot be written"):
        store.add(stored(1), {})
    assert store.all == ()


def test_missing_is_said_of_poses_or_of_views() -> None:
    views = progress.judge([stored(1, posed=False)], ["left", "right"])
    assert not views.enough
    assert any("image" in sentence for sentence in views.missing)
    few = progress.judge([stored(1), stored(2, 0.01)], ["left", "right"])
    assert [sentence.split(" (")[0] for sentence in few.missing] == [
        "the flange hardly turned", "8 more samples with a flange pose: there are 2 of 10"]
    again = progress.judge([stored(1), stored(2, useful=False)], ["left", "right"])      # one stand is not two
    assert again.missing == ("9 more samples with a flange pose: there are 1 of 10",)
    one_axis = progress.judge([stored(n, 0.1 * n) for n in range(1, 11)], ["left", "right"])
    assert len(one_axis.missing) == 1
    assert "four axes" in one_axis.missing[0]
    assert views.coverage["views"] == 1


def test_the_cameras_name_leaves_hand_eye_out(rig: Rig) -> None:
    assert calibration.cameras_sha256(mounted(rig, 1.0)) == calibration.cameras_sha256(rig)
    assert calibration.cameras_sha256(rig.model_copy(update={"image_size_px": (10, 10)})) != calibration.cameras_sha256(rig)
