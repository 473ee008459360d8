"""TCP ports of 127.0.0.1 that were free a moment ago."""

import socket
from contextlib import ExitStack


def free(count: int) -> list[int]:
    """So many, no two the same."""
    with ExitStack() as probes:
        sockets = [probes.enter_context(socket.socket()) for _ in range(count)]
        for probe in sockets:
            probe.bind(("127.0.0.1", 0))
        return [int(probe.getsockname()[1]) for probe in sockets]
