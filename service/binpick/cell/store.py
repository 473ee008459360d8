"""The memories of all bins in one file that survives the process: written whole beside itself, then put in its place."""

import logging
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from pydantic import ValidationError

from binpick.cell import durable, machine
from binpick.cell.board import Board
from binpick.cell.machine import State
from binpick.errors import InputError
from binpick.message import Wire
from binpick.outcomes import NO_MEMORY, Memory

NAME = "memory.json"
DAMAGED = "memory.damaged.json"
"""Where a file that cannot be read is set aside; the last one stays."""

log = logging.getLogger(__name__)


class MemoryFile(Wire):
    """memory.json: what is remembered of each bin, by its number; but for what was seen last: a restart breaks that chain."""

    format: Literal["binpick-memory"] = "binpick-memory"
    version: Literal[1] = 1
    bins: dict[int, Memory]


class Store:
    """The file below a folder."""

    def __init__(self, directory: Path) -> None:
        """Makes the folder. Raises InputError when that cannot be done."""
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"memory.directory {directory}: cannot be made: {error.strerror}") from error
        self._directory = directory

    def load(self) -> tuple[dict[int, Memory], str]:
        """The memories by bin number, and what is wrong with the file; a damaged one is set aside, and nothing is remembered.

        Raises InputError when it cannot be read at all.
        """
        path = self._directory / NAME
        try:
            if not path.exists():
                return {}, ""
            try:
                return MemoryFile.model_validate_json(path.read_bytes()).bins, ""
            except ValidationError as error:
                path.replace(self._directory / DAMAGED)
                return {}, (f"memory: {path} is damaged ({error.errors()[0]['msg']}) and was set aside as {DAMAGED}: earlier "
                            "failures are forgotten")
        except OSError as error:
            raise InputError(f"memory.directory: {path} cannot be read: {error.strerror}") from error

    def save(self, memories: Mapping[int, Memory]) -> None:
        """Replaces the file; whenever process or machine die, the old or the new one is there whole. Raises OSError."""
        file = MemoryFile(bins=lasting(memories))
        durable.replace(self._directory / NAME, file.model_dump_json(indent=1).encode())


def lasting(memories: Mapping[int, Memory]) -> dict[int, Memory]:
    """What of the memories is kept."""
    kept = {number: memory.model_copy(update={"look": None}) for number, memory in sorted(memories.items())}
    return {number: memory for number, memory in kept.items() if memory != NO_MEMORY}


def thread(store: Store, board: Board) -> threading.Thread:
    """The thread that saves what changes, not yet started: a slow disk delays neither a cycle nor an answer."""
    return threading.Thread(target=_keep, args=(store, board), name="binpick-memory", daemon=True)


def _keep(store: Store, board: Board) -> None:
    """Until the cell stops, and then once more if there is something new."""
    kept = board.state.memories

    def news(state: State) -> bool:
        return state.stopping or state.memories is not kept

    while True:
        memories = board.wait(news, threading.TIMEOUT_MAX).memories
        if memories is kept:
            return
        if lasting(memories) != lasting(kept):
            try:
                store.save(memories)
            except OSError as error:
                log.error("the memory of outcomes is not on disk: %s", error)
                board.step(machine.alarm, f"memory: it cannot be written and will not survive a restart: {error.strerror}")
        kept = memories
