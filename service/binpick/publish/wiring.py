"""What a route may ask for: the app's view, its control, its health and its metrics."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, FastAPI, Request

from binpick.health import Health
from binpick.metrics import Metrics
from binpick.publish.ports import Control, View


@dataclass(frozen=True, slots=True)
class Ports:
    """All that one app reaches of the daemon."""

    view: View
    control: Control
    health: Callable[[], Health]
    metrics: Metrics


def connect(app: FastAPI, ports: Ports) -> None:
    """Gives an app its ports, once."""
    app.state.ports = ports


def _ports(request: Request) -> Ports:
    ports: Ports = request.app.state.ports
    return ports


Reach = Annotated[Ports, Depends(_ports)]
