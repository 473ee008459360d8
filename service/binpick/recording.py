"""A recording is one folder: what a cycle read and what it answered, enough to compute the same answer again.

    left.png right.png         the raw images, lossless          rig.json   the rig as applied
    left-02.png right-02.png   of the second shot, and so on     job.json   recipe, bin and tool as applied
    input.json                 cycle, request, memory of outcomes and drift before the cycle, facts per frame
    result.json                the answer as it was published
"""

import logging
import platform
import queue
import shutil
import tempfile
import threading
import time
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal, TypeVar

import cv2
import numpy as np
from pydantic import BaseModel, ValidationError

from binpick import __version__, rig
from binpick.cycle import CycleInput
from binpick.data import Frame, Image, StereoPair, frozen
from binpick.errors import ImageError, InputError
from binpick.message import Metering, Verify, Wire
from binpick.outcomes import NO_MEMORY, Memory
from binpick.result import Request, Result
from binpick.rigcheck.guard import Guard
from binpick.settings import Job

QUEUE = 2
"""Cycles that may wait for the disk; a full-resolution one holds 5 MB per shot."""
PNG_EFFORT = 1
"""Of zlib's 9: four times faster than OpenCV's own choice for a tenth more bytes."""

log = logging.getLogger(__name__)
Model = TypeVar("Model", bound=BaseModel)


class FrameFacts(Wire):
    """A frame without its pixels; fields as in `data.Frame`."""

    camera: str
    sequence: int
    frame_id: int
    timestamp_ns: int
    triggered_ns: int
    received_ns: int
    exposure_us: float
    gain_db: float
    resends: int
    missing: int


class PairFacts(Wire):
    """A pair without its pixels; fields as in `data.StereoPair`."""

    captured_at: str
    skew_us: float
    sigma_us: float
    proof: str
    left: FrameFacts
    right: FrameFacts


class InputFile(PairFacts):
    """input.json; its own pair is the first shot."""

    format: Literal["binpick-recording"] = "binpick-recording"
    version: Literal[1] = 1
    made_with: dict[str, str]
    cycle_id: int
    request: Request
    simulated: bool
    more: tuple[PairFacts, ...] = ()
    """The shots after the first, in order."""
    memory: Memory = NO_MEMORY
    """What was remembered of the bin before the cycle."""
    metering: Metering = ""
    """What auto exposure came to."""
    guard: Guard | None = None
    """What the watchdog knew before the cycle: correction, reference marks, earlier cycles."""
    verify: Verify | None = None
    """The cycle looked at the calibration alone."""


def folder_name(inputs: CycleInput) -> str:
    """Sorts by time: 20260102T030405678Z-000012."""
    captured_at = datetime.fromisoformat(inputs.pair.captured_at).astimezone(UTC)
    return f"{captured_at:%Y%m%dT%H%M%S}{captured_at.microsecond // 1000:03d}Z-{inputs.cycle_id:06d}"


def save(folder: Path, inputs: CycleInput, result: Result) -> None:
    """Writes the folder; it appears whole or not at all. Raises InputError when it exists or cannot be written."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from error
    try:
        for name, body in _files(inputs, result).items():
            (partial / name).write_bytes(body)
        partial.chmod(0o755)
        if folder.exists():
            raise InputError(f"{folder}: exists already; a recording is never overwritten")
        partial.rename(folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def load(folder: Path) -> tuple[CycleInput, Result]:
    """The cycle of a folder. Raises InputError, ImageError, RigError that name the file."""
    facts = _parse(folder / "input.json", InputFile)
    used_rig, _ = rig.load(folder / "rig.json")
    job = _parse(folder / "job.json", Job)
    if len(job.recipe.lights) != 1 + len(facts.more):
        raise InputError(f"{folder / 'input.json'}: not a whole recording: {1 + len(facts.more)} shots, but the recipe in "
                         f"job.json has {len(job.recipe.lights)}")
    pair, *more = (_pair(folder, number, shot) for number, shot in enumerate((facts, *facts.more), start=1))
    inputs = CycleInput(facts.cycle_id, pair, used_rig, job, facts.request, facts.simulated, tuple(more),
                        facts.memory, facts.metering, facts.guard, facts.verify)
    return inputs, _parse(folder / "result.json", Result)


def _files(inputs: CycleInput, result: Result) -> dict[str, bytes]:
    facts = InputFile(
        made_with={"binpick": __version__, "opencv": cv2.__version__, "numpy": np.__version__, "machine": platform.machine()},
        cycle_id=inputs.cycle_id, request=inputs.request, simulated=inputs.simulated, **dict(_pair_facts(inputs.pair)),
        more=tuple(map(_pair_facts, inputs.more)), memory=inputs.memory, metering=inputs.metering,
        guard=inputs.guard, verify=inputs.verify)
    absent = {name for name in ("more", "memory", "metering", "guard", "verify")
              if getattr(inputs, name) in ((), NO_MEMORY, "", None)}
    images = {_name(side, number): _png(frame.image) for number, pair in enumerate(inputs.pairs, start=1)
              for side, frame in (("left", pair.left), ("right", pair.right))}
    return images | {
        "input.json": facts.model_dump_json(indent=1, exclude=absent).encode(),
        "rig.json": rig.dump(inputs.rig), "job.json": inputs.job.model_dump_json(indent=1).encode(),
        "result.json": result.json_bytes(),
    }


def _name(side: str, number: int) -> str:
    """The image of a shot, counted from 1."""
    return f"{side}.png" if number == 1 else f"{side}-{number:02d}.png"


def _pair_facts(pair: StereoPair) -> PairFacts:
    return PairFacts(captured_at=pair.captured_at, skew_us=pair.skew_us, sigma_us=pair.sigma_us, proof=pair.proof,
                     left=_facts(pair.left), right=_facts(pair.right))


def _facts(frame: Frame) -> FrameFacts:
    return FrameFacts(**{name: getattr(frame, name) for name in FrameFacts.model_fields})


def _pair(folder: Path, number: int, facts: PairFacts) -> StereoPair:
    return StereoPair(left=_frame(folder / _name("left", number), facts.left),
                      right=_frame(folder / _name("right", number), facts.right),
                      captured_at=facts.captured_at, skew_us=facts.skew_us, sigma_us=facts.sigma_us, proof=facts.proof)


def _frame(path: Path, facts: FrameFacts) -> Frame:
    image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED) if path.is_file() else None
    if image is None or image.ndim != 2 or image.dtype != np.uint8:
        raise ImageError(f"{path}: missing, or not an 8-bit grey PNG")
    return Frame(image=frozen(image), **facts.model_dump())


def _png(image: Image) -> bytes:
    return cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, PNG_EFFORT])[1].tobytes()


def _parse(path: Path, model: type[Model]) -> Model:
    try:
        return model.model_validate_json(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{path}: not a recording of this version: {where}: {first['msg']}") from error


@dataclass(frozen=True, slots=True)
class RecorderStatus:
    """Counts since the start; `trouble` is why the latest cycle is not on disk, "" when it is."""

    saved: int = 0
    dropped: int = 0
    failed: int = 0
    trouble: str = ""


class Recorder:
    """Saves cycles below a directory in its own thread; a disk too slow loses recordings, never a cycle."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._queue: queue.Queue[tuple[CycleInput, Result] | None] = queue.Queue(QUEUE)
        self._lock = threading.Lock()
        self._status = RecorderStatus()
        self._thread = threading.Thread(target=self._work, name="binpick-recorder", daemon=True)

    def start(self) -> None:
        """Starts the thread. Raises InputError when the directory cannot be made."""
        try:
            self._directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"recording.directory {self._directory}: cannot be made: {error.strerror}") from error
        self._thread.start()

    def offer(self, inputs: CycleInput, result: Result) -> None:
        """Takes a cycle if there is room, else drops and counts it; never waits."""
        try:
            self._queue.put_nowait((inputs, result))
        except queue.Full:
            self._note(dropped=1, trouble="recordings are dropped: the disk is slower than the cycles")
            log.warning("cycle %d is not recorded: the disk is too slow", inputs.cycle_id)

    def status(self) -> RecorderStatus:
        """The counts now."""
        return self._status

    def close(self, limit_s: float) -> bool:
        """Lets the queue run empty within the limit; False: what was left is abandoned."""
        deadline = time.monotonic() + limit_s
        try:
            self._queue.put(None, timeout=limit_s)
        except queue.Full:
            return False
        self._thread.join(max(0.0, deadline - time.monotonic()))
        return not self._thread.is_alive()

    def _work(self) -> None:
        while (item := self._queue.get()) is not None:
            inputs, result = item
            try:
                save(self._directory / folder_name(inputs), inputs, result)
                self._note(saved=1)
            except InputError as error:
                self._note(failed=1, trouble=str(error))
                log.error("cycle %d is not recorded: %s", inputs.cycle_id, error)

    def _note(self, *, saved: int = 0, dropped: int = 0, failed: int = 0, trouble: str = "") -> None:
        with self._lock:
            now = self._status
            self._status = replace(now, saved=now.saved + saved, dropped=now.dropped + dropped, failed=now.failed + failed,
                                   trouble=trouble)
