"""A cycle from outside: everything it reads, and everything that came of it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from binpick import geometry
from binpick.data import Depth, Image, Light, OrganisedCloud, Rectified, Segments, StereoPair
from binpick.geometry import Transform
from binpick.message import Metering, Verify
from binpick.outcomes import NO_MEMORY, Attempt, Memory
from binpick.result import Request, Result
from binpick.rig import Rig
from binpick.rigcheck.guard import Guard
from binpick.settings import Job


@dataclass(frozen=True, slots=True, eq=False)
class CycleInput:
    """Everything that one cycle reads; stored together with its result it is a recording.

    `pair` is the recipe's first shot, `more` are the others; `metering` says what auto exposure came to.
    """

    cycle_id: int
    pair: StereoPair
    rig: Rig
    job: Job
    request: Request
    simulated: bool = False
    more: tuple[StereoPair, ...] = ()
    memory: Memory = NO_MEMORY
    """What is remembered of the bin: grasps that failed there, and what the last cycle saw."""
    metering: Metering = ""
    guard: Guard | None = None
    """What the watchdog starts from; None: nobody watches the calibration."""
    verify: Verify | None = None
    """The cycle looks at the calibration alone; None: it looks for grasps."""

    @property
    def lights(self) -> tuple[Light, ...]:
        """As the recipe says; metered ones as the left camera was set."""
        return tuple(replace(light, exposure_us=pair.left.exposure_us, gain_db=pair.left.gain_db) if light.metered else light
                     for light, pair in zip(self.job.recipe.lights, self.pairs, strict=True))

    @property
    def pairs(self) -> tuple[StereoPair, ...]:
        """All shots in order."""
        return (self.pair, *self.more)

    @property
    def T_base_camera(self) -> Transform | None:
        """Maps camera coordinates to the robot's base: a fixed rig's own, or through the request's flange; else None."""
        if self.rig.T_base_rig is not None:
            return np.array(self.rig.T_base_rig)
        flange = self.request.T_base_flange
        if self.rig.T_flange_rig is None or flange is None:
            return None
        T_base_flange = geometry.from_quaternion(np.array(flange.position_m), np.array(flange.quaternion_xyzw))
        return np.asarray(T_base_flange @ np.array(self.rig.T_flange_rig))


@dataclass(frozen=True, slots=True, eq=False)
class CycleResult:
    """The answer, and what people want to see of how it came about (None from the stage on that was not reached)."""

    result: Result
    rectified: Rectified | None = None
    depth: Depth | None = None
    reprojected: Callable[[], OrganisedCloud] | None = None
    """Makes the cloud: no cycle waits for what only people look at."""
    segments: Segments | None = None
    verified: tuple[Attempt, ...] = ()
    """What became of grasps of the last cycle that nobody spoke of, as far as heights tell."""
    memory: Memory | None = None
    """What the next cycle of this bin should start from, until outcomes are told; None: the scene was not judged."""
    T_camera_bin: Transform | None = None
    guard: Guard | None = None
    """What the watchdog should start the next cycle from; None: it did not look."""
    shown: Image | None = None      # the window of the left view without the pattern, where a shot was taken so

    @property
    def cloud(self) -> OrganisedCloud | None:
        """The organised cloud, made anew each time that somebody asks."""
        return None if self.reprojected is None else self.reprojected()

    @property
    def attempts(self) -> tuple[Attempt, ...]:
        """The published grasps, as they are remembered once their outcomes are told."""
        return self.memory.look.attempts if self.memory is not None and self.memory.look is not None else ()
