"""The watchdog: looks at a cycle's images beside the matching, and has the last word on its code.

Rows of the production pair and the reference marks are all it reads; what they amount to over the cycles is `rigcheck.drift`'s.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

from binpick import geometry
from binpick.cycle import CycleInput, CycleResult
from binpick.data import Image, Light, Rectified, StereoPair
from binpick.errors import Code, InputError, NotApplicable
from binpick.frames import Frames
from binpick.message import BoardMessage, CalibrationMessage, CorrectionMessage, Level, MarksMessage, Verify
from binpick.result import ReturnCode
from binpick.rig import Rig
from binpick.rigcheck import board, carrier, drift, marks, rows, sight, sighting, verify
from binpick.rigcheck.carrier import CarrierCheck
from binpick.rigcheck.detection import Detection, Refusal
from binpick.rigcheck.drift import Watch
from binpick.rigcheck.guard import Guard
from binpick.rigcheck.marks import MarksCheck, Sighting
from binpick.rigcheck.rows import Rows
from binpick.rigcheck.sighting import Corners
from binpick.settings.cell import ReferenceMarks

CODES: dict[Level, Code] = {"ok": Code.OK, "warn": Code.CALIBRATION_WARNING, "fault": Code.CALIBRATION_FAULT}


@dataclass(frozen=True, slots=True)
class Look:
    """What the images of one cycle showed; None: nothing is configured, or usable, to look for."""

    rows: Rows
    sighting: Sighting | None
    marks: MarksCheck | None


def rig(inputs: CycleInput) -> Rig:
    """The rig that the cycle computes with: the file's, with the correction that is in force."""
    return inputs.rig if inputs.guard is None else inputs.guard.rig(inputs.rig)


def look(inputs: CycleInput, used: Rig, shot: Rectified) -> Look | None:
    """`shot` is the cycle's first one, rectified with the rig `used`; None when nobody watches."""
    guard = inputs.guard
    if guard is None:
        return None
    if guard.marks is None:
        return Look(rows.check(shot), None, None)
    pair = _plain(inputs.pairs, inputs.lights)
    left, right = (_tags(frame.image, guard.marks) for frame in (pair.left, pair.right))
    compared = marks.compare(guard.reference, [(left, right)], used) if guard.reference and not guard.unusable else None
    return Look(rows.check(shot), (left, right), compared)


def judged(inputs: CycleInput, used: Rig, cycle: CycleResult, seen: Look | None) -> CycleResult:
    """The cycle with what the watchdog says of the calibration, which may take its poses away, and what it leaves.

    Raises InputError for a verification that cannot be done as asked.
    """
    if inputs.guard is None or seen is None:
        return cycle
    if inputs.verify is not None:
        return _verified(inputs, used, cycle, seen, inputs.guard, inputs.verify)
    after = _after(inputs, seen, stands=_carrier(inputs, cycle))
    message = _message(inputs, seen, after)
    result = cycle.result.model_copy(update={"calibration": message})
    if message.level == "fault":
        result = result.model_copy(update={"return_code": ReturnCode.of(Code.CALIBRATION_FAULT, message.sentence),
                                           "grasps": (), "parts": ()})
        return replace(cycle, result=result, guard=after[1], verified=(), memory=None)
    if message.level == "warn" and result.return_code.code.carries_poses:
        was = result.return_code
        found = f" {was.message}" if was.code is not Code.OK else ""
        result = result.model_copy(update={"return_code": ReturnCode.of(Code.CALIBRATION_WARNING, message.sentence + found)})
    return replace(cycle, result=result, guard=after[1])


def _verified(inputs: CycleInput, used: Rig, cycle: CycleResult, seen: Look, guard: Guard, wanted: Verify) -> CycleResult:
    """A cycle that looks at the calibration alone: its code is the verdict, and nobody looked into the bin.

    What it sees counts for as much as makes a verdict: who asks now wants to know of now.
    """
    if wanted.store_marks:
        if guard.marks is None or seen.sighting is None:
            raise InputError("there are no marks to store: configure reference_marks in the cell file")
        if guard.correction is not None:
            raise InputError("marks are stored with a calibration that is trusted, and this one is corrected: calibrate first")
        reference = marks.store([seen.sighting], used, guard.marks.family)
        inputs = replace(inputs, guard=guard.model_copy(update={"reference": reference}))
        seen = replace(seen, marks=marks.compare(reference, [seen.sighting], used))
    if not wanted.board and seen.rows.reason and (seen.marks is None or seen.marks.reason):
        raise NotApplicable(f"this pair tells nothing of the calibration: {seen.rows.reason}")
    after = _after(inputs, seen, drift.FEWEST)
    message = _message(inputs, seen, after)
    if wanted.board:
        message = _with_board(message, _board(inputs, used, wanted.board))
    code = CODES[message.level]
    result = cycle.result.model_copy(update={"calibration": message, "return_code": ReturnCode.of(code, message.sentence),
                                             "bin": None, "funnel": None})
    return CycleResult(result, guard=after[1])


def _plain(pairs: tuple[StereoPair, ...], lights: Iterable[Light]) -> StereoPair:
    """The first shot without the pattern, which may fall on the marks; else the first."""
    return next((pair for pair, light in zip(pairs, lights, strict=True) if not light.projector), pairs[0])


def _tags(image: Image, wanted: ReferenceMarks) -> dict[int, Corners]:
    """The marks in an image that are to be looked for."""
    seen = sighting.detect(image, wanted.family)
    return {number: corners for number, corners in seen.items() if number in wanted.ids} if wanted.ids else seen


def _carrier(inputs: CycleInput, cycle: CycleResult) -> CarrierCheck | None:
    """Where a bin that was located stands; None without one."""
    if not inputs.job.bin.locate or cycle.T_camera_bin is None:
        return None
    return carrier.check(geometry.inverse(Frames.of(inputs).T_camera_bin) @ cycle.T_camera_bin)


def _after(inputs: CycleInput, seen: Look, times: int = 1, stands: CarrierCheck | None = None) -> tuple[Watch, Guard]:
    """What the look makes of the drift when it counts so many times, and the guard that the next cycle starts from."""
    guard = inputs.guard
    assert guard is not None
    watch = guard.watch
    for _ in range(times):
        watch = drift.step(watch, seen.rows, seen.marks, guard.limits, stands)
    return watch, guard.seen(watch, inputs.rig)


def _message(inputs: CycleInput, seen: Look, after: tuple[Watch, Guard]) -> CalibrationMessage:
    watch, guard = after
    before = inputs.guard
    assert before is not None
    applied = before.correction
    level, sentence = _verdict(watch, before, guard)
    return CalibrationMessage(
        level=level, sentence=sentence, reason=seen.rows.reason, row_px=_known(seen.rows.row_px),
        row_sigma_px=_known(seen.rows.sigma_px), points=seen.rows.points, off_px=_known(watch.off_px),
        change_px=_known(watch.trend_px), bin_m=_known(watch.bin_m), marks=_marks(seen.marks),
        correction=None if applied is None else CorrectionMessage(
            rotation_rad=applied.rotation_rad, rig_sha256=applied.corrected_sha256, number=applied.number))


def _verdict(watch: Watch, before: Guard, after: Guard) -> tuple[Level, str]:
    """Of this cycle, computed with the correction before it: what is corrected from the next one on is not yet well."""
    level = before.model_copy(update={"watch": watch}).level
    if after.correction is None:
        return level, watch.sentence
    turned = ", ".join(f"{name} {1000 * angle:+.2f}" for name, angle in
                       zip(("pitch", "yaw", "roll"), after.correction.rotation_rad, strict=True))
    since = "from the next cycle on" if after.correction != before.correction else "in this result"
    return level, (f"{watch.sentence} The second camera's turn is taken out of depth {since} ({turned} mrad): calibrate again "
                   "when you can.")


def _marks(check: MarksCheck | None) -> MarksMessage | None:
    if check is None:
        return None
    pitch, yaw, roll = map(_known, check.rotation_rad)
    shift_m, turn_rad = (_known(math.hypot(*each)) for each in (check.shift_m, check.turn_rad))
    return MarksMessage(seen=check.marks, missing=check.missing, reason=check.reason, shift_m=shift_m, turn_rad=turn_rad,
                        pitch_rad=pitch, yaw_rad=yaw, roll_rad=roll, depth_m=_known(check.depth_m))


def _board(inputs: CycleInput, used: Rig, spec: str) -> BoardMessage:
    """The verdict by a board in view. Raises InputError for a board that both cameras do not see: that is no verdict."""
    wanted = board.parse(spec)
    found: list[Detection] = []
    for name, frame in (("left", inputs.pair.left), ("right", inputs.pair.right)):
        seen = sight.find(frame.image, wanted)
        if isinstance(seen, Refusal):
            raise InputError(f"the board {spec} is not seen by the {name} camera: {seen.reason}")
        found.append(seen)
    verdict = verify.verify(found, used)
    return BoardMessage(board=verdict.gauge, points=verdict.points, level=verdict.level, sentence=verdict.sentence,
                        row_px=_known(verdict.rows.row_px), scale_permille=_known(verdict.scale_permille),
                        planarity_m=_known(verdict.planarity_m))


def _with_board(message: CalibrationMessage, found: BoardMessage) -> CalibrationMessage:
    """The worse of both verdicts, in both sentences."""
    worse = max(message.level, found.level, key=list(CODES).index)
    return message.model_copy(update={"board": found, "level": worse, "sentence": f"{message.sentence} {found.sentence}"})


def _known(value: float) -> float | None:
    """A message has no NaN."""
    return value if math.isfinite(value) else None
