"""Calibration in the running cell: samples of a board, the hand-eye made of them, and which version of the rig is in use."""

import logging
import math
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial

import cv2

from binpick import settings
from binpick.calibration import (
    REACH_M,
    CalibrationState,
    HandEyeAnswer,
    HandEyeRequest,
    HandEyeResidual,
    Sample,
    SampleAnswer,
    SampleRequest,
    Samples,
    Sighting,
    cameras_sha256,
    message,
    transform,
)
from binpick.camera.base import Clock
from binpick.cell import installation, machine, progress
from binpick.cell.board import Board
from binpick.cell.rigs import Rigs
from binpick.cell.samples import MOST, SampleStore, Stored
from binpick.cycle import CycleInput
from binpick.data import Image
from binpick.errors import BinpickError, CycleRefused, ImageError, InputError
from binpick.result import Owner, Request, Source
from binpick.rig import Rig
from binpick.rigcheck import board as boards
from binpick.rigcheck import handeye as solver
from binpick.rigcheck import sight
from binpick.rigcheck.detection import Detection, Refusal

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Calibration:
    """Implements publish.ports.Calibration. The worker's thread calls `keep`; all else may come from any."""

    board: Board
    cell: settings.Cell
    rigs: Rigs
    store: SampleStore
    clock: Clock
    now: Callable[[], datetime] = lambda: datetime.now(UTC)
    changing: threading.Lock = field(default_factory=threading.Lock)

    def state(self) -> CalibrationState:
        """The version in use, and those there are."""
        installed = self.board.state.installed
        active = installed.told.version
        return CalibrationState(active=self.rigs.one(active, active), note=installed.note, versions=self.rigs.told(active),
                                damaged=self.rigs.damaged, samples=len(self.store.all))

    def sample(self, request: SampleRequest, source: Source) -> int:
        """Starts to take a sample and returns the cycle's id at once."""
        try:
            if request.T_base_flange and (far_m := math.hypot(*request.T_base_flange.position_m)) > REACH_M:
                raise InputError(f"the flange would be {far_m:.0f} m from its base: positions are in metres")
            wanted = request.model_copy(update={"board": self._board_of(request)})
            self.store.admit()
            job = settings.resolve(self.cell, request.recipe)
            job = job.model_copy(update={"recipe": job.recipe.plain})
            asked = Request(recipe=request.recipe, timeout_ms=request.timeout_ms, T_base_flange=request.T_base_flange)
            timeout_ns = (request.timeout_ms or self.cell.timeout_ms) * 1_000_000
            return self.board.step(installation.sample, asked, job, self.clock(), timeout_ns, wanted, source,
                                   self.cell.control).last_id
        except CycleRefused:
            self.board.step(machine.refused)
            raise

    def _board_of(self, request: SampleRequest) -> str:
        """The board as a whole description. Raises InputError."""
        named = request.board or self.cell.calibration.board or self.board.state.installed.rig.board
        if not named:
            raise InputError("no board is named: give `board` (charuco:9x6:0.025), or set calibration.board in the cell file")
        return str(boards.parse(named))

    def keep(self, wanted: SampleRequest, inputs: CycleInput, proceed: Callable[[], None]) -> SampleAnswer:
        """Looks for the board and stores the sample. `proceed` may raise in between to end it; nothing is stored then.

        Raises ImageError for images that do not belong to the rig, NotReady when the disk refuses.
        """
        rig, pair = inputs.rig, inputs.pair
        frames, size = pair.frames[:len(rig.cameras)], rig.image_size_px
        for frame in frames:
            if frame.image.shape != size[::-1]:
                raise ImageError(f"camera {frame.camera} gives {frame.image.shape[1]}x{frame.image.shape[0]} pixels and the "
                                 f"rig was calibrated with {size[0]}x{size[1]}")
        proceed()
        found = _look(tuple(frame.image for frame in frames), boards.parse(wanted.board))
        seen = tuple(one if isinstance(one, Detection) else None for one in found)
        names = tuple(frame.camera for frame in frames)
        useful, reason = progress.coverage(self._of(rig), names).useful(seen)
        proceed()
        with self.changing:
            sample = Sample(
                id=self.store.next_id, captured_at=pair.captured_at, board=wanted.board, simulated=inputs.simulated,
                rig_sha256=rig.sha256, cameras_sha256=cameras_sha256(rig), T_base_flange=wanted.T_base_flange,
                sightings=tuple(map(_sighting, names, found)), useful=useful, reason=reason)
            self.store.add(Stored(sample, seen), {f"{frame.camera}.png": _png(frame.image) for frame in frames})
        log.info("sample %d: %d of %d cameras see the board, %s", sample.id, sample.found, len(names), reason)
        return SampleAnswer(sample=sample, progress=progress.judge(self._of(rig), names))

    def samples(self) -> Samples:
        """All of them, and what is missing."""
        stored = self.store.all
        rig = self.board.state.installed.rig
        fitting = self._of(rig)
        names = [sighting.camera for sighting in fitting[-1].sample.sightings] if fitting else [c.name for c in rig.cameras]
        return Samples(samples=tuple(one.sample for one in stored), most=MOST, damaged=self.store.damaged,
                       progress=progress.judge(fitting, names))

    def image(self, sample: int, camera: str) -> bytes | None:
        """A camera's picture as PNG, or None."""
        return self.store.image(sample, camera)

    def delete(self, sample: int | None = None) -> None:
        """Forgets one sample, or all."""
        with self.changing:
            self.store.remove(sample)

    def handeye(self, request: HandEyeRequest) -> HandEyeAnswer:
        """A new version of the rig in use with the hand-eye of the samples; it is stored, not activated."""
        rig = self.board.state.installed.rig
        used = self._fit(rig)
        solved = solver.solve(used, rig, request.mounting, request.z_m)
        now = self.now().isoformat(timespec="seconds")
        number = self.rigs.add(solver.mounted(rig, solved, now))
        log.info("hand-eye of %d samples: version %d of the rig, rms %.2f mm", len(used), number, 1000 * solved.rms_m)
        return HandEyeAnswer(
            version=self.rigs.one(number, self.board.state.installed.told.version),
            T_carrier_board=message(solved.T_carrier_board), rms_m=solved.rms_m, rms_rad=solved.rms_rad, rms_px=solved.rms_px,
            sigma_m=solved.sigma_m, sigma_rad=solved.sigma_rad,
            residuals={name: HandEyeResidual(m=one.m, rad=one.rad, px=one.px) for name, one in solved.residuals.items()},
            outliers=solved.outliers)

    def _fit(self, rig: Rig) -> list[solver.Sample]:
        """The samples that a hand-eye calibration of this rig may use. Raises InputError when they do not belong together."""
        usable = [one for one in self.store.all if one.sample.T_base_flange is not None and any(one.seen)]
        if not usable:
            raise InputError("there is no sample with a flange pose in which a camera saw the board: take some first")
        strange = [one.sample.id for one in usable if one.sample.cameras_sha256 != cameras_sha256(rig)]
        if strange:
            raise InputError(f"samples {_list(strange)} were taken when the cameras were calibrated otherwise than in the "
                             "version in use: delete them, or activate the version that they were taken with")
        kinds = {(one.sample.board, one.sample.simulated) for one in usable}
        if len(kinds) > 1:
            told = "; ".join(f"{board}{' (simulated)' if simulated else ''}: " + _list(
                [one.sample.id for one in usable if (one.sample.board, one.sample.simulated) == (board, simulated)])
                for board, simulated in sorted(kinds))
            raise InputError(f"the samples do not show one board: {told}; delete those of the others")
        blind = (None,) * len(rig.cameras)     # a rig may have more cameras than the cell
        return [solver.Sample(str(one.sample.id), transform(one.sample.T_base_flange), (*one.seen, *blind[len(one.seen):]))
                for one in usable if one.sample.T_base_flange is not None]

    def activate(self, version: int, source: Source) -> CalibrationState:
        """From the next cycle on, and after restarts, the cell runs on this version."""
        self.rigs.version(version)
        owner: Owner = self.cell.control
        before = self.board.state.installed.told.version
        self.board.step(installation.hold, f"the rig is being changed to version {version}", source, owner)
        try:
            installed = self.rigs.activate(version)
        except BinpickError:
            self.board.step(installation.release)
            raise
        self.board.step(installation.install, installed)
        log.warning("%s activated version %d of the rig in place of %d (sha256 %s)", source, version, before,
                    installed.rig.sha256)
        return self.state()

    def _of(self, rig: Rig) -> tuple[Stored, ...]:
        """The samples taken with these cameras as they are calibrated now."""
        wanted = cameras_sha256(rig)
        return tuple(one for one in self.store.all if one.sample.cameras_sha256 == wanted)


def _look(images: tuple[Image, ...], board: boards.Board) -> tuple[Detection | Refusal, ...]:
    """What each camera sees, all numbered like the first that sees anything.

    Side by side: where there is no board, the search of a full image takes a second.
    """
    with ThreadPoolExecutor(len(images)) as searching:
        found = tuple(searching.map(partial(sight.find, board=board), images))
    first = next((one for one in found if isinstance(one, Detection)), None)
    return tuple(one if first is None or one is first or isinstance(one, Refusal) else sight.align(first, one) for one in found)


def _sighting(camera: str, found: Detection | Refusal) -> Sighting:
    if isinstance(found, Refusal):
        return Sighting(camera=camera, found=False, points=0, reason=found.reason)
    return Sighting(camera=camera, found=True, points=len(found.ids))


def _png(image: Image) -> bytes:
    return bytes(cv2.imencode(".png", image, (cv2.IMWRITE_PNG_COMPRESSION, 1))[1])


def _list(ids: list[int]) -> str:
    return ", ".join(map(str, ids))
