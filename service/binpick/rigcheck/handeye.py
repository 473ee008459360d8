"""Hand-eye: where the rig stands in the robot's base or rides on its flange, from robot poses and views of one board."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from binpick import geometry
from binpick.errors import InputError
from binpick.geometry import Transform
from binpick.rig import Rig
from binpick.rigcheck import loop, places, spread
from binpick.rigcheck.adjustment import Adjusted, Loop, View, adjusted, apart, corners
from binpick.rigcheck.board import Board
from binpick.rigcheck.detection import Detection

Mounting = Literal["base", "flange"]
"""Where the rig is mounted: on the base (the board rides on the flange) or on the flange (the board stands in the cell)."""
FEWEST = 5
"""Samples: of four, three agree with anything that the fourth says."""
AGREEING = 0.6
"""Share of the samples that must agree."""
WORST_M = 0.010
"""Where robot and cameras disagree by more than this (rms), no grasp would be where it is said to be."""
DOUBTFUL_M = 0.001
"""The wrong mounting may agree to some millimetres, where the flange turned little: beyond this the other one is tried."""
OUTLYING, PRECISE_M = 3.0, 0.0002
"""A sample is left out beyond so many times the median distance, which counts as no less than this: robots repeat to 0.1 mm."""
ROUNDS = 10


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """One stand of the robot: its flange in its base, and what each camera of the rig, in its order, saw of the board."""

    name: str
    T_base_flange: Transform
    seen: tuple[Detection | None, ...]


@dataclass(frozen=True, slots=True)
class Residual:
    """How far a sample's board, as seen, lies from where the robot and the solution put it.

    `m`: distance of the board's middle; `rad`: angle; `px`: rms distance of its points in the images.
    """

    m: float
    rad: float
    px: float


@dataclass(frozen=True, slots=True, eq=False)
class HandEye:
    """The solution. Of `T_base_rig` and `T_flange_rig` one is given, the one of the mounting; the other is None.

    `T_carrier_board`: the board on what carries it: on the flange for a rig on the base, else in the base. `rms_m`, `rms_rad`
    and `rms_px` are of the samples used. `sigma_m`, `sigma_rad`: one deviation of the place of what lies where the boards were,
    and of its turn, by the scatter of the samples: small residuals do not tell that the samples were too much alike.
    `residuals` are of all samples in which the board was seen, by name; `outliers` say which were left out, and why.
    """

    mounting: Mounting
    T_base_rig: Transform | None
    T_flange_rig: Transform | None
    T_carrier_board: Transform
    rms_m: float
    rms_rad: float
    rms_px: float
    sigma_m: float
    sigma_rad: float
    residuals: dict[str, Residual]
    outliers: dict[str, str]


@dataclass(frozen=True, slots=True, eq=False)
class _Case:
    """What all samples have in common."""

    rig: Rig
    board: Board
    mounting: Mounting
    z_m: float | None

    @property
    def solver(self) -> loop.Solver:
        return loop.free if self.z_m is None else loop.upright

    def closed(self, views: Sequence[View]) -> Loop:
        """The closed form's answer; raised to the given height where it leaves the height open."""
        mounts, boards = [view.T_carrier_mount for view in views], [view.T_rig_board for view in views]
        T_mount_rig = loop.best(mounts, boards, self.solver)
        if T_mount_rig is None:
            raise InputError("no transform fits the samples: check the robot's poses")
        if self.z_m is not None:
            axis = loop.spread_rad(mounts)[1][0]
            lift = (self.z_m - loop.middle(mounts, T_mount_rig, boards)[2, 3]) / float(np.mean([(T[:3, :3] @ axis)[2]
                                                                                               for T in mounts]))
            T_mount_rig = geometry.make(T_mount_rig[:3, :3], T_mount_rig[:3, 3] + lift * axis)
        return Loop(T_mount_rig, loop.middle(mounts, T_mount_rig, boards))

    def fitted(self, views: Sequence[View]) -> Adjusted:
        """The answer of some samples."""
        return adjusted(views, self.closed(views), self.board, self.z_m is not None)

    def apart_m(self, T_carrier_mount: Transform, view: View, found: Loop) -> float:
        """Rms distance of the board's outer points from where a robot pose puts them."""
        points = corners(self.board)
        off = geometry.transform(found.T_rig_board(T_carrier_mount), points) - geometry.transform(view.T_rig_board, points)
        return float(np.sqrt((off**2).sum(axis=1).mean()))


def solve(samples: Sequence[Sample], rig: Rig, mounting: Mounting, z_m: float | None = None) -> HandEye:
    """The transform under which the robot and the images of all cameras agree best.

    `z_m` is for robots that turn about one axis only, for which the height cannot be seen: the z of the board's first point, in
    the flange for a rig on the base, else in the base. Raises InputError that names what is missing (samples, turns of the
    flange about which axes), or says that too many samples contradict each other.
    """
    seen = [sample for sample in samples if any(sample.seen)]
    case = _Case(rig, _board(seen), mounting, z_m)
    if fault := spread.fault([sample.T_base_flange for sample in seen], z_m is not None):
        raise InputError(fault)
    views, apart_m = _views(seen, case)
    used, answer = _agreed(views, apart_m, case)
    found = answer.loop
    numbers = {view.name: i for i, view in enumerate(views)}
    residuals = {view.name: _residual(view, seen[i], found, case) for i, view in enumerate(views)}
    kept = [residual for name, residual in residuals.items() if numbers[name] in used]
    rms_m, rms_rad, rms_px = (float(np.sqrt(np.mean(np.square(each)))) for each in zip(*((r.m, r.rad, r.px) for r in kept),
                                                                                      strict=True))
    if len(used) < max(FEWEST, AGREEING * len(views)) or rms_m > WORST_M:
        raise InputError(_disagreement(views, used, rms_m, case))
    if len(used) < len(views) or rms_m > DOUBTFUL_M:
        _refuse_other_mounting(views, rms_m, case)
    views_used = [views[i] for i in used]
    outliers = {sample.name: "no camera sees the board" for sample in samples if not any(sample.seen)}
    outliers |= {view.name: _why(view, views_used, found, residuals[view.name], rms_m, case)
                 for i, view in enumerate(views) if i not in used}
    middle = corners(case.board).mean(0)
    sigma_m, sigma_rad = answer.sigma(np.mean([geometry.transform(view.T_rig_board, middle) for view in views_used], axis=0))
    T_base_rig, T_flange_rig = (found.T_mount_rig, None) if mounting == "base" else (None, found.T_mount_rig)
    return HandEye(mounting, T_base_rig, T_flange_rig, found.T_carrier_board, rms_m, rms_rad, rms_px, sigma_m, sigma_rad,
                   residuals, outliers)


def mounted(rig: Rig, found: HandEye, created: str) -> Rig:
    """The rig with its place in the robot; a rig file without quality stays without."""
    document = rig.model_dump() | {"created": created}
    for name in ("T_base_rig", "T_flange_rig"):
        T = getattr(found, name)
        document[name] = None if T is None else T.tolist()
    if rig.quality is not None:
        document["quality"] |= {"hand_eye_rms_m": found.rms_m, "hand_eye_rms_rad": found.rms_rad}
    return Rig.model_validate(document)


def _board(seen: Sequence[Sample]) -> Board:
    """The one board of enough samples."""
    if len(seen) < FEWEST:
        raise InputError(f"the board is seen in {len(seen)} samples, {FEWEST} are needed and 10 are good: take more")
    boards = {detection.board for sample in seen for detection in sample.seen if detection is not None}
    if len(boards) > 1:
        raise InputError(f"the samples show different boards: {', '.join(sorted(map(str, boards)))}")
    return boards.pop()


def _views(seen: Sequence[Sample], case: _Case) -> tuple[list[View], Float[np.ndarray, "n"]]:
    """The samples with the places and numberings that agree best, and how far each then lies from the one in their middle."""
    mounts = [sample.T_base_flange if case.mounting == "flange" else geometry.inverse(sample.T_base_flange) for sample in seen]
    turns = places.turned(case.board)
    ways = [[(place, turn) for place in places.places(sample.seen, case.rig) for turn in turns] for sample in seen]
    points = corners(case.board)
    guess = loop.guess(mounts, [[place @ geometry.inverse(turn) for place, turn in some] for some in ways], len(turns),
                       case.solver, points)
    if guess is None:
        raise InputError("no transform fits the samples: check the robot's poses")
    views = []
    for sample, mount, some, k in zip(seen, mounts, ways, guess.chosen, strict=True):
        place, turn = some[k]
        T_mount_flange = np.eye(4) if case.mounting == "flange" else sample.T_base_flange
        views.append(View(sample.name, mount, T_mount_flange, place @ geometry.inverse(turn),
                          places.information(sample.seen, case.rig, place, geometry.transform(turn, points.mean(0))),
                          places.rms_px(sample.seen, case.rig, place)))
    return views, guess.apart_m


def agreement(seen: Sequence[Sample], rig: Rig, mounting: Mounting,
              readings: dict[str, list[Transform]]) -> dict[str, float]:
    """How well half of the samples would agree, m, if their T_base_flange were these: tells a misread table."""
    case = _Case(rig, _board(seen), mounting, None)
    turns = places.turned(case.board)
    boards = [[place @ geometry.inverse(turn) for place in places.places(sample.seen, rig) for turn in turns]
              for sample in seen]
    apart_m = {}
    for name, poses in readings.items():
        mounts = poses if mounting == "flange" else [geometry.inverse(T) for T in poses]
        guess = None if spread.fault(poses, False) else loop.guess(mounts, boards, len(turns), case.solver, corners(case.board))
        apart_m[name] = float("inf") if guess is None else guess.score_m
    return apart_m


def _agreed(views: Sequence[View], apart_m: Float[np.ndarray, "n"], case: _Case) -> tuple[list[int], Adjusted]:
    """The samples that agree, and what they agree on: fitted to them, judged by it, until both stand."""
    used = _near(apart_m)
    for _ in range(ROUNDS):
        found = case.fitted([views[i] for i in used])
        before, used = used, _near(np.array([case.apart_m(view.T_carrier_mount, view, found.loop) for view in views]))
        if used == before:
            break
    return before, found


def _near(apart_m: Float[np.ndarray, "n"]) -> list[int]:
    """Of few samples half agree by chance, and the median is too small by so much (Rousseeuw and Leroy, 1987, of scales)."""
    few = 1 + 5 / (len(apart_m) - 2)
    limit = OUTLYING * few * max(PRECISE_M, float(np.median(apart_m)))
    return [int(i) for i in np.flatnonzero(apart_m <= limit)]


def _residual(view: View, sample: Sample, found: Loop, case: _Case) -> Residual:
    expected = found.T_rig_board(view.T_carrier_mount)
    off = apart([view], found, corners(case.board).mean(0))[0]
    numbered = [expected @ turn for turn in places.turned(case.board)]
    return Residual(float(np.linalg.norm(off[3:])), float(np.linalg.norm(off[:3])),
                    min(places.rms_px(sample.seen, case.rig, T) for T in numbered))


def _why(view: View, used: Sequence[View], found: Loop, residual: Residual, rms_m: float, case: _Case) -> str:
    """Why a sample is left out: what would explain it, else by how much it is off."""
    off = (f"its board lies {1000 * residual.m:.1f} mm and {np.degrees(residual.rad):.1f} degrees from where its robot pose "
           f"puts it, those of the others {1000 * rms_m:.1f} mm (rms)")
    nearest, other = min((case.apart_m(each.T_carrier_mount, view, found), each.name) for each in used)
    if nearest < OUTLYING * max(PRECISE_M, rms_m):
        return f"{off}; the pose of {other} would fit it"
    return f"{off}: the pose is wrong, or the robot or the board moved"


def _disagreement(views: Sequence[View], used: Sequence[int], rms_m: float, case: _Case) -> str:
    """The sentence for robot and cameras that do not agree, with what would mend it if anything known does."""
    names = ", ".join(view.name for i, view in enumerate(views) if i not in used)
    told = (f"only {len(used)} of {len(views)} samples agree (not {names})" if names else "robot and cameras disagree") + \
        f", to {1000 * rms_m:.1f} mm; {max(FEWEST, round(AGREEING * len(views)))} must agree to {1000 * WORST_M:.0f} mm. "
    if hint := _other_mounting(views, rms_m, case):
        return told + hint
    return told + ("Check that each pose belongs to its images, that it is the flange's (no tool set), its unit and its kind "
                   "of angles, the board's size, and that rig and board sit tight")


def _refuse_other_mounting(views: Sequence[View], rms_m: float, case: _Case) -> None:
    """Raises InputError where the other mounting explains the same samples far better. Not for four axes: half is unseen."""
    if case.z_m is None and (hint := _other_mounting(views, rms_m, case)):
        raise InputError(f"robot and cameras agree to {1000 * rms_m:.1f} mm only. {hint}")


def _other_mounting(views: Sequence[View], rms_m: float, case: _Case) -> str:
    """What to check when the samples agree much better with the rig mounted the other way; "" when they do not."""
    other = loop.guess([geometry.inverse(view.T_carrier_mount) for view in views], [[view.T_rig_board] for view in views],
                       1, case.solver, corners(case.board))
    if other is None or other.score_m >= min(WORST_M, rms_m / 3):
        return ""
    return (f"With the rig mounted the other way, on flange or base, they agree to {1000 * other.score_m:.1f} mm: "
            "check the mounting, and that the poses are those of the flange in the base")
