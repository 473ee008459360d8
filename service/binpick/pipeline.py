"""The order of the stages: one pure function from a cycle's input to its result."""

from collections.abc import Callable

from binpick.errors import FlangePoseMissing, FrameUnavailable
from binpick.result import CycleInput, CycleResult, Request
from binpick.rig import Rig
from binpick.settings import Job


def admit(rig: Rig, job: Job, request: Request) -> None:
    """Refuses a request whose answer could not exist. Raises FrameUnavailable, FlangePoseMissing."""
    needs_base = (request.frame or job.recipe.frame) == "base" or job.bin.pose.frame == "base"
    if rig.T_flange_rig is not None and needs_base and request.T_base_flange is None:
        raise FlangePoseMissing("the cameras ride on the flange: send T_base_flange with the request")
    if rig.T_base_rig is None and rig.T_flange_rig is None and needs_base:
        raise FrameUnavailable(
            'the rig has no hand-eye calibration, so poses in "base" do not exist: ask for frame "camera" or "bin"')


def run(inputs: CycleInput, proceed: Callable[[], None] = lambda: None) -> CycleResult:
    """The cycle. `proceed` is called between stages and may raise to end it (time limit, abort)."""
    raise NotImplementedError
