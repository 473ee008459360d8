"""`binpick-calib bin`: where a bin stands, from points of it touched with the robot or by its rim in a pair of images."""

import re
import time
from itertools import permutations
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml
from jaxtyping import Float

from binpick import geometry, settings
from binpick import rig as rigs
from binpick.camera import backends
from binpick.cycle import CycleInput
from binpick.errors import InputError, NotApplicable
from binpick.geometry import Transform
from binpick.result import Request
from binpick.settings import Bin
from binpick.settings.recipe import Pose
from binpick_calib import robot

FITS_M = 0.005
"""A touched corner further from where the bin's size puts it belongs to another bin, or was missed."""
LEAST_SINE = 0.05
"""Corners under a smaller angle lie on a line."""


class Touched(NamedTuple):
    """Inner corners at the rim, and points of the floor inside, in the robot's base."""

    rim: Float[np.ndarray, "n 3"]
    floor: Float[np.ndarray, "m 3"]


def run(points: Path | None, size: str, unit: str, images: tuple[Path | None, ...] | None, cell: Path | None,
        number: int) -> str:
    """The `bin:` of a cell file; `images` are left, right and rig file, None for touched points. Raises InputError."""
    if (points is None) == (images is None):
        raise InputError("give --points FILE, or --locate with a pair of images")
    if images is not None:
        left, right, rig = images
        if left is None or right is None or rig is None or cell is None:
            raise InputError("--locate needs --left, --right, --rig and --cell")
        return text(located(left, right, rig, cell, number))
    assert points is not None
    if (not size) == (cell is None):
        raise InputError("give the bin's inner size by --size 0.6x0.4x0.18, or --cell, not both")
    model = Bin(number=number, inner_size_m=size_of(size), pose=Pose(frame="base")) if cell is None else \
        settings.resolve(settings.load(cell), 0, number).bin
    model = model.model_copy(update={"pose": model.pose.model_copy(update={"frame": "base"})})
    return text(placed(model, stands(read(points, unit), model.inner_size_m)))


def size_of(text: str) -> tuple[float, float, float]:
    """Length, width and height of `0.6x0.4x0.18`, metres. Raises InputError."""
    found = re.fullmatch(r"(\d*\.?\d+)x(\d*\.?\d+)x(\d*\.?\d+)", text.strip().lower())
    if not found or not all(0.02 <= float(side) <= 3 for side in found.groups()):
        raise InputError(f"--size {text}: write the inner length, width and height in metres, 0.02 to 3: 0.6x0.4x0.18")
    return float(found[1]), float(found[2]), float(found[3])


def read(path: Path, unit: str = "") -> Touched:
    """The points of a table with the columns name (rim or floor), x, y and z. Raises InputError that names the line."""
    points: dict[str, list[tuple[float, ...]]] = {"rim": [], "floor": []}
    for row in robot.points(path, unit):
        if row.name.lower() not in points:
            raise InputError(f"{path}:{row.line}: {row.name!r}: name each point rim (an inner corner) or floor")
        points[row.name.lower()].append(row.position_m)
    if len(points["rim"]) not in (3, 4) or not points["floor"]:
        raise InputError(f"{path}: {len(points['rim'])} points of the rim and {len(points['floor'])} of the floor; touch "
                         "three or four inner corners of the rim, and one point of the floor or more")
    return Touched(np.array(points["rim"]), np.array(points["floor"]))


def stands(touched: Touched, size_m: tuple[float, float, float]) -> Transform:
    """T_base_bin: the rim by its corners, the floor where it was touched; x of the two ways round along the base's.

    Raises InputError for points on a line, a floor above the rim, and a size that does not fit.
    """
    middle = touched.rim.mean(0)
    _, spread, axes = np.linalg.svd(touched.rim - middle)
    if spread[1] < LEAST_SINE * spread[0]:
        raise InputError("the points of the rim lie on one line: touch three different corners")
    z = axes[2] * np.sign(axes[2] @ (middle - touched.floor.mean(0)) or 1.0)
    height_m = float((middle - touched.floor.mean(0)) @ z)
    if z[2] < 0:
        raise InputError(f"the floor lies {1000 * height_m:.0f} mm above the rim: check the signs of z, and which points are "
                         "named rim and floor")
    if abs(height_m - size_m[2]) > FITS_M:
        raise InputError(f"the floor lies {1000 * height_m:.1f} mm below the rim, the bin's inner height is "
                         f"{1000 * size_m[2]:.1f} mm: check both, and the unit of the points")
    T_base_rim = geometry.frame_of_axes(z, axes[0], middle)
    flat = geometry.transform(geometry.inverse(T_base_rim), touched.rim)
    length, width, _ = size_m
    corners = np.array([[x, y] for x in (-length / 2, length / 2) for y in (-width / 2, width / 2)])
    fits = [_laid(corners[list(some)], flat[:, :2]) for some in permutations(range(4), len(flat))]
    off_m = min(off for off, _ in fits)
    if off_m > FITS_M:
        raise InputError(f"the corners do not fit a bin of {1000 * length:.0f} x {1000 * width:.0f} mm, they are "
                         f"{_told(touched.rim)} apart; the best fit is off by {1000 * off_m:.1f} mm")
    found = [T_base_rim @ T for off, T in fits if off < off_m + 1e-6]
    best = max(found, key=lambda T: (round(float(T[0, 0]), 6), float(T[1, 0])))
    down = geometry.translation(0.0, 0.0, -height_m)
    T_base_bin: Transform = best @ down
    return T_base_bin


def _laid(corners: Float[np.ndarray, "n 2"], seen: Float[np.ndarray, "n 2"]) -> tuple[float, Transform]:
    """The largest distance of a corner from its point, and T_rim_bin, when corners are laid onto points by turn and way."""
    a, b = corners - corners.mean(0), seen - seen.mean(0)
    angle = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    R = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    way = seen.mean(0) - R[:2, :2] @ corners.mean(0)
    off_m = float(np.linalg.norm(a @ R[:2, :2].T - b, axis=1).max())
    return off_m, geometry.make(R, np.array([*way, 0.0]))


def _told(rim: Float[np.ndarray, "n 3"]) -> str:
    apart = [np.linalg.norm(a - b) for i, a in enumerate(rim) for b in rim[i + 1:]]
    return ", ".join(f"{1000 * distance:.0f}" for distance in sorted(apart)) + " mm"


def located(left: Path, right: Path, rig: Path, cell: Path, number: int) -> Bin:
    """The bin of the cell file where its rim is seen, in the frame that the file gives it in.

    Raises NotApplicable with the cycle's code when it is not there, FrameUnavailable or FlangePoseMissing for frame base.
    """
    # depth takes half a second to import
    from binpick import pipeline

    known, _ = rigs.load(rig)
    job = settings.resolve(settings.load(cell), 0, number)
    expected = job.bin.model_copy(update={"locate": True})
    job = job.model_copy(update={"bin": expected, "recipe": job.recipe.single if len(job.recipe.lights) > 1 else job.recipe})
    cameras = backends.group(settings.FileCameras(backend="files", left=left, right=right))
    deadline_ns = time.monotonic_ns() + 10_000_000_000
    cameras.open(deadline_ns)
    try:
        pair = cameras.capture(job.recipe.lights[0], deadline_ns)
    finally:
        cameras.close()
    inputs = CycleInput(cycle_id=1, pair=pair, rig=known, job=job, request=Request(), simulated=False)
    outcome = pipeline.grasps(inputs)
    said = outcome.result.return_code
    if outcome.T_camera_bin is None or outcome.result.bin is None or outcome.result.bin.rim is None:
        raise NotApplicable(f"{said.value} {said.name}: {said.message}")
    T = outcome.T_camera_bin
    if expected.pose.frame == "base":
        assert inputs.T_base_camera is not None
        T = inputs.T_base_camera @ T
    return placed(expected, T)


def placed(model: Bin, T_parent_bin: Transform) -> Bin:
    """The bin, standing there; rounded to what a person can read: 0.01 mm."""
    quaternion = [round(float(value), 7) for value in geometry.quaternion(T_parent_bin)]
    position = [round(float(value), 5) for value in T_parent_bin[:3, 3]]
    pose = {"frame": model.pose.frame, "position_m": position, "quaternion_xyzw": quaternion}
    return Bin.model_validate(model.model_dump(exclude_none=True) | {"pose": pose})


def text(model: Bin) -> str:
    """The `bin:` of a cell file."""
    document = model.model_dump(mode="json", exclude_none=True)
    return yaml.safe_dump({"bin": document}, sort_keys=False, default_flow_style=None)
