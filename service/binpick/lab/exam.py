"""The exam's frames: a settled world, the pair its cameras take, and the truth behind it, made once per scene."""

import functools
import hashlib
from dataclasses import dataclass, replace

from scipy.stats import binomtest

from binpick import settings
from binpick.cycle import CycleInput
from binpick.data import Frame, Image, Light, StereoPair, Window
from binpick.lab.archive import NOWHERE, Archive
from binpick.result import Request
from binpick.settings import Recipe, SegmentSettings
from binpick.settings.recipe import Shot
from binpick.sim import exam
from binpick.sim.render import Renderer
from binpick.sim.truth import Truth, truth
from binpick.sim.world import World, WorldScene
from binpick.stereo import rectify
from binpick.stereo.rectify import Rectification


@dataclass(frozen=True, slots=True, eq=False)
class Paper:
    """One question of the exam: what the pipeline gets, and the world it was taken of."""

    inputs: CycleInput
    scene: WorldScene

    @property
    def rect(self) -> Rectification:
        """The rectified view the truth is cast in."""
        return rectify.rectification(self.inputs.rig)

    def truth(self, view: Window) -> Truth:
        """True disparity, part ids and visibility of a window."""
        rect = self.rect
        return truth(self.scene, rect.T_camera_rect, rect.focal_px, rect.cx_px, rect.cy_px, rect.baseline_m, view)


@functools.cache
def renderer(world: str) -> Renderer:
    """The world's renderer; its rays are worth keeping."""
    return Renderer(exam.rig(world), world)


def paper(world: str, seed: int, *, kinds: str = "mixed", parts: int = 25, recipe: int = 1, frame: str = "bin",
          projector: bool | None = None, shots: tuple[Shot, ...] = (), keep: Archive = NOWHERE) -> Paper:
    """A scene of the exam as the daemon would get it: recipe, pattern on, poses in the bin's frame.

    `kinds` as in `sim.exam.kinds`; `projector` and `shots` replace the recipe's own.
    """
    scene = World(world, kinds, parts, seed).scene()
    job = settings.resolve(exam.cell(world), recipe)
    changes = ({} if projector is None else {"projector": projector}) | ({"shots": shots} if shots else {})
    if changes:
        job = job.model_copy(update={"recipe": Recipe.model_validate(job.recipe.model_dump() | changes)})
    first, *more = (pair(scene, light, seed + i, keep) for i, light in enumerate(job.recipe.lights))
    request = Request.model_validate({"frame": frame})
    return Paper(CycleInput(1, first, exam.rig(world), job, request, simulated=True, more=tuple(more)), scene)


def for_tool(asked: Paper, *kinds: str) -> Paper:
    """The same frames for a recipe whose tools are the defaults of those kinds."""
    tools = exam.cell(asked.scene.world, tools=[{"number": i, "kind": kind} for i, kind in enumerate(kinds, start=1)]).tools
    return replace(asked, inputs=replace(asked.inputs, job=asked.inputs.job.model_copy(update={"tools": tools})))


def for_method(asked: Paper, method: str) -> Paper:
    """The same frames for a recipe that tells parts apart by another method."""
    job = asked.inputs.job
    segment = SegmentSettings.model_validate(job.recipe.segment.model_dump() | {"method": method})
    recipe = job.recipe.model_copy(update={"segment": segment})
    return replace(asked, inputs=replace(asked.inputs, job=job.model_copy(update={"recipe": recipe})))


def pair(scene: WorldScene, light: Light, shot: int, keep: Archive = NOWHERE) -> StereoPair:
    """What both cameras take of a scene; another shot number has other noise. Raises InputError for an unknown pattern."""
    rig = exam.rig(scene.world)

    def image(index: int) -> Image:
        return keep.picture(rig, scene, index, light, shot,
                            lambda: renderer(scene.world).expose(scene, index, light, shot))

    left, right = (
        Frame(
            image=image(index),
            camera=name,
            sequence=1,
            frame_id=1,
            timestamp_ns=0,
            triggered_ns=0,
            received_ns=1,
            exposure_us=light.exposure_us,
            gain_db=light.gain_db,
        )
        for index, name in enumerate(("left", "right"))
    )
    return StereoPair(left=left, right=right, captured_at="2026-01-01T00:00:00Z", skew_us=0.0, sigma_us=0.0, proof="simulated")


def settings_sha256(world: str, *tools: str) -> str:
    """Names all settings of a cell whose tools are the defaults of these kinds."""
    numbered = [{"number": i, "kind": kind} for i, kind in enumerate(tools, start=1)]
    return hashlib.sha256(exam.cell(world, tools=numbered).model_dump_json().encode()).hexdigest()


def wilson(good: int, of: int) -> tuple[float, float]:
    """The 95 % Wilson score interval of a share (Wilson 1927); of nothing, 0 to 1."""
    if of == 0:
        return 0.0, 1.0
    low, high = binomtest(good, of).proportion_ci(method="wilson")
    return float(low), float(high)
