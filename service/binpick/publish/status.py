"""The cell's state over REST: health for people and orchestrators, cameras, metrics, and events as they happen."""

from collections.abc import AsyncIterator

from fastapi import APIRouter, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent

from binpick.data import CameraStatus
from binpick.health import Health
from binpick.metrics import MEDIA_TYPE
from binpick.publish import events
from binpick.publish.wiring import Reach

router = APIRouter(tags=["status"])


@router.get("/v1/health")
async def health(ports: Reach) -> Health:
    """Whether the cell is well, and if not why; always 200."""
    return ports.health()


@router.get("/v1/health/live", responses={503: {"model": Health, "description": "Restart the daemon."}})
async def live(ports: Reach, response: Response) -> Health:
    """200 while the daemon works at all, else 503."""
    state = ports.health()
    response.status_code = 200 if state.live else 503
    return state


@router.get("/v1/health/ready", responses={503: {"model": Health, "description": "No cycle can start now."}})
async def ready(ports: Reach, response: Response) -> Health:
    """200 when a cycle would start now or runs, else 503."""
    state = ports.health()
    response.status_code = 200 if state.ready else 503
    return state


@router.get("/v1/cameras")
async def cameras(ports: Reach) -> tuple[CameraStatus, ...]:
    """What each camera says of itself."""
    return ports.view.snapshot().cameras


@router.get("/metrics", response_class=Response, responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}})
async def metrics(ports: Reach) -> Response:
    """Prometheus' text format."""
    return Response(ports.metrics.text(), media_type=MEDIA_TYPE)


@router.get("/v1/events", response_class=EventSourceResponse)
async def changes(ports: Reach) -> AsyncIterator[ServerSentEvent]:
    """Server-sent events: `state` at once and at every change, `result` when a cycle has finished; ends with the daemon."""
    async for event in events.stream(ports.view):
        yield event
