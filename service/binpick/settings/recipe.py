"""A bin and a recipe: what stands where, and how a cycle looks for parts in it."""

from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from binpick.data import BLACK_PATTERN, FIRST_GRAY_PATTERN, Light
from binpick.geometry import Transform, Vector
from binpick.settings.base import Number, Placement, Position, Strict
from binpick.settings.mesh import Mesh
from binpick.settings.stereo import PRESETS, Stereo

Length = Annotated[float, Field(ge=0.02, le=3)]
FIRST_TRY_US = 6000.0
"""Where auto exposure begins."""
SHORTEST_US = 20.0


class Pose(Placement):
    """Where the bin stands."""

    frame: Literal["camera", "base"] = "camera"
    """The frame the position and orientation are given in."""


class Bin(Strict):
    """A load carrier: open box, origin at the centre of the inner floor, x along its length, z up."""

    number: Number = 1
    name: Annotated[str, Field(min_length=1, max_length=64)] = "bin"
    """For people."""
    inner_size_m: tuple[Length, Length, Length]
    """Inside length, width and height, metres."""
    wall_m: Annotated[float, Field(ge=0.0005, le=0.1)] = 0.003
    """Wall thickness, metres."""
    pose: Pose
    """Where it stands; with `locate`: where it is expected."""
    locate: bool = False
    """Whether each cycle looks for its rim: within 30 mm along its sides, 10 mm in height, 10° about z, and 3° of tilt."""

    @property
    def T_parent_bin(self) -> Transform:
        """Maps bin coordinates to those of `pose.frame`."""
        return self.pose.T_parent_this


class PartSize(Strict):
    """The parts' size, as what is seen of one."""

    min_size_m: Annotated[float, Field(ge=0.002, le=1)] = 0.012
    """Faces and parts with less area than half a square of this side are dropped, metres."""
    max_size_m: Annotated[float, Field(ge=0.005, le=2)] = 0.12
    """A segment longer than this may be several parts grown together: the longer, the worse it ranks, metres."""


class SegmentSettings(Strict):
    """How parts are told apart."""

    method: Literal["grid", "open3d"] = "grid"
    """grid: jumps and creases on the pixel grid; open3d: voxels, normals and DBSCAN on the unorganised cloud."""
    crease_rad: Annotated[float, Field(ge=0.05, le=1.5)] = 0.38
    """Angle between neighbouring normals that ends a face, radians."""
    jump_m: Annotated[float, Field(ge=0.0005, le=0.05)] = 0.0016
    """Step off the tangent plane that ends a part, metres."""


class Reach(Strict):
    """The box the TCP may be sent to, in frame `base` where the rig knows it, else `camera`."""

    min_m: Position = (-10.0, -10.0, -10.0)
    """Lowest corner, metres."""
    max_m: Position = (10.0, 10.0, 10.0)
    """Highest corner, metres."""

    @model_validator(mode="after")
    def _sound(self) -> "Reach":
        if any(low >= high for low, high in zip(self.min_m, self.max_m, strict=True)):
            raise ValueError("min_m must be below max_m in x, y and z")
        return self


class Shot(Strict):
    """One exposure of a cycle; what is absent is the recipe's own."""

    exposure_us: Annotated[float, Field(ge=20, le=500_000)] | None = None
    """Exposure time of both cameras, µs."""
    gain_db: Annotated[float, Field(ge=0, le=24)] | None = None
    """Gain of both cameras, dB."""
    projector: bool | None = None
    """Whether the pattern is on during exposure; a shot without it takes the ambient light's glare out of the others."""
    pattern: Annotated[int, Field(ge=0, le=BLACK_PATTERN)] = 0
    """What a programmable projector shows: random dots 0 to 7, then a Gray code (8 to 49), of which a recipe has all or none.
    The projector must step on at each strobe, in the recipe's order."""


class AutoExposure(Strict):
    """What `exposure_us: auto` goes by: exposure first; gain above the recipe's `gain_db` only beyond the longest exposure."""

    target_grey: Annotated[float, Field(ge=20, le=230)] = 140.0
    """What `percentile` is to be, grey levels of 255."""
    percentile: Annotated[float, Field(ge=50, le=99.9)] = 95.0
    """Share of the pixels of the bin's box that may not be brighter, %; of the camera that sees it brighter."""
    longest_us: Annotated[float, Field(ge=100, le=500_000)] = 30_000.0
    """Longest exposure, µs."""
    highest_gain_db: Annotated[float, Field(ge=0, le=24)] = 6.0
    """Highest gain, dB."""
    drift: Annotated[float, Field(ge=0.1, le=1)] = 0.3
    """A cycle whose images are brighter than those it was set by, or darker, by more than this share has the next one set it
    again."""


class SigmaLimits(Strict):
    """The most a grasp's own uncertainty may be, 1 sigma; a grasp beyond any of these is not published."""

    xy_m: Annotated[float, Field(ge=0.0001, le=0.1)] = 0.005
    """Across the approach (two fingers: along the closing direction), metres."""
    z_m: Annotated[float, Field(ge=0.0001, le=0.1)] = 0.005
    """Along the approach, metres."""
    tilt_rad: Annotated[float, Field(ge=0.001, le=1.6)] = 0.25
    """Between the approach and the surface (two fingers: between the closing direction and the contacts), radians."""


class TiltLimit(Strict):
    """The cone of approaches that the robot can follow; each tool has a limit of its own from straight down besides."""

    towards: Position = (0.0, 0.0, -1.0)
    """The preferred approach, a direction in frame `bin`; straight down by default."""
    max_rad: Annotated[float, Field(ge=0, le=np.pi)] = np.pi
    """Largest angle to it, radians."""

    @model_validator(mode="after")
    def _sound(self) -> "TiltLimit":
        if np.linalg.norm(self.towards) < 1e-6:
            raise ValueError("towards must be a direction, not zero")
        return self

    def angle(self, approach_bin: Vector) -> float:
        """Of an approach, a unit vector in frame `bin`, to the preferred one."""
        towards = np.array(self.towards) / np.linalg.norm(self.towards)
        return float(np.arccos(np.clip(towards @ approach_bin, -1, 1)))


class Limits(Strict):
    """What is never published."""

    margin_m: Annotated[float, Field(ge=0, le=0.05)] = 0.002
    """Clearance kept between tool and everything else, metres."""
    above_rim_m: Annotated[float, Field(ge=0, le=0.5)] = 0.04
    """How far above the rim parts are looked for, metres."""
    reach: Reach = Reach()
    """Where the robot can go."""
    sigma: SigmaLimits = SigmaLimits()
    """How uncertain a grasp may be."""
    tilt: TiltLimit = TiltLimit()
    """From where the robot can come."""


class Recipe(Strict):
    """How one kind of part is picked; recipe 0 on the wire is the first one."""

    number: Number = 1
    name: Annotated[str, Field(min_length=1, max_length=64)] = "default"
    """For people."""
    bin: Number | None = None
    """Bin to pick from; the first one when absent."""
    tools: Annotated[tuple[Number, ...], Field(max_length=4)] = ()
    """The tools to pick with, of which each grasp names the one it is for; the first one of the cell when empty."""
    part: PartSize = PartSize()
    """What the parts are like."""
    mesh: Mesh | None = None
    """The part's CAD model; with it the result says where each part lies and how it is turned."""
    stereo: Stereo = PRESETS["quality"]
    """How disparity is found: `quality`, `fast`, or settings of your own."""
    segment: SegmentSettings = SegmentSettings()
    """Telling parts apart."""
    exposure_us: Annotated[float, Field(ge=20, le=500_000)] | Literal["auto"] = 6000.0
    """Exposure time of all cameras, µs. auto: test shots at the start of the first cycle find it, and again after the light has
    changed; it is the same for all cameras and stays as it is during a cycle. Shots with the projector have one, those without
    it another."""
    auto: AutoExposure = AutoExposure()
    """What `exposure_us: auto` goes by."""
    gain_db: Annotated[float, Field(ge=0, le=24)] = 0.0
    """Gain of both cameras, dB; with `exposure_us: auto` the lowest."""
    projector: bool | Literal["alternate"] = True
    """Whether the pattern is on during exposure. alternate: in every shot, and one more is taken without it, which guides the
    filter, is what people see, and takes out glare."""
    hdr: Annotated[float, Field(ge=1.5, le=30)] | None = None
    """Every shot is taken a second time with so many times shorter exposure, for parts of which some shine and some are dark;
    null: not."""
    shots: Annotated[tuple[Shot, ...], Field(min_length=1, max_length=64)] = (Shot(),)
    """What a cycle exposes, one shot after the other; the first is the one shown."""
    limits: Limits = Limits()
    """What is never published."""
    max_grasps: Annotated[int, Field(ge=1, le=20)] = 5
    """Most grasps in a result."""
    frame: Literal["camera", "bin", "base"] = "base"
    """Frame of published poses when the request names none."""
    pose_format: Literal["quaternion_xyzw", "rotvec_rad", "kuka_abc_deg", "fanuc_wpr_deg", "ur_rxryrz_rad"] = (
        "quaternion_xyzw")
    """Orientation on Modbus when the request names none."""

    @model_validator(mode="after")
    def _different_tools(self) -> "Recipe":
        if len(set(self.tools)) != len(self.tools):
            raise ValueError(f"tools: every number may stand once, got {list(self.tools)}")
        return self

    @model_validator(mode="after")
    def _measurable(self) -> "Recipe":
        lights = self.lights
        if not lights[0].projector and any(light.projector for light in lights):
            raise ValueError("shots: the first must have the projector on when any has: it is the one shown")
        if any(light.pattern and not light.projector for light in lights):
            raise ValueError("shots: a pattern needs the projector")
        code = sorted(light.pattern for light in lights if light.pattern >= FIRST_GRAY_PATTERN)
        if code and code != list(range(FIRST_GRAY_PATTERN, BLACK_PATTERN + 1)):
            raise ValueError(f"shots: the Gray code is the patterns {FIRST_GRAY_PATTERN} to {BLACK_PATTERN}, each once")
        return self

    @model_validator(mode="after")
    def _repeatable(self) -> "Recipe":
        """A projector that steps on at each strobe cannot show a pattern for a test shot or a second exposure."""
        asked = [name for name, wanted in (("exposure_us: auto", self.metered), ("hdr", self.hdr is not None)) if wanted]
        if asked and any(shot.pattern for shot in self.shots):
            raise ValueError(f"{' and '.join(asked)}: not with numbered patterns, of which each is shown once in a cycle")
        if self.metered and any(shot.gain_db is not None and shot.exposure_us is None for shot in self.shots):
            raise ValueError("shots: with exposure_us: auto a shot with its own gain_db needs its own exposure_us")
        if self.metered and self.gain_db > self.auto.highest_gain_db:
            raise ValueError(f"gain_db {self.gain_db:g} is above auto.highest_gain_db {self.auto.highest_gain_db:g}")
        return self

    @property
    def metered(self) -> bool:
        """Whether the cell finds exposure and gain by itself."""
        return self.exposure_us == "auto"

    @property
    def lights(self) -> tuple[Light, ...]:
        """What each shot is exposed with, in order; metered ones as far as it is known before."""
        lights = [self._light(shot) for shot in self.shots]
        if self.projector == "alternate" and all(light.projector for light in lights):
            lights.append(self._light(Shot(projector=False)))
        if self.hdr is None:
            return tuple(lights)
        pairs = ((light, replace(light, exposure_us=max(light.exposure_us / self.hdr, SHORTEST_US))) for light in lights)
        return tuple(light for pair in pairs for light in pair)

    @property
    def single(self) -> "Recipe":
        """With the first shot alone."""
        alone = {"shots": self.shots[:1], "hdr": None, "projector": bool(self.projector)}
        return self.model_copy(update=alone)

    @property
    def plain(self) -> "Recipe":
        """With one shot alone that shows no pattern, exposed like the first such one, else like the first."""
        shot = next((shot for shot in self.shots if shot.projector is False), self.shots[0])
        alone = {"shots": (shot.model_copy(update={"projector": False, "pattern": 0}),), "hdr": None, "projector": False}
        return self.model_copy(update=alone)

    def _light(self, shot: Shot) -> Light:
        own = min(FIRST_TRY_US, self.auto.longest_us) if self.exposure_us == "auto" else self.exposure_us
        return Light(exposure_us=own if shot.exposure_us is None else shot.exposure_us,
                     gain_db=self.gain_db if shot.gain_db is None else shot.gain_db,
                     projector=bool(self.projector) if shot.projector is None else shot.projector, pattern=shot.pattern,
                     metered=self.metered and shot.exposure_us is None)
