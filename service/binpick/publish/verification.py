"""The calibration over REST: what the watchdog knows of its drift, and a look at it on demand."""

from typing import Annotated

from fastapi import APIRouter, Body, Request, Response
from pydantic import Field

from binpick import result as results
from binpick.message import CalibrationMessage, PoseMessage, Verify, Wire
from binpick.publish import cycles, problems
from binpick.publish.wiring import Reach
from binpick.result import Drift

router = APIRouter(prefix="/v1/calibration", tags=["calibration"])


class VerifyRequest(Verify):
    """A verification, as asked for over REST."""

    recipe: Annotated[int, Field(ge=0, le=65535)] = 0
    """Recipe by whose light the pair is taken; 0: the first."""
    timeout_ms: Annotated[int, Field(ge=0, le=60000)] = 0
    """Time limit, ms; 0: the cell's."""
    T_base_flange: PoseMessage | None = None
    """The flange when the cameras ride on it."""


class Verified(Wire):
    """What a verification found; the whole is at /v1/cycles/{cycle_id}."""

    cycle_id: int
    verdict: CalibrationMessage
    marks_stored: bool
    """The reference marks were stored from this pair."""


@router.get("/drift")
async def drift(ports: Reach) -> Drift:
    """The watchdog's last word, the row errors of the last cycles, and what wants attention."""
    return ports.view.snapshot().drift or Drift()


@router.post("/verify", responses={200: {"model": Verified, "description": "The verdict, also when it is a fault."}})
async def verify(request: Request, ports: Reach,
                 body: Annotated[VerifyRequest, Body()] = VerifyRequest()) -> Response:  # noqa: B008 - frozen
    """Takes a pair now and judges the calibration by its rows, the reference marks, and a board that is in view.

    For the controlling interface at any time, for others while the cell is idle.
    """
    asked = results.Request(recipe=body.recipe, timeout_ms=body.timeout_ms, T_base_flange=body.T_base_flange)
    wanted = Verify(store_marks=body.store_marks, board=body.board)
    cycle_id = ports.control.verify(wanted, asked, "rest")
    published = await cycles.finished(ports.view, cycle_id)
    verdict, code = published.result.calibration, published.result.return_code
    if verdict is None:
        return problems.respond(request, problems.http_status(code.code), code.code, code.message, cycle_id)
    stored = body.store_marks and verdict.marks is not None
    answer = Verified(cycle_id=cycle_id, verdict=verdict, marks_stored=stored)
    return Response(answer.model_dump_json(), media_type="application/json", headers={"Cache-Control": "no-store"})
