"""`binpick-calib handeye`: images of a board and the robot's poses in, a rig file that knows the robot out."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from binpick import geometry
from binpick import rig as rigs
from binpick.errors import ImageError, InputError
from binpick.geometry import Transform
from binpick.poses import PoseFormat
from binpick.rig import Rig
from binpick.rigcheck import board as boards
from binpick.rigcheck import handeye, sight
from binpick.rigcheck.board import Board
from binpick.rigcheck.detection import Detection, Refusal
from binpick.rigcheck.handeye import HandEye, Mounting, Sample, mounted
from binpick_calib import robot
from binpick_calib import views as viewing
from binpick_calib.robot import Row

CLOSE_M = handeye.WORST_M / 2
"""Another reading of the angles is told when half of the samples then agree so well."""


@dataclass(frozen=True, slots=True)
class Request:
    """What is asked for; `right` is empty when only the rig's first camera was used."""

    poses: Path
    left: str
    right: str
    rig: Path
    board: str
    mounting: Mounting
    pose_format: str
    unit: str
    z_m: float | None


@dataclass(frozen=True, slots=True)
class Outcome:
    """The rig file's new content, what it rests on, what was not used and why, and words on the rig file that was read."""

    rig: Rig
    found: HandEye
    unused: dict[str, str]
    warnings: list[str]


def run(request: Request, created: str) -> Outcome:
    """Reads everything and solves. Raises InputError, ImageError, RigError with one sentence."""
    board = boards.parse(request.board)
    rig, warnings = rigs.load(request.rig)
    table = robot.read(request.poses, _pose_format(request.pose_format), request.unit)
    shots, unused = viewing.match(*(pattern for pattern in (request.left, request.right) if pattern))
    rows, unmatched = _partners(table, shots)
    unused |= unmatched
    seen: dict[int, tuple[Detection | None, ...]] = {}
    for shot in shots:
        if shot.number in rows:
            seen[shot.number] = _look(shot, rig, board, unused)
    samples = [Sample(str(number), table.T_base_flange(rows[number]), each) for number, each in seen.items()]
    try:
        found = handeye.solve(samples, rig, request.mounting, request.z_m)
    except InputError as error:
        raise InputError(f"{error}{_other_reading(table, rows, samples, rig, request.mounting)}{_told(unused)}") from error
    return Outcome(mounted(rig, found, created), found, unused | found.outliers, warnings)


def _pose_format(name: str) -> PoseFormat | None:
    if name and name not in PoseFormat.__members__:
        raise InputError(f"--pose-format {name}: it is one of {', '.join(PoseFormat.__members__)}")
    return PoseFormat[name] if name else None


def _partners(table: robot.Table, shots: Sequence[viewing.Shot]) -> tuple[dict[int, Row], dict[str, str]]:
    """The pose of each shot by its number, and the poses and images without a partner."""
    numbers = [shot.number for shot in shots]
    if not table.named:
        first = min(numbers)
        if numbers != list(range(first, first + len(table.rows))) or first > 1:
            raise InputError(f"{table.path}: {len(table.rows)} poses without names do not belong to {len(numbers)} images "
                             f"numbered {first} to {max(numbers)} one by one: give it a column `name` with the images' numbers")
        return dict(zip(numbers, table.rows, strict=True)), {}
    files = {name: shot.number for shot in shots for path in shot.files if path is not None for name in (path.name, path.stem)}
    rows: dict[int, Row] = {}
    unused = {}
    for row in table.rows:
        digits = re.findall(r"\d+", Path(row.name).stem)
        number = files.get(Path(row.name).name, int(digits[-1]) if digits else None)
        if number in rows:
            raise InputError(f"{table.path}:{row.line}: {row.name} has a pose in line {rows[number].line} already")
        if number is None or number not in numbers:
            unused[f"pose {row.name}"] = "no image of that number"
        else:
            rows[number] = row
    return rows, unused | {str(path.name): "no robot pose of that number" for shot in shots if shot.number not in rows
                           for path in shot.files if path is not None}


def _look(shot: viewing.Shot, rig: Rig, board: Board, unused: dict[str, str]) -> tuple[Detection | None, ...]:
    """What each camera sees of the board, numbered alike; what is of no use is added to `unused`."""
    seen: list[Detection | None] = []
    for path in shot.files:
        found: Detection | Refusal | None = None
        if path is not None:
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
            if image is None:
                raise ImageError(f"{path}: cannot be read as an image")
            if (image.shape[1], image.shape[0]) != rig.image_size_px:
                raise ImageError(f"{path}: {image.shape[1]}x{image.shape[0]} px, the rig's images are {rig.image_size_px[0]}x"
                                 f"{rig.image_size_px[1]}")
            found = sight.find(image, board)
            first = next((other for other in seen if other is not None), None)
            if isinstance(found, Detection) and first is not None:
                found = sight.align(first, found)
            if isinstance(found, Refusal):
                unused[path.name] = found.reason
        seen.append(found if isinstance(found, Detection) else None)
    return (*seen, *[None] * (len(rig.cameras) - len(seen)))


def _other_reading(table: robot.Table, rows: dict[int, Row], samples: Sequence[Sample], rig: Rig, mounting: Mounting) -> str:
    """Under which other reading of the angles robot and cameras would agree, as a sentence."""
    seen = [sample for sample in samples if any(sample.seen)]
    if table.pose_format is PoseFormat.quaternion_xyzw or len(seen) < handeye.FEWEST:
        return ""
    readings = {f"{pose_format.name}{how}": [table.T_base_flange(rows[int(sample.name)], pose_format, scale) for sample in seen]
                for pose_format in (PoseFormat.kuka_abc_deg, PoseFormat.fanuc_wpr_deg, PoseFormat.rotvec_rad)
                for scale, how in ((1.0, ""), (180 / np.pi, " in radians"), (np.pi / 180, " in degrees"))}
    apart_m, name = min((apart_m, name) for name, apart_m in handeye.agreement(seen, rig, mounting, readings).items())
    if apart_m > CLOSE_M:
        return ""
    return (f". Read as {name} the poses agree to {1000 * apart_m:.1f} mm: is that what they are (they were read as "
            f"{table.pose_format.name})?")


def _told(unused: dict[str, str]) -> str:
    return "".join(f"; {name}: {reason}" for name, reason in list(unused.items())[:3])


def figures(outcome: Outcome) -> dict[str, Any]:
    """What a hand-eye calibration is judged by."""
    found = outcome.found
    T = _answer(found)
    return {
        "mounting": found.mounting, "T_base_rig": _rows(found.T_base_rig), "T_flange_rig": _rows(found.T_flange_rig),
        "T_board": _rows(found.T_carrier_board), "position_m": T[:3, 3].tolist(),
        "quaternion_xyzw": geometry.quaternion(T).tolist(), "samples": len(found.residuals),
        "rms_m": found.rms_m, "rms_rad": found.rms_rad, "rms_px": found.rms_px, "sigma_m": found.sigma_m,
        "sigma_rad": found.sigma_rad, "unused": outcome.unused,
        "residuals": {name: {"m": each.m, "rad": each.rad, "px": each.px} for name, each in found.residuals.items()},
    }


def _answer(found: HandEye) -> Transform:
    T = found.T_base_rig if found.T_base_rig is not None else found.T_flange_rig
    assert T is not None
    return T


def _rows(T: Transform | None) -> list[list[float]] | None:
    return None if T is None else T.tolist()


def show(console: Console, outcome: Outcome) -> None:
    """The figures for people: each sample's residual, the whole, and what was not used."""
    found = outcome.found
    samples = Table("sample", "off mm", "off deg", "px", "", title="How far the board lies from where the robot puts it")
    for name, each in found.residuals.items():
        samples.add_row(name, f"{1000 * each.m:.2f}", f"{np.degrees(each.rad):.3f}", f"{each.px:.2f}",
                        "left out" if name in found.outliers else "")
    T = _answer(found)
    whole = Table(show_header=False, title="T_base_rig" if found.mounting == "base" else "T_flange_rig")
    whole.add_row("position", ", ".join(f"{1000 * value:.2f}" for value in T[:3, 3]) + " mm")
    whole.add_row("quaternion xyzw", ", ".join(f"{value:.6f}" for value in geometry.quaternion(T)))
    whole.add_row("samples used", str(len([name for name in found.residuals if name not in found.outliers])))
    whole.add_row("residual (rms)", f"{1000 * found.rms_m:.2f} mm, {np.degrees(found.rms_rad):.3f} degrees")
    whole.add_row("known to (1 sigma, where the board was)",
                  f"{1000 * found.sigma_m:.2f} mm, {np.degrees(found.sigma_rad):.3f} degrees")
    console.print(samples, whole)
    for name, reason in outcome.unused.items():
        console.print(f"not used: {name}: {reason}", highlight=False, markup=False, soft_wrap=True)
    if outcome.rig.quality is None:
        console.print("The rig file has no quality, so the residual is not kept in it.", highlight=False)
