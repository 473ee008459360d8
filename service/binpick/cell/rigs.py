"""Versions of the rig on disk: numbered files that never change, and a pointer to the one in use, replaced whole.

The cell's rig file is a version like the others: 1, or a higher one when it was replaced after versions were made. Until there
is a second one nothing is written.
"""

import re
import threading
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationError

from binpick import calibration
from binpick import rig as rig_file
from binpick.calibration import MOST_VERSIONS, Installed, RigVersion
from binpick.cell import durable
from binpick.errors import NotApplicable, NotReady, RigError, UnknownItem
from binpick.message import Wire
from binpick.rig import Rig

FOLDER, POINTER = "rigs", "active.json"
_NAME = re.compile(r"(\d{4})\.json")


class Pointer(Wire):
    """active.json: the version in use, its checksum, and the checksum that the cell's rig file had when it was chosen."""

    format: Literal["binpick-active-rig"] = "binpick-active-rig"
    version: Literal[1] = 1
    active: Annotated[int, Field(ge=1)]
    sha256: str
    file_sha256: str


class Rigs:
    """The versions below a folder, for any thread. `file` is the cell's rig file, `rig` what is in it now."""

    def __init__(self, directory: Path, file: Path, rig: Rig) -> None:
        """Reads what is there. Raises RigError when the folder cannot be read."""
        self._folder, self._file, self._rig = directory / FOLDER, file, rig
        self._lock = threading.Lock()
        self._kept: dict[int, Rig] = {}
        self.damaged: dict[int, str] = {}
        self._load()
        self._own = next((number for number, kept in self._kept.items() if kept.sha256 == rig.sha256), self._next)

    def _load(self) -> None:
        try:
            names = sorted(path.name for path in self._folder.iterdir()) if self._folder.exists() else []
        except OSError as error:
            raise RigError(f"{self._folder}: cannot be read: {error.strerror}: see calibration.directory") from error
        for found in filter(None, map(_NAME.fullmatch, names)):
            try:
                self._kept[int(found[1])] = rig_file.load(self._folder / found[0])[0]
            except RigError as error:
                self.damaged[int(found[1])] = str(error)

    @property
    def _next(self) -> int:
        return max([*self._kept, *self.damaged, 0]) + 1

    def chosen(self) -> Installed:
        """The version that the cell is to run on: the last one activated, or the rig file where that is newer.

        Raises RigError when it cannot be had, since no other one may stand in for it unnoticed.
        """
        path = self._folder / POINTER
        try:
            pointer = Pointer.model_validate_json(path.read_bytes())
        except FileNotFoundError:
            return self._installed(self._own)
        except (OSError, ValidationError) as error:
            raise RigError(f"{path}: cannot be read ({_first(error)}), so nobody knows which version of the rig was activated: "
                           f"{self._instead(path)}") from error
        if pointer.file_sha256 != self._rig.sha256:
            return self._installed(self._own, (
                f"the rig file {self._file} was replaced after version {pointer.active} was activated: it is used, as version "
                f"{self._own}; activate a version to settle it"))
        rig = self._all.get(pointer.active)
        if rig is None or rig.sha256 != pointer.sha256:
            why = self.damaged.get(pointer.active) or f"{self._path(pointer.active)}: it is not what was activated, or is gone"
            raise RigError(f"version {pointer.active} of the rig is active and cannot be used: {why}; restore it, or "
                           f"{self._instead(path)}")
        return self._installed(pointer.active)

    def version(self, number: int) -> Rig:
        """One of them. Raises UnknownItem."""
        versions = self._all
        if number not in versions:
            known = ", ".join(map(str, sorted(versions)))
            why = f" ({self.damaged[number]})" if number in self.damaged else ""
            raise UnknownItem(f"there is no version {number} of the rig{why}; there are {known}")
        return versions[number]

    def told(self, active: int) -> tuple[RigVersion, ...]:
        """All of them for the interfaces, the oldest first."""
        return tuple(self.one(number, active) for number in sorted(self._all))

    def one(self, number: int, active: int) -> RigVersion:
        """One of them for the interfaces. Raises UnknownItem."""
        file = self._file if number == self._own else self._path(number)
        return calibration.of_rig(self.version(number), number, str(file), active=number == active)

    def add(self, rig: Rig) -> int:
        """Stores a new version, which is not active, and returns its number. Raises NotReady when the disk refuses."""
        with self._lock:
            self._keep(self._own, self._rig)
            number = self._next
            self._keep(number, rig)
            return number

    def activate(self, number: int) -> Installed:
        """From the next start on, too, the cell runs on this version. Raises UnknownItem; NotReady when the disk refuses."""
        rig = self.version(number)
        with self._lock:
            self._keep(self._own, self._rig)     # so that one can go back to it when the file is replaced
            pointer = Pointer(active=number, sha256=rig.sha256, file_sha256=self._rig.sha256)
            self._write(self._folder / POINTER, pointer.model_dump_json(indent=1).encode() + b"\n")
        return self._installed(number)

    @property
    def _all(self) -> dict[int, Rig]:
        return {**self._kept, self._own: self._rig}

    def _installed(self, number: int, note: str = "") -> Installed:
        return Installed(self.version(number), self.one(number, number), note)

    def _keep(self, number: int, rig: Rig) -> None:
        if number in self._kept:
            return
        if number > MOST_VERSIONS:
            raise NotApplicable(f"{self._folder} holds {MOST_VERSIONS} versions: move it away and begin anew")
        self._write(self._path(number), rig_file.dump(rig))
        self._kept[number] = rig

    def _write(self, path: Path, body: bytes) -> None:
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            durable.replace(path, body)
        except OSError as error:
            raise NotReady(f"{path}: cannot be written: {error.strerror}: see calibration.directory in the cell "
                           "file") from error

    def _path(self, number: int) -> Path:
        return self._folder / f"{number:04d}.json"

    def _instead(self, pointer: Path) -> str:
        return f"delete {pointer} to run on the rig file {self._file}"


def _first(error: OSError | ValidationError) -> str:
    return str(error.errors()[0]["msg"]) if isinstance(error, ValidationError) else str(error.strerror)
