"""Files that are there whole, the old or the new one, whenever process or machine die."""

import os
from pathlib import Path


def replace(path: Path, body: bytes) -> None:
    """Puts a file in the place of what is there, if anything. Raises OSError."""
    partial = path.with_name(f".{path.name}")
    write(partial, body)
    partial.replace(path)
    settle(path.parent)


def write(path: Path, body: bytes) -> None:
    """A file whose bytes are on disk; until they are it may be there in part. Raises OSError."""
    with path.open("wb") as opened:
        opened.write(body)
        opened.flush()
        os.fsync(opened.fileno())


def settle(folder: Path) -> None:
    """A folder whose names are on disk. Raises OSError."""
    opened = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)
