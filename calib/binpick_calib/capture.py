"""Capture: takes views of a board by itself, as soon as one shows something new, until they are enough to solve from."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2

from binpick.data import Image
from binpick.errors import InputError
from binpick.rigcheck import sight
from binpick.rigcheck.board import Board
from binpick.rigcheck.coverage import Coverage
from binpick.rigcheck.detection import Detection, Refusal
from binpick_calib import views as viewing
from binpick_calib.moments import Moment

CAMERAS = ("left", "right", "third", "fourth", "fifth")


@dataclass(frozen=True, slots=True)
class Step:
    """What became of a moment: `said` is why it was taken or was not; `taken` its number in the folder, 0: not taken.

    `waits`: there was no moment yet, `said` is what it waits for.
    """

    coverage: Coverage
    said: str
    taken: int = 0
    waits: bool = False


Show = Callable[[Step], None]
Find = Callable[[Image, Board], Detection | Refusal]


def capture(moments: Iterable[Moment | str], board: Board, out: Path, coverage: Coverage, show: Show) -> Coverage:
    """Writes views as left_001.png, right_001.png, ... until there are enough, or nothing more comes.

    Numbers go on after those in the folder. `show` hears of every step. Ctrl-C ends it, too: what was taken stays. Raises
    InputError when a file cannot be written.
    """
    number = 1 + max((int(path.stem.split("_")[1]) for path in taken_before(out)), default=0)
    previous: tuple[Detection | None, ...] | None = None
    try:
        for moment in moments:
            if isinstance(moment, str):
                show(Step(coverage, moment, waits=True))
                continue
            coverage = _named(coverage, moment)
            seen, reasons = look(moment.images, board, sight.glance if moment.live else sight.find)
            before = (previous or (None,) * len(seen)) if moment.live else None
            useful, said = coverage.useful(seen, before)
            previous = seen
            if useful:
                _write(out, number, moment.images)
                coverage = coverage.add(seen)
                show(Step(coverage, said, number))
                number += 1
            else:
                moment.forget()
                show(Step(coverage, " ".join([said, *(f"({why})" for why in reasons)]) if not moment.live else said))
            if coverage.enough:
                break
    except KeyboardInterrupt:
        pass
    return coverage


def look(images: tuple[Image, ...], board: Board,
         find: Find = sight.find) -> tuple[tuple[Detection | None, ...], tuple[str, ...]]:
    """What each camera sees of the board, numbered as the first one numbers it, and why some do not."""
    with ThreadPoolExecutor(len(images)) as pool:
        found = list(pool.map(lambda image: find(image, board), images))
    first = found[0]
    if isinstance(first, Detection):
        found[1:] = [other if isinstance(other, Refusal) else sight.align(first, other) for other in found[1:]]
    return (tuple(one if isinstance(one, Detection) else None for one in found),
            tuple(dict.fromkeys(one.reason for one in found if isinstance(one, Refusal))))


def resumed(out: Path, board: Board, coverage: Coverage) -> Coverage:
    """The coverage of the views that are in the folder already: an earlier capture that was broken off."""
    for left in taken_before(out):
        files = [left.with_name(left.name.replace("left", name)) for name in CAMERAS]
        images = tuple(image for path in files if path.exists() and (image := viewing.read(path)) is not None)
        if len(images) > 1:
            coverage = replace(coverage, cameras=CAMERAS[:len(images)]).add(look(images, board)[0])
    return coverage


def taken_before(out: Path) -> list[Path]:
    """The left images of the views there."""
    return sorted(path for path in out.glob("left_*.png") if path.stem.split("_")[1].isdecimal())


def _named(coverage: Coverage, moment: Moment) -> Coverage:
    """The cameras that there are; all moments have as many."""
    if len(moment.images) == len(coverage.cameras):
        return coverage
    if coverage.views:
        raise InputError(f"{len(moment.images)} images, but the views so far have {len(coverage.cameras)}: use another folder")
    return replace(coverage, cameras=CAMERAS[:len(moment.images)])


def _write(out: Path, number: int, images: tuple[Image, ...]) -> None:
    """All images of a view, the left one last: it is what counts as a view."""
    for name, image in reversed(list(zip(CAMERAS, images, strict=False))):
        path = out / f"{name}_{number:03d}.png"
        try:
            path.write_bytes(cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes())
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror}") from error
