"""A board's description: its kind, its points in metres, and the turns after which it looks the same."""

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Int32

from binpick.errors import InputError

EXAMPLES = ("chessboard:9x6:0.025 (inner corners, side of a square in metres), charuco:9x6:0.025[:0.018[:5x5_1000]] (inner "
            "corners, side of a square, side of a marker, dictionary), circles:9x7:0.02[:0.012] (dots each way, distance of "
            "neighbours, diameter), acircles:4x11:0.02[:0.012] (dots of a row and rows, half the distance of dots of a row, "
            "diameter) or apriltag:36h11:0.08 (a single tag: family, side of its black square)")
_SPEC = re.compile(r"(chessboard|charuco|circles|acircles):(\d+)x(\d+):(\d*\.?\d+)(?::(\d*\.?\d+)(?::(\w+))?)?")
_TAG = re.compile(r"apriltag:(\w+):(\d*\.?\d+)")


class Kind(StrEnum):
    """What is printed."""

    CHESSBOARD = "chessboard"
    CHARUCO = "charuco"
    CIRCLES = "circles"
    ASYMMETRIC = "acircles"
    TAG = "apriltag"


_USUAL_MARKER = 0.75


@dataclass(frozen=True, slots=True)
class Board:
    """`columns` x `rows` points: inner corners of a chessboard or ChArUco, centres of dots, or the corners of one tag.

    `square_m`: a square's side; of circles the distance of neighbours; of asymmetric circles half the distance of neighbours
    in a row, which is the distance of rows (as in OpenCV). `mark_m`: side of a marker, diameter of a dot; 0: unknown or none.
    """

    columns: int
    rows: int
    square_m: float
    kind: Kind = Kind.CHESSBOARD
    mark_m: float = 0.0
    dictionary: str = ""

    def __str__(self) -> str:
        if self.kind is Kind.TAG:
            return f"{self.kind}:{self.dictionary.removeprefix('apriltag_')}:{self.square_m:g}"
        marked = f":{self.mark_m:g}" if self.mark_m else ""
        return f"{self.kind}:{self.columns}x{self.rows}:{self.square_m:g}{marked}" + (f":{self.dictionary}" if self.dictionary
                                                                                     else "")

    @property
    def points_m(self) -> Float32[np.ndarray, "n 3"]:
        """The points in the board's frame, row by row; x along a row, y down the rows, z = 0 and away from the viewer."""
        grid = np.zeros((self.rows, self.columns, 3), np.float32)
        grid[..., 0], grid[..., 1] = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        if self.kind is Kind.ASYMMETRIC:
            grid[..., 0] = 2 * grid[..., 0] + grid[..., 1] % 2
        return grid.reshape(-1, 3) * np.float32(self.square_m)

    @property
    def turns(self) -> tuple[Int32[np.ndarray, "n"], ...]:
        """The other numberings under which the board looks the same: ids of the points that stand in each point's place.

        Empty for a board that shows which way it lies: a ChArUco, a tag, a chessboard with one odd and one even count,
        asymmetric circles. The others have a half turn, a square grid of dots the quarter turns, too.
        """
        if self.kind in (Kind.CHARUCO, Kind.TAG) or (self.kind is Kind.CHESSBOARD and (self.columns + self.rows) % 2):
            return ()
        quarters = [1, 2, 3] if self.kind is Kind.CIRCLES else [2]
        turned = (self._places(np.linalg.matrix_power(np.array([[0, -1], [1, 0]]), quarter)) for quarter in quarters)
        return tuple(ids for ids in turned if ids is not None)

    @property
    def mirrored(self) -> Int32[np.ndarray, "n"]:
        """The numbering of the board seen in a mirror: grids are found without knowing which side of them is printed."""
        across = self._places(np.diag([-1, 1]))
        ids = self._places(np.diag([1, -1])) if across is None else across
        return np.arange(self.columns * self.rows, dtype=np.int32) if ids is None else ids

    def _places(self, change: np.ndarray) -> Int32[np.ndarray, "n"] | None:
        """Ids of the points onto which a change about the middle lays each point; None when the set of points changes."""
        whole = np.rint(2 * self.points_m[:, :2] / np.float32(self.square_m)).astype(np.int32)
        middle = whole.min(0) + whole.max(0)
        place = {tuple(point): number for number, point in enumerate((2 * whole - middle).tolist())}
        ids = [place.get(tuple(point)) for point in ((2 * whole - middle) @ change.T).tolist()]
        return None if None in ids else np.array(ids, dtype=np.int32)

    @property
    def charuco(self) -> Any:
        """OpenCV's description of a ChArUco board (`cv2.aruco.CharucoBoard`); its corners are numbered as `points_m`."""
        marks = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}".upper()))
        return cv2.aruco.CharucoBoard((self.columns + 1, self.rows + 1), self.square_m, self.mark_m, marks)


def parse(spec: str) -> Board:
    """The board of `chessboard:9x6:0.025` and its like. Raises InputError, which says how each kind is written."""
    tag = _TAG.fullmatch(spec.strip().lower())
    found = _SPEC.fullmatch(spec.strip().lower())
    if tag:
        square_m = float(tag[2])
        _check_side(spec, square_m)
        return Board(2, 2, square_m, Kind.TAG, dictionary=_dictionary(spec, f"apriltag_{tag[1].removeprefix('tag')}", 1))
    if not found:
        raise InputError(f"--board {spec}: write it as {EXAMPLES}")
    kind, columns, rows, square_m = Kind(found[1]), int(found[2]), int(found[3]), float(found[4])
    _check_counts(spec, kind, columns, rows)
    _check_side(spec, square_m)
    if kind is Kind.CHESSBOARD:
        if found[5]:
            raise InputError(f"--board {spec}: a chessboard has no markers; write it as chessboard:9x6:0.025")
        return Board(columns, rows, square_m)
    mark_m = float(found[5] or 0) or (round(_USUAL_MARKER * square_m, 6) if kind is Kind.CHARUCO else 0.0)
    widest = square_m * (np.sqrt(2) if kind is Kind.ASYMMETRIC else 1)
    if mark_m and not 0.2 * square_m <= mark_m <= 0.9 * widest:
        raise InputError(f"--board {spec}: markers or dots of {mark_m:g} m; 0.2 to 0.9 of their distance can be told apart")
    if kind is not Kind.CHARUCO:
        if found[6]:
            raise InputError(f"--board {spec}: only a ChArUco board has a dictionary")
        return Board(columns, rows, square_m, kind, mark_m)
    dictionary = _dictionary(spec, found[6] or "5x5_1000", (columns + 1) * (rows + 1) // 2)
    return Board(columns, rows, square_m, kind, mark_m, dictionary)


def _check_side(spec: str, square_m: float) -> None:
    if not 0.001 <= square_m <= 0.5:
        raise InputError(f"--board {spec}: a square of {square_m:g} m; give its side in metres, 0.001 to 0.5")


def _check_counts(spec: str, kind: Kind, columns: int, rows: int) -> None:
    fewest = {Kind.CHARUCO: 2, Kind.ASYMMETRIC: 2}.get(kind, 3)
    if not (fewest <= rows <= 50 and fewest <= columns <= 50):
        raise InputError(f"--board {spec}: {fewest} to 50 {'dots' if 'circles' in kind else 'inner corners'} each way")
    if kind is Kind.ASYMMETRIC and rows % 2 == 0:
        raise InputError(f"--board {spec}: give it an odd number of rows; with an even one its rows cannot be told apart")
    if kind is Kind.CHESSBOARD and rows == columns:
        raise InputError(f"--board {spec}: 3 to 50 inner corners each way, and not the same number both ways")


def _dictionary(spec: str, name: str, markers: int) -> str:
    name = name.removeprefix("dict_")
    known = sorted(given.removeprefix("DICT_").lower() for given in dir(cv2.aruco) if given.startswith("DICT_"))
    if name not in known:
        raise InputError(f"--board {spec}: no dictionary is called {name}; there are {', '.join(known)}")
    there = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}".upper())).bytesList)
    if there < markers:
        raise InputError(f"--board {spec}: it needs {markers} markers, and {name} has {there}")
    return name
