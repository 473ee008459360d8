"""The REST app: routes, problems, and the task that keeps the metrics."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

import binpick
from binpick.health import Health
from binpick.metrics import Metrics
from binpick.publish import calibration, cycles, meter, problems, status, verification, wiring
from binpick.publish.ports import Control, View
from binpick.publish.problems import Problem

REF = "#/components/schemas/{model}"


def create_app(view: View, control: Control, *, health: Callable[[], Health]) -> FastAPI:
    """The app over a cell; its lifespan runs the task that fills /metrics."""
    metrics = Metrics(lambda: meter.facts(view))

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        counting = asyncio.create_task(meter.run(view, metrics), name="binpick-metrics")
        yield
        counting.cancel()
        await asyncio.gather(counting, return_exceptions=True)

    app = _routes(lifespan)
    wiring.connect(app, wiring.Ports(view, control, health, metrics))
    return app


def openapi_text() -> str:
    """deploy/openapi.json: what the app serves at /v1/openapi.json."""
    return json.dumps(_routes(None).openapi(), indent=1) + "\n"


def _routes(lifespan: Callable[[FastAPI], Any] | None) -> FastAPI:
    # the documentation pages of FastAPI load from a CDN, which a robot cell does not reach
    app = FastAPI(title="binpick", version=binpick.__version__, openapi_url="/v1/openapi.json", docs_url=None,
                  redoc_url=None, lifespan=lifespan, redirect_slashes=False,
                  responses={"4XX": _problem("The request was refused."), "5XX": _problem("The cell cannot.")})
    problems.attach(app)
    app.include_router(cycles.router)
    app.include_router(calibration.router)
    app.include_router(status.router)
    app.include_router(verification.router)
    app.openapi = lambda: _openapi(app)  # type: ignore[method-assign]
    return app


def _problem(description: str) -> dict[str, Any]:
    return {"description": description,
            "content": {problems.MEDIA_TYPE: {"schema": {"$ref": REF.format(model=Problem.__name__)}}}}


def _openapi(app: FastAPI) -> dict[str, Any]:
    if app.openapi_schema is None:
        app.openapi_schema = get_openapi(
            title=app.title, version=app.version, routes=app.routes,
            description="Poses of graspable parts in a bin. binpick is not a safety function.")
        app.openapi_schema["components"]["schemas"][Problem.__name__] = Problem.model_json_schema(ref_template=REF)
    return app.openapi_schema
