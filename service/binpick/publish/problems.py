"""Every fault of REST as application/problem+json (RFC 9457), with the return code that Modbus would show."""

import logging
from collections.abc import Iterator
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException

from binpick.errors import BinpickError, Code
from binpick.message import Wire

MEDIA_TYPE = "application/problem+json"
log = logging.getLogger(__name__)


class Problem(Wire):
    """What went wrong: `status` is HTTP's, `code` and `name` are the cell's, `detail` says what to do."""

    type: str
    title: str
    status: int
    detail: str
    instance: str
    code: int
    name: str
    cycle_id: int | None = None
    """The cycle it is about."""


class NoSuchCycle(BinpickError):
    """A cycle, or a picture of one, that is not in memory."""

    code, http_status = Code.NOT_APPLICABLE, 404


class TakenBack(BinpickError):
    """Poses that were published and hold no longer."""

    code, http_status = Code.NOT_APPLICABLE, 410


def _family(kind: type[BinpickError]) -> Iterator[type[BinpickError]]:
    yield kind
    for child in kind.__subclasses__():
        yield from _family(child)


def http_status(code: Code) -> int:
    """The HTTP status of the error tree for a cycle that failed with `code`; 409 for codes no error carries."""
    return next((kind.http_status for kind in _family(BinpickError) if kind.code == code), HTTPStatus.CONFLICT)


def respond(request: Request, status: int, code: Code, detail: str, cycle_id: int | None = None) -> Response:
    """The response of a fault."""
    problem = Problem(
        type=f"urn:binpick:problem:{code.name.lower()}", title=HTTPStatus(status).phrase, status=status,
        detail=detail or code.message, instance=request.url.path, code=code.value, name=code.name.lower(), cycle_id=cycle_id)
    headers = {"Cache-Control": "no-store"} | ({"Retry-After": "1"} if status == HTTPStatus.SERVICE_UNAVAILABLE else {})
    return Response(problem.model_dump_json(exclude_none=True), status, headers, MEDIA_TYPE)


def attach(app: FastAPI) -> None:
    """Makes every fault of this app a problem: ours, validation, unknown routes and methods, and defects."""
    app.add_exception_handler(BinpickError, _ours)
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(HTTPException, _http)
    app.add_exception_handler(Exception, _defect)


async def _ours(request: Request, error: Exception) -> Response:
    assert isinstance(error, BinpickError)
    return respond(request, error.http_status, error.code, str(error))


async def _invalid(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    return respond(request, HTTPStatus.UNPROCESSABLE_ENTITY, Code.BAD_ARGUMENT,
                   "; ".join(_sentence(item) for item in error.errors()))


def _sentence(item: dict[str, Any]) -> str:
    where = ".".join(str(part) for part in item["loc"])
    return f"{where}: {'unknown key' if item['type'] == 'extra_forbidden' else item['msg']}"


async def _http(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    detail = {404: f"there is nothing at {request.url.path}: see /v1/openapi.json",
              405: f"{request.url.path} does not answer {request.method}: see /v1/openapi.json"}
    response = respond(request, error.status_code, Code.BAD_ARGUMENT, detail.get(error.status_code, error.detail))
    response.headers.update(error.headers or {})
    return response


async def _defect(request: Request, error: Exception) -> Response:
    log.error("%s %s failed", request.method, request.url.path, exc_info=error)
    return respond(request, HTTPStatus.INTERNAL_SERVER_ERROR, Code.NOT_READY, "an internal error: see the daemon's log")
