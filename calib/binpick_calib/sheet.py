"""The sheet: a board's black shapes on a page at true scale, with a ruler and the words to say to the tool."""

import re
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from binpick.errors import InputError
from binpick.rigcheck.board import Board, Kind

PAGES_MM = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "a2": (420.0, 594.0), "a1": (594.0, 841.0), "a0": (841.0, 1189.0),
            "letter": (215.9, 279.4)}
RULER_MM = 100.0
_MARGIN_MM = 6.0
_FOOT_MM = 20.0
"""Height of the ruler and the text below the board, the printer's own margin included."""
_USUAL_DOT = {Kind.CIRCLES: 0.6, Kind.ASYMMETRIC: 0.8}


@dataclass(frozen=True, slots=True)
class Box:
    """A black rectangle; x to the right and y down from the page's upper left corner, mm."""

    x: float
    y: float
    width: float
    height: float


@dataclass(frozen=True, slots=True)
class Disc:
    """A black disc, mm."""

    x: float
    y: float
    radius: float


@dataclass(frozen=True, slots=True)
class Line:
    """A line of text: where it begins, and the height of its letters, mm."""

    x: float
    y: float
    size: float
    text: str


@dataclass(frozen=True, slots=True)
class Sheet:
    """Everything printed on one page of `width` x `height` mm."""

    width: float
    height: float
    shapes: tuple[Box | Disc, ...]
    lines: tuple[Line, ...]


def layout(board: Board, page: str = "a4") -> Sheet:
    """The board in the middle of the page, laid on its side where it then fits; raises InputError where it does not."""
    board = replace(board, mark_m=board.mark_m or _USUAL_DOT.get(board.kind, 0.0) * board.square_m)
    shapes, width, height = _SHAPES[board.kind](board)
    page_width, page_height = _page(page, width, height)
    left, top = (page_width - width) / 2, (page_height - _FOOT_MM - height) / 2
    moved = tuple(replace(shape, x=shape.x + left, y=shape.y + top) for shape in shapes)
    ruler, lines = _foot(board, page_width, page_height)
    return Sheet(page_width, page_height, moved + ruler, lines)


def _page(page: str, width: float, height: float) -> tuple[float, float]:
    """The page's sides, mm, the way round that holds the board."""
    custom = re.fullmatch(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)", page.lower())
    if not custom and page.lower() not in PAGES_MM:
        raise InputError(f"--page {page}: give {', '.join(PAGES_MM)}, or a width and a height in mm such as 600x400")
    sides = (float(custom[1]), float(custom[2])) if custom else PAGES_MM[page.lower()]
    least = max(width, RULER_MM) + 2 * _MARGIN_MM, height + 2 * _MARGIN_MM + _FOOT_MM
    for way in (sides, sides[::-1]):
        if way[0] >= least[0] and way[1] >= least[1]:
            return way
    fitting = next((name for name, both in PAGES_MM.items() if min(both) >= min(least) and max(both) >= max(least)), None)
    advice = f"--page {fitting} holds it" if fitting else "no known page holds it"
    raise InputError(f"--page {page}: the board of {width:.0f} x {height:.0f} mm needs "
                     f"{least[0]:.0f} x {least[1]:.0f} mm; {advice}")


def _chessboard(board: Board) -> tuple[list[Box | Disc], float, float]:
    side = 1000 * board.square_m
    squares: list[Box | Disc] = [Box(column * side, row * side, side, side) for row in range(board.rows + 1)
                                 for column in range(board.columns + 1) if (row + column) % 2 == 0]
    return squares, (board.columns + 1) * side, (board.rows + 1) * side


def _charuco(board: Board) -> tuple[list[Box | Disc], float, float]:
    """OpenCV says where its markers lie; every square without one is black."""
    side, drawn = 1000 * board.square_m, board.charuco
    dictionary = drawn.getDictionary()
    cells = dictionary.markerSize + 2    # with the black border
    corners = [1000 * points[0, :2].astype(float) for points in drawn.getObjPoints()]
    marked = {tuple(((place + 500 * board.mark_m) // side).astype(int).tolist()) for place in corners}
    shapes: list[Box | Disc] = [Box(column * side, row * side, side, side) for row in range(board.rows + 1)
                                for column in range(board.columns + 1) if (column, row) not in marked]
    cell = 1000 * board.mark_m / cells
    for number, place in zip(drawn.getIds().ravel().tolist(), corners, strict=True):
        shapes += _marker(cv2.aruco.generateImageMarker(dictionary, number, cells) < 128, place, cell)
    return shapes, (board.columns + 1) * side, (board.rows + 1) * side


def _marker(black: Bool[np.ndarray, "n n"], place: Float[np.ndarray, "2"], cell: float) -> list[Box | Disc]:
    """A marker's black cells, a run of a row at a time."""
    shapes: list[Box | Disc] = []
    for row, bits in enumerate(black):
        starts, ends = (np.flatnonzero(np.diff(np.r_[0, bits, 0].astype(int)) == sign) for sign in (1, -1))
        shapes += [Box(place[0] + start * cell, place[1] + row * cell, (end - start) * cell, cell)
                   for start, end in zip(starts.tolist(), ends.tolist(), strict=True)]
    return shapes


def _tag(board: Board) -> tuple[list[Box | Disc], float, float]:
    """Number 0 of its family, with a cell of white around it."""
    family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}".upper()))
    cells, side = family.markerSize + 2, 1000 * board.square_m
    black = cv2.aruco.generateImageMarker(family, 0, cells) < 128
    return _marker(black, np.array([1.0, 1.0]) * side / cells, side / cells), side * (1 + 2 / cells), side * (1 + 2 / cells)


def _dots(board: Board) -> tuple[list[Box | Disc], float, float]:
    """A dot's distance of white around them all: the search takes what lies nearer for a part of the grid."""
    places = 1000 * board.points_m[:, :2].astype(float)
    edge = 1000 * (board.mark_m / 2 + board.square_m / 2)
    width, height = (places.max(0) + 2 * edge).tolist()
    return [Disc(x + edge, y + edge, 500 * board.mark_m) for x, y in places.tolist()], width, height


_SHAPES = {Kind.CHESSBOARD: _chessboard, Kind.CHARUCO: _charuco, Kind.CIRCLES: _dots, Kind.ASYMMETRIC: _dots, Kind.TAG: _tag}


def _foot(board: Board, width: float, height: float) -> tuple[tuple[Box | Disc, ...], tuple[Line, ...]]:
    """The ruler with its ticks of 10 mm, and what to do with the sheet."""
    left, y, thin = (width - RULER_MM) / 2, height - _FOOT_MM, 0.25
    ticks = [Box(left + mm - thin / 2, y - (3.0 if mm % 50 == 0 else 1.5), thin, 3.0 if mm % 50 == 0 else 1.5)
             for mm in range(0, int(RULER_MM) + 1, 10)]
    said = (f"--board {board}",
            f"Printed at 100 %, this line is {RULER_MM:g} mm long. If it is not, measure the board and say its size.",
            "Glue it to something flat and stiff; keep the white around it.")
    lines = tuple(Line(left, y + 5.0 + 4.5 * number, 3.4 if number == 0 else 2.6, text) for number, text in enumerate(said))
    return (Box(left, y, RULER_MM, thin), *ticks), lines
