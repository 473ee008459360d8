"""Cycles over REST: start, wait, read, withdraw, and say what became of a grasp."""

import time
from contextlib import aclosing
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Body, Path, Query, Request, Response
from pydantic import Field

from binpick import result as results
from binpick.errors import InputError, NotApplicable, NotReady
from binpick.publish import problems, wire
from binpick.publish.events import snapshots
from binpick.publish.ports import View
from binpick.publish.problems import NoSuchCycle, TakenBack
from binpick.publish.wiring import Reach
from binpick.result import Published, Result, Snapshot

ACKNOWLEDGED = "acknowledged"
"""What a snapshot says of a result that its controller has read: the one end that takes nothing back."""
RESULT: dict[str, Any] = {"model": Result, "description": "The result; its age is that of this moment.", "headers": {
    "Binpick-Age-Ms": {"description": "Milliseconds since the trigger.", "schema": {"type": "number"}},
    "Binpick-Valid": {"description": "Whether the result still holds.", "schema": {"enum": ["true", "false"]}}}}
RUNS: dict[str, Any] = {"model": wire.Accepted, "description": "The cycle runs; its result will be at Location.", "headers": {
    "Location": {"description": "Where the result will be.", "schema": {"type": "string"}}}}
PICTURE: dict[str, Any] = {"description": "The picture, or the cloud.", "content": {
    media: {"schema": {"type": "string", "format": "binary"}} for media in ("image/png", "application/octet-stream")}}

CycleId = Annotated[int, Path(ge=1, description="A cycle's id.")]
CycleName = Annotated[Annotated[int, Field(ge=1)] | Literal["latest"], Path(description="A cycle's id, or latest.")]
ArtefactName = Literal["cloud.ply", "overlay.png", "disparity.png", "confidence.png", "left.png", "right.png"]

router = APIRouter(prefix="/v1/cycles", tags=["cycles"])


@router.post("", status_code=202, responses={200: RESULT, 202: RUNS})
async def start(
    request: Request, ports: Reach, body: Annotated[results.Request, Body()] = results.Request(),  # noqa: B008 - frozen
    wait: Annotated[bool, Query(description="Answer with the result, or with the failure as a problem.")] = False,
) -> Response:
    """Starts a cycle; refused at once when one runs (nothing is queued) or another interface owns the cell."""
    cycle_id = ports.control.start(body, "rest")
    if not wait:
        return _accepted(cycle_id, ports.view.snapshot())
    published = await finished(ports.view, cycle_id)
    code = published.result.return_code
    if code.value < 0:
        return problems.respond(request, problems.http_status(code.code), code.code, code.message, cycle_id)
    return _answer(published, ports.view.snapshot())


@router.get("/{cycle}", responses={200: RESULT, 202: RUNS})
async def read(
    cycle: CycleName, ports: Reach,
    record: Annotated[bool, Query(description="Read it as a record, though its poses were taken back.")] = False,
) -> Response:
    """The result of a cycle, or of the last finished one.

    A program that looks at the status alone must never move by poses that hold no longer. So when those of the last cycle were
    taken back (too old, withdrawn, a new cycle triggered) it is 410 unless asked for as a record. Acknowledged ones are
    served: only the controller that has read them may move. An earlier cycle, named by its id, is a record already.
    """
    snapshot = ports.view.snapshot()
    if cycle == snapshot.current:
        return _accepted(snapshot.current, snapshot)
    published = snapshot.latest if cycle == "latest" else ports.view.finished(cycle)
    if published is None:
        raise NoSuchCycle("no cycle has finished yet" if cycle == "latest" else f"cycle {cycle} is not in memory")
    if _taken_back(published, snapshot) and not record:
        raise TakenBack(f"the poses of cycle {published.result.cycle_id} hold no longer ({snapshot.withdrawn}): start a new "
                        "cycle; ?record=true reads what they were")
    return _answer(published, snapshot)


@router.delete("/{cycle}", status_code=204)
async def abort(cycle: CycleId, ports: Reach) -> None:
    """Withdraws a running cycle."""
    ports.control.abort(cycle, "rest")


@router.get("/{cycle}/{name}", responses={200: PICTURE}, response_class=Response)
def artefact(cycle: CycleName, name: ArtefactName, ports: Reach) -> Response:
    """A picture or the cloud of the last cycle (no `async`: it is drawn on a thread of the server's pool)."""
    latest = ports.view.snapshot().latest
    cycle_id = cycle if cycle != "latest" else latest.result.cycle_id if latest else 0
    drawn = ports.view.artefact(cycle_id, name)
    if drawn is None:
        raise NoSuchCycle(f"there is no {name} of cycle {cycle}: pictures are kept of the last cycle that took images")
    return Response(drawn.body, media_type=drawn.media_type, headers={"Cache-Control": "no-store"})


@router.post("/{cycle}/grasps/{grasp_id}/outcome", status_code=204)
async def outcome(
    cycle: CycleId, ports: Reach, body: wire.Outcome,
    grasp_id: Annotated[str, Path(pattern=r"^([1-9]\d{0,9}-)?[1-9]\d{0,4}$", description="A grasp's id, or its number.")],
) -> None:
    """What became of a grasp; saying it again changes nothing."""
    of_cycle, _, number = grasp_id.rpartition("-")
    if of_cycle and int(of_cycle) != cycle:
        raise InputError(f"grasp {grasp_id} is not one of cycle {cycle}")
    ports.control.report(cycle, int(number), body.code, "rest")


async def finished(view: View, cycle_id: int) -> Published:
    """Waits for the end of a cycle, which its own time limit bounds. Raises NotReady when the cell stops."""
    async with aclosing(snapshots(view)) as changes:
        async for snapshot in changes:
            if (published := view.finished(cycle_id)) is not None:
                return published
            if snapshot.phase != "stopping" and snapshot.current != cycle_id:
                raise NotApplicable(f"cycle {cycle_id} ended without a result")
    raise NotReady("the cell is stopping")


def _taken_back(published: Published, snapshot: Snapshot) -> bool:
    return (bool(published.result.grasps) and published is snapshot.latest
            and not snapshot.valid and snapshot.withdrawn != ACKNOWLEDGED)


def _accepted(cycle_id: int, snapshot: Snapshot) -> Response:
    body = wire.Accepted(cycle_id=cycle_id, phase="computing" if snapshot.acquired else "acquiring")
    return Response(body.model_dump_json(), 202, {"Location": f"/v1/cycles/{cycle_id}", "Cache-Control": "no-store"},
                    "application/json")


def _answer(published: Published, snapshot: Snapshot) -> Response:
    now_ns = time.monotonic_ns()
    age_ms = wire.age_ms(published, now_ns)
    headers = {"Cache-Control": "no-store", "Binpick-Valid": str(snapshot.valid and published is snapshot.published).lower()}
    if age_ms is not None:
        headers["Binpick-Age-Ms"] = f"{age_ms:.1f}"
    return Response(wire.aged(published, now_ns), 200, headers, "application/json")
