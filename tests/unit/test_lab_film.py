"""The film of a bin being emptied: a frame a cycle, and a file that moves."""

import cv2
import numpy as np
import pytest

from binpick import pipeline
from binpick.errors import InputError
from binpick.lab import exam, film


def test_frames_are_small_overlays():
    paper = exam.paper("A", 1, parts=2)
    picture = film.frame(paper.inputs, pipeline.run(paper.inputs))
    assert picture.shape[1] == film.WIDTH_PX
    assert picture.std() > 10


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
