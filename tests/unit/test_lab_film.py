"""The film of a bin being emptied: a frame a cycle, and a file that moves."""

import cv2
import numpy as np
import pytest

from binpick.errors import InputError
from binpick.lab import film


@pytest.mark.slow
def test_a_bin_is_filmed_until_it_is_empty():
    frames = list(film.shoot("A", 1, 1))
    assert len(frames) == 2
    assert {frame.shape[1] for frame in frames} == {film.WIDTH_PX}
    assert np.abs(frames[0].astype(float) - frames[1]).mean() > 0.5


def test_a_film_has_all_frames(tmp_path):
    frames = [np.full((48, 64, 3), level, np.uint8) for level in (0, 120, 240)]
    path = tmp_path / "film.webp"
    film.save(frames, path)
    loaded, seen = cv2.imreadanimation(str(path))
    assert loaded
    assert [round(float(frame[..., :3].mean()) / 120) for frame in seen.frames] == [0, 1, 2]
    assert seen.durations[-1] > seen.durations[0]


def test_a_file_that_cannot_move_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"\.webp"):
        film.save([np.zeros((4, 4, 3), np.uint8)], tmp_path / "film.jpg")
    with pytest.raises(InputError, match="no folder"):
        film.save(iter(()), tmp_path / "nowhere" / "film.webp")
