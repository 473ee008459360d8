"""The projector's sequence is what OpenCV's Gray code says, thrown where the picture's columns and rows are."""

import cv2
import numpy as np
import pytest

from binpick import data
from binpick.sim.projector import Projector

GRAY = cv2.structured_light.GrayCodePattern.create(*data.GRAY_CODE_SIZE_PX)


@pytest.fixture(scope="module")
def projector():
    return Projector("B")


def test_the_numbers_of_the_sequence_are_opencvs():
    assert GRAY.getNumberOfPatternImages() == data.GRAY_CODE_IMAGES
    assert data.FIRST_GRAY_PATTERN == data.DOT_PATTERNS
    assert data.BLACK_PATTERN == data.DOT_PATTERNS + data.GRAY_CODE_IMAGES + 1


def test_the_gray_code_reads_as_the_projectors_columns_and_rows(projector):
    # three centres of the projector's pixels, as cells of the picture
    width, height = data.GRAY_CODE_SIZE_PX
    side = projector.picture(0).shape[0]
    pixels = np.array([[100, 20], [511, 400], [1000, 760]])
    cell = side / width
    top = (side - side * height // width) // 2
    columns, rows = ((pixels[:, 0] + 0.5) * cell).astype(int), ((pixels[:, 1] + 0.5) * cell).astype(int) + top
    # decoded by OpenCV, each of the three places being a camera's pixel
    images = [(projector.picture(data.FIRST_GRAY_PATTERN + i)[rows, columns] * 255).astype(np.uint8)[None]
              for i in range(data.GRAY_CODE_IMAGES)]
    found = [GRAY.getProjPixel(images, i, 0) for i in range(3)]
    assert [(not failed, tuple(at)) for failed, at in found] == [(True, tuple(p)) for p in pixels.tolist()]


def test_white_is_white_and_black_is_black(projector):
    middle = (slice(1400, 1600), slice(100, 2900))
    assert (projector.picture(data.WHITE_PATTERN)[middle] == 1).all()
    assert not projector.picture(data.BLACK_PATTERN).any()


def test_other_dots_are_other_dots_alike(projector):
    first, second = projector.picture(0), projector.picture(1)
    assert abs(np.corrcoef(first[::7, ::7].ravel(), second[::7, ::7].ravel())[0, 1]) < 0.02
    assert first.mean() == pytest.approx(second.mean(), rel=0.01)
    assert first.std() == pytest.approx(second.std(), rel=0.01)


def test_the_bin_lies_within_the_pictures_that_are_wider_than_high(projector):
    corners = np.array([[x, y, z] for x in (-0.15, 0.15) for y in (-0.1, 0.1) for z in (0.0, 0.12)], np.float32)
    column, row = (axis.astype(int) for axis in projector.place(corners))
    assert (projector.picture(data.WHITE_PATTERN)[row, column] == 1).all()
