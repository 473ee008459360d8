"""Calibration over REST: samples of a board, the hand-eye made of them, and which version of the rig is in use."""

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Request, Response

from binpick.calibration import (
    Activation,
    CalibrationState,
    HandEyeAnswer,
    HandEyeRequest,
    SampleAnswer,
    SampleRequest,
    Samples,
)
from binpick.errors import BinpickError, Code, NotApplicable
from binpick.publish import problems
from binpick.publish.cycles import finished
from binpick.publish.wiring import Reach

PICTURE: dict[str, Any] = {"description": "The image as it was taken.", "content": {
    "image/png": {"schema": {"type": "string", "format": "binary"}}}}
SampleId = Annotated[int, Path(ge=1, description="A sample's id.")]
PictureName = Literal["left.png", "right.png", "third.png", "fourth.png", "fifth.png"]

router = APIRouter(prefix="/v1/calibration", tags=["calibration"])


class NoSuchSample(BinpickError):
    """A sample, or a picture of one, that is not there."""

    code, http_status = Code.NOT_APPLICABLE, 404


@router.get("")
def state(ports: Reach) -> CalibrationState:
    """The version of the rig that the cell runs on, and those that can be activated."""
    return ports.control.calibration.state()


@router.post("/samples", status_code=201, responses={201: {"model": SampleAnswer, "description": "The sample is stored."}})
async def take(request: Request, body: SampleRequest, ports: Reach) -> Response:
    """Takes one pair of images of a board without the pattern and stores it with the flange pose; the robot stands still.

    It is stored, and answered with 201, whether the board was found or not: `found` and `reason` say which camera saw it.
    Whoever does not control the cell may take samples while it is idle.
    """
    cycle_id = ports.control.calibration.sample(body, "rest")
    published = await finished(ports.view, cycle_id)
    code = published.result.return_code
    if published.sample is None:
        return problems.respond(request, problems.http_status(code.code), code.code, code.message, cycle_id)
    where = f"/v1/calibration/samples/{published.sample.sample.id}"
    return Response(published.sample.model_dump_json(), 201, {"Location": where, "Cache-Control": "no-store"},
                    "application/json")


@router.get("/samples")
def samples(ports: Reach) -> Samples:
    """All samples, and what the next ones should show."""
    return ports.control.calibration.samples()


@router.delete("/samples", status_code=204)
def clear(ports: Reach) -> None:
    """Forgets all samples."""
    ports.control.calibration.delete()


@router.delete("/samples/{sample}", status_code=204)
def delete(sample: SampleId, ports: Reach) -> None:
    """Forgets one sample."""
    try:
        ports.control.calibration.delete(sample)
    except NotApplicable as error:
        raise NoSuchSample(str(error)) from error


@router.get("/samples/{sample}/{name}", responses={200: PICTURE}, response_class=Response)
def picture(sample: SampleId, name: PictureName, ports: Reach) -> Response:
    """One camera's image of a sample."""
    body = ports.control.calibration.image(sample, name.removesuffix(".png"))
    if body is None:
        raise NoSuchSample(f"there is no {name} of sample {sample}: see /v1/calibration/samples")
    return Response(body, media_type="image/png", headers={"Cache-Control": "no-store"})


@router.post("/handeye")
def handeye(body: HandEyeRequest, ports: Reach) -> HandEyeAnswer:
    """Solves the hand-eye calibration from the samples and stores it as a new version of the rig, which is not active yet."""
    return ports.control.calibration.handeye(body)


@router.post("/activate")
def activate(body: Activation, ports: Reach) -> CalibrationState:
    """Has the cell run on a version of the rig, from the next cycle on and after restarts; also goes back to an earlier one.

    No cycle may run, and poses that were published are withdrawn. Whoever does not control the cell may do so while it is idle.
    """
    return ports.control.calibration.activate(body.version, "rest")
