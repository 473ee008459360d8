"""The trend: what verifications said of a rig file, one line of JSON each in a file beside it."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from binpick.errors import InputError
from binpick.geometry import Transform
from binpick.rig import Rig
from binpick.rigcheck import board as boards


def file(rig: Path) -> Path:
    """Of rig.json: rig.verify.jsonl."""
    return rig.with_suffix(".verify.jsonl")


def add(rig: Path, entry: dict[str, Any]) -> None:
    """One verification more. Raises InputError when it cannot be written."""
    path = file(rig)
    try:
        with path.open("a", encoding="utf-8") as lines:
            lines.write(json.dumps(entry) + "\n")
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from error


def read(rig: Path) -> list[dict[str, Any]]:
    """All verifications so far, the oldest first; lines that are none, as a power cut leaves them, are passed over."""
    try:
        lines = file(rig).read_text(encoding="utf-8", errors="replace").splitlines()
    except FileNotFoundError:
        return []
    except OSError as error:
        raise InputError(f"{file(rig)}: cannot be read: {error.strerror}") from error
    entries = []
    for line in lines:
        try:
            entry = json.loads(line)
        except json.JSONDecodeError:
            continue
        if isinstance(entry, dict) and "level" in entry:
            entries.append(entry)
    return entries


def expected(entries: list[dict[str, Any]], spec: str, rig: Rig) -> Transform | None:
    """Where a board that stays was first seen with this rig file; None before that."""
    alike = {"stays": True, "gauge": str(boards.parse(spec)), "rig_sha256": rig.sha256}
    poses = (entry["pose"] for entry in entries if entry.get("pose") and alike.items() <= entry.items())
    first = next(poses, None)
    return None if first is None else np.array(first, dtype=float)
