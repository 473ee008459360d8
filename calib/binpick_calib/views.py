"""Views: the images of one moment, one of each camera, and the board's corners in them."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from binpick.errors import ImageError, InputError
from binpick.rigcheck import sight
from binpick.rigcheck.board import Board
from binpick.rigcheck.detection import Detection, Refusal

FEWEST_VIEWS = 5
FEWEST_CORNERS = 8
"""Of a board seen in part: fewer leave its tilt to chance."""
BLURRED = 1.6
"""Times the median sigma of the edges: of one lens and one board, sharp views differ by 1.15 at most (far and oblique ones)."""


@dataclass(frozen=True, slots=True)
class Shot:
    """The files that carry the same number, one of each camera; None where a further camera has none."""

    number: int
    files: tuple[Path | None, ...]


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """The corners of one shot, for each camera in the order of the board's points; NaN = this corner was not seen.

    Any detector may fill it. `blur_px`: sigma of the printed edges in each image, NaN = not measured. `seen`: the detections
    themselves, where there are any.
    """

    number: int
    names: tuple[str, ...]
    corners_px: tuple[Float32[np.ndarray, "_ 2"], ...]
    blur_px: tuple[float, ...]
    seen: tuple[Detection | None, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Everything that can be solved from, and what cannot, with the reason by file name."""

    image_size_px: tuple[int, int]
    used: tuple[View, ...]
    rejected: dict[str, str]


def match(*patterns: str) -> tuple[list[Shot], dict[str, str]]:
    """Shots by the number in the names of the patterns' files (left, right, further cameras), and the files without a partner.

    Raises InputError when a pattern finds nothing, when two files of a side carry the same number, or no shot is left.
    """
    found = {side: _files(pattern, side) for side, pattern in zip(sides(len(patterns)), patterns, strict=True)}
    numbers = {path: [int(digits) for digits in re.findall(r"\d+", path.stem)] for files in found.values() for path in files}
    place = _counting_place([[numbers[path] for path in files if numbers[path]] for files in found.values()])
    numbered = [{numbers[path][place]: path for path in files if numbers[path]} for files in found.values()]
    shots = [Shot(number, (path, *(other.get(number) for other in numbered[1:])))
             for number, path in sorted(numbered[0].items())
             if len(numbered) == 1 or any(number in other for other in numbered[1:])]
    if not shots:
        raise InputError("no left and right image carry the same number in their names "
                         f"(such as {found['left'][0].name} and {found['right'][0].name})")
    partnered = [path for shot in shots for path in shot.files if path is not None]
    if len(set(partnered)) < len(partnered):
        again = next(path for path in partnered if partnered.count(path) > 1)
        raise InputError(f"--left and --right both find {again}; give each side its own pattern")
    return shots, {path.name: f"no partner with number {of[place]}" if of else "no number in its name"
                   for path, of in numbers.items() if path not in partnered}


def sides(count: int) -> tuple[str, ...]:
    """What the cameras are called: left, right, camera3, ..."""
    return ("left", "right", *(f"camera{n}" for n in range(3, count + 1)))[:count]


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


def detect(shots: Iterable[Shot], board: Board) -> Views:
    """Finds the board in every shot. Raises ImageError for images of another size, InputError for too few views."""
    size: tuple[int, int] | None = None
    used: list[View] = []
    rejected: dict[str, str] = {}
    for shot in shots:
        seen: list[Detection | None] = []
        for path in shot.files:
            image = None if path is None else read(path)
            if path is not None and image is not None:
                size = size or (image.shape[1], image.shape[0])
                _same_size(path, image, size)
            found = Refusal("cannot be read as an image") if image is None else sight.find(image, board)
            if path is not None and seen and seen[0] is not None and isinstance(found, Detection):
                found = sight.align(seen[0], found)
            if path is not None and isinstance(found, Refusal):
                rejected[path.name] = found.reason
            seen.append(found if isinstance(found, Detection) else None)
        used.append(view(shot, board, seen))
    sharp, blurred = screen(used)
    rejected |= blurred
    if size is None or len(sharp) < FEWEST_VIEWS:
        raise InputError(f"the board was found in {len(sharp)} pairs, {FEWEST_VIEWS} are needed{_why(rejected)}")
    return Views(size, sharp, rejected)


def view(shot: Shot, board: Board, seen: Sequence[Detection | None]) -> View:
    """One moment's detections, one of each camera and numbered alike, as arrays over all of the board's points."""
    corners = []
    for found in seen:
        px = np.full((board.columns * board.rows, 2), np.nan, np.float32)
        if found is not None:
            px[found.ids] = found.corners_px
        corners.append(px)
    return View(shot.number, tuple("" if path is None else path.name for path in shot.files), tuple(corners),
                tuple(np.nan if found is None else found.quality.blur_px for found in seen), tuple(seen))


def read(path: Path) -> UInt8[np.ndarray, "h w"] | None:
    """An image file in grey, as its pixels lie; None when it is none."""
    return cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)


def _same_size(path: Path, image: UInt8[np.ndarray, "h w"], size: tuple[int, int]) -> None:
    this_size = (image.shape[1], image.shape[0])
    if this_size != size:
        raise ImageError(f"{path}: {this_size[0]}x{this_size[1]} px, but the images before it are "
                         f"{size[0]}x{size[1]}: all must come from cameras with the same settings")


def screen(views: Sequence[View]) -> tuple[tuple[View, ...], dict[str, str]]:
    """The views that the first and one more camera see sharply and wholly enough, and the reason of each image that is not."""
    typical = [np.nanmedian(blurs) if np.isfinite(blurs).any() else np.inf
               for blurs in np.array([view.blur_px for view in views]).T]
    kept, rejected = [], {}
    for view in views:
        corners = list(view.corners_px)
        for camera, (name, px, blur) in enumerate(zip(view.names, view.corners_px, view.blur_px, strict=True)):
            seen = int(np.isfinite(px).all(axis=1).sum())
            if blur > BLURRED * typical[camera]:
                rejected[name] = f"blurred: sigma of its edges is {blur:.1f} px, in the other views {typical[camera]:.1f} px"
            elif 0 < seen < FEWEST_CORNERS:
                rejected[name] = f"half seen: {seen} of {len(px)} corners"
            else:
                continue
            corners[camera] = np.full_like(px, np.nan)
        there = [bool(np.isfinite(px).any()) for px in corners]
        if there[0] and any(there[1:]):
            kept.append(replace(view, corners_px=tuple(corners)))
    return tuple(kept), rejected


def _why(rejected: dict[str, str]) -> str:
    return "".join(f"; {reason}: {', '.join(name for name, said in rejected.items() if said == reason)}"
                   for reason in dict.fromkeys(rejected.values()))
