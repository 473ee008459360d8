"""Views: a left and a right image of the same moment, and the board's corners in both."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32

from binpick.errors import ImageError, InputError
from binpick_calib import board as boards
from binpick_calib.board import Board

FEWEST_VIEWS = 5


@dataclass(frozen=True, slots=True)
class Pair:
    """Two files that carry the same number."""

    number: int
    left: Path
    right: Path


@dataclass(frozen=True, slots=True)
class View:
    """The corners of one pair, in the order of the board's points."""

    number: int
    left_px: Float32[np.ndarray, "n 2"]
    right_px: Float32[np.ndarray, "n 2"]


@dataclass(frozen=True, slots=True)
class Views:
    """Everything that can be solved from, and what cannot, with the reason by file name."""

    image_size_px: tuple[int, int]
    used: tuple[View, ...]
    rejected: dict[str, str]


def match(left: str, right: str) -> tuple[list[Pair], dict[str, str]]:
    """Pairs by the number in the names of two patterns' files, and the files without a partner, with the reason.

    Raises InputError when a pattern finds nothing, when two files of a side carry the same number, or no pair is left.
    """
    found = {"left": _files(left, "left"), "right": _files(right, "right")}
    numbers = {path: [int(digits) for digits in re.findall(r"\d+", path.stem)] for files in found.values() for path in files}
    place = _counting_place([[numbers[path] for path in files if numbers[path]] for files in found.values()])
    sides = {side: {numbers[path][place]: path for path in files if numbers[path]} for side, files in found.items()}
    pairs = [Pair(number, path, sides["right"][number]) for number, path in sorted(sides["left"].items())
             if number in sides["right"]]
    if not pairs:
        raise InputError("no left and right image carry the same number in their names "
                         f"(such as {found['left'][0].name} and {found['right'][0].name})")
    if pairs[0].left.samefile(pairs[0].right):
        raise InputError(f"--left and --right both find {pairs[0].left}; give each side its own pattern")
    partnered = {path for pair in pairs for path in (pair.left, pair.right)}
    return pairs, {path.name: f"no partner with number {of[place]}" if of else "no number in its name"
                   for path, of in numbers.items() if path not in partnered}


def _files(pattern: str, side: str) -> list[Path]:
    """A pattern's files; capitals and small letters of the file name are the same."""
    folder, name = Path(pattern).expanduser().parent, Path(pattern).name
    everything = Path(folder.anchor).glob(str(folder.relative_to(folder.anchor) / "*"))
    files = sorted(path for path in everything if path.is_file() and fnmatch(path.name.lower(), name.lower()))
    if not files:
        raise InputError(f"--{side} {pattern}: no file is called so; quote the pattern, and check the folder")
    return files


def _counting_place(sides: list[list[list[int]]]) -> int:
    """Which number of a name counts the views, from the end: the last that differs in every file (0007_cam1.png: −2)."""
    shortest = min((len(numbers) for side in sides for numbers in side), default=0)
    for place in range(-1, -1 - shortest, -1):
        if all(len({numbers[place] for numbers in side}) == len(side) for side in sides):
            return place
    if shortest:
        raise InputError("two images of one side carry the same number in their names: narrow --left and --right")
    return -1


def detect(pairs: Iterable[Pair], board: Board) -> Views:
    """Finds the board in every pair. Raises ImageError for images of another size, InputError for too few views."""
    size: tuple[int, int] | None = None
    used: list[View] = []
    rejected: dict[str, str] = {}
    for pair in pairs:
        corners = []
        for path in (pair.left, pair.right):
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
            if image is None:
                rejected[path.name] = "cannot be read as an image"
                continue
            this_size = (image.shape[1], image.shape[0])
            size = size or this_size
            if this_size != size:
                raise ImageError(f"{path}: {this_size[0]}x{this_size[1]} px, but the images before it are "
                                 f"{size[0]}x{size[1]}: all must come from cameras with the same settings")
            found = boards.find(image, board)
            if found is None or np.isnan(found).any():
                rejected[path.name] = f"no board with {board.columns}x{board.rows} inner corners seen"
            else:
                corners.append(found)
        if len(corners) == 2:
            used.append(View(pair.number, corners[0], boards.align(corners[0], corners[1])))
    if size is None or len(used) < FEWEST_VIEWS:
        raise InputError(f"the board was found in {len(used)} pairs, {FEWEST_VIEWS} are needed{_why(rejected)}")
    return Views(size, tuple(used), rejected)


def _why(rejected: dict[str, str]) -> str:
    return "".join(f"; {reason}: {', '.join(name for name, said in rejected.items() if said == reason)}"
                   for reason in dict.fromkeys(rejected.values()))
