"""Samples of a board on disk: a folder each, with the images, the flange pose and what was seen; there whole or not at all."""

import logging
import math
import shutil
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import ValidationError

from binpick.calibration import Sample
from binpick.cell import durable
from binpick.errors import InputError, NotApplicable, NotReady
from binpick.message import Wire
from binpick.rigcheck import board as boards
from binpick.rigcheck.detection import Detection, Quality

FOLDER, NAME = "samples", "sample.json"
MOST = 60
"""More say nothing new, and a pair of full images takes about 4 MB."""

log = logging.getLogger(__name__)


class Seen(Wire):
    """A detection in a file."""

    image_size_px: tuple[int, int]
    ids: tuple[int, ...]
    corners_px: tuple[tuple[float, float], ...]
    blur_px: float | None
    contrast: float
    spacing_px: float
    tilt_rad: float
    cell: tuple[int, int]
    spread: float
    residual_px: float

    @classmethod
    def of(cls, detection: Detection) -> "Seen":
        """All but the board."""
        quality = detection.quality
        return cls(image_size_px=detection.image_size_px, ids=tuple(map(int, detection.ids)),
                   corners_px=tuple((float(x), float(y)) for x, y in detection.corners_px),
                   blur_px=quality.blur_px if math.isfinite(quality.blur_px) else None, contrast=quality.contrast,
                   spacing_px=quality.spacing_px, tilt_rad=quality.tilt_rad, cell=quality.cell, spread=quality.spread,
                   residual_px=quality.residual_px)

    def detection(self, board: boards.Board) -> Detection:
        """As it was."""
        blur_px = math.nan if self.blur_px is None else self.blur_px
        quality = Quality(blur_px, self.contrast, self.spacing_px, self.tilt_rad, self.cell, self.spread, self.residual_px)
        corners_px = np.array(self.corners_px, np.float32)
        return Detection(board, self.image_size_px, np.array(self.ids, np.int32), corners_px, quality)


class SampleFile(Wire):
    """sample.json."""

    format: Literal["binpick-sample"] = "binpick-sample"
    version: Literal[1] = 1
    sample: Sample
    seen: tuple[Seen | None, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Stored:
    """A sample, and what each camera saw, in the rig's order."""

    sample: Sample
    seen: tuple[Detection | None, ...]


class SampleStore:
    """The samples below a folder, for any thread; nothing is written before the first one."""

    def __init__(self, directory: Path) -> None:
        """Reads what is there, and clears away what a kill left unfinished. Raises InputError when that cannot be done."""
        self._folder = directory / FOLDER
        self._lock = threading.Lock()
        self._stored: dict[int, Stored] = {}
        self.damaged: dict[str, str] = {}
        try:
            for folder in sorted(self._folder.iterdir()) if self._folder.exists() else ():
                self._load(folder)
        except OSError as error:
            raise InputError(f"{self._folder}: cannot be read: {error.strerror}: see calibration.directory") from error

    def _load(self, folder: Path) -> None:
        if folder.name.startswith("."):
            shutil.rmtree(folder, ignore_errors=True)
            return
        try:
            file = SampleFile.model_validate_json((folder / NAME).read_bytes())
            board = boards.parse(file.sample.board)
            seen = tuple(None if one is None else one.detection(board) for one in file.seen)
            if folder.name != _name(file.sample.id):
                raise InputError(f"it is sample {file.sample.id}")
        except (OSError, ValidationError, InputError) as error:
            self.damaged[folder.name] = str(error).split("\n", maxsplit=1)[0]
            log.error("sample %s cannot be read and is left out: %s", folder, error)
            return
        self._stored[file.sample.id] = Stored(file.sample, seen)

    @property
    def all(self) -> tuple[Stored, ...]:
        """The oldest first."""
        return tuple(stored for _, stored in sorted(self._stored.items()))

    @property
    def next_id(self) -> int:
        """The number of the next one; numbers of damaged ones are not used again."""
        return max([*self._stored, *(int(name) for name in self.damaged if name.isdecimal()), 0]) + 1

    def admit(self) -> None:
        """Raises NotApplicable when there is no room for another one."""
        if len(self._stored) + len(self.damaged) >= MOST:
            raise NotApplicable(f"{MOST} samples are stored, and no more are kept: calibrate from them, or delete some "
                                "(DELETE /v1/calibration/samples)")

    def add(self, stored: Stored, images: Mapping[str, bytes]) -> None:
        """Keeps a sample with its images by file name. Raises NotReady when the disk refuses; nothing is kept then."""
        seen = tuple(None if one is None else Seen.of(one) for one in stored.seen)
        body = SampleFile(sample=stored.sample, seen=seen).model_dump_json(indent=1).encode() + b"\n"
        folder = self._folder / _name(stored.sample.id)
        partial = folder.with_name(f".{folder.name}")
        with self._lock:
            try:
                shutil.rmtree(partial, ignore_errors=True)
                partial.mkdir(parents=True)
                for name, content in {**images, NAME: body}.items():
                    durable.write(partial / name, content)
                durable.settle(partial)
                partial.replace(folder)
                durable.settle(self._folder)
            except OSError as error:
                shutil.rmtree(partial, ignore_errors=True)
                raise NotReady(f"{folder}: cannot be written: {error.strerror}: see calibration.directory in the cell "
                               "file") from error
            self._stored[stored.sample.id] = stored

    def image(self, number: int, camera: str) -> bytes | None:
        """A camera's picture of a sample as PNG; None when there is none."""
        stored = self._stored.get(number)
        if stored is None or camera not in {sighting.camera for sighting in stored.sample.sightings}:
            return None
        try:
            return (self._folder / _name(number) / f"{camera}.png").read_bytes()
        except OSError:      # deleted at this moment, or by hand
            return None

    def remove(self, number: int | None = None) -> None:
        """Forgets one sample, or all, damaged ones included. Raises NotApplicable for an unknown one, NotReady."""
        if number is not None and number not in self._stored:
            raise NotApplicable(f"there is no sample {number}")
        with self._lock:
            names = [_name(number)] if number is not None else [*map(_name, self._stored), *self.damaged]
            for name in names:
                folder = self._folder / name
                gone = folder.with_name(f".{name}")
                try:
                    folder.replace(gone)
                except FileNotFoundError:
                    pass
                except OSError as error:
                    raise NotReady(f"{folder}: cannot be deleted: {error.strerror}") from error
                shutil.rmtree(gone, ignore_errors=True)
                self.damaged.pop(name, None)
                self._stored = {kept: stored for kept, stored in self._stored.items() if _name(kept) != name}


def _name(number: int) -> str:
    return f"{number:04d}"
