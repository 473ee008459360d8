"""The watchdog's logbook: reference marks, verdict and correction in one file that survives the process, replaced whole."""

import logging
from pathlib import Path

from pydantic import ValidationError

from binpick import settings
from binpick.cell import durable
from binpick.errors import InputError
from binpick.message import CalibrationMessage
from binpick.rig import Rig
from binpick.rigcheck import guard
from binpick.rigcheck.guard import Guard

NAME = "watchdog.json"
DAMAGED = "watchdog.damaged.json"

log = logging.getLogger(__name__)


class Logbook:
    """The file below a folder; without one nothing outlives the process."""

    def __init__(self, directory: Path | None) -> None:
        self._directory = directory
        self._kept: tuple[object, ...] = ()
        self.trouble = ""

    def guard(self, cell: settings.Cell, rig: Rig) -> Guard:
        """What the daemon starts from; a damaged file is set aside and `trouble` says so.

        Raises InputError when the file cannot be read at all.
        """
        return guard.started(rig, cell.watchdog, cell.reference_marks, self._load())

    def keep(self, before: Guard | None, after: Guard | None) -> None:
        """Saves a guard that says something else than before, once. Raises InputError when that cannot be done."""
        if self._directory is None or after is None or before is None or _lasting(after) in (_lasting(before), self._kept):
            return
        path = self._directory / NAME
        try:
            self._directory.mkdir(parents=True, exist_ok=True)
            durable.replace(path, after.model_dump_json(indent=1).encode())
            self._kept = _lasting(after)
        except OSError as error:
            raise InputError(f"{path}: the watchdog's findings cannot be kept: {error.strerror}; make calibration.directory a "
                             "folder that the daemon can write to") from error

    def note(self, cycle_id: int, before: Guard, after: Guard, seen: CalibrationMessage) -> str:
        """Tells in the log what has changed, and keeps it; returns why it could not, "" when it could."""
        if before.level != seen.level:
            tell = {"ok": log.info, "warn": log.warning, "fault": log.error}[seen.level]
            tell("calibration %s at cycle %d: %s", seen.level, cycle_id, seen.sentence)
        if after.correction is not None and after.correction != before.correction:
            log.warning("cycle %d: the calibration is corrected from the next cycle on: %s", cycle_id, after.correction)
        try:
            self.keep(before, after)
        except InputError as error:
            log.error("%s", error)
            return str(error)
        return ""

    def _load(self) -> Guard | None:
        if self._directory is None:
            return None
        path = self._directory / NAME
        try:
            return Guard.model_validate_json(path.read_bytes()) if path.is_file() else None
        except ValidationError as error:
            path.replace(path.with_name(DAMAGED))
            self.trouble = (f"{path} is damaged ({error.errors()[0]['msg']}) and was set aside as {DAMAGED}: verify the "
                            "calibration, and store the reference marks again")
            return None
        except OSError as error:
            raise InputError(f"{path} cannot be read: {error.strerror}") from error


def _lasting(kept: Guard) -> tuple[object, ...]:
    """What is worth a write: not the readings of each cycle."""
    return kept.rig_sha256, kept.reference, kept.correction, kept.watch.level
