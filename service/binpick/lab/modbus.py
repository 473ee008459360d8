"""How long a controller waits for its registers: the latency of the largest read, seen from a client of its own."""

import socket
import struct
import time

import numpy as np

REQUEST = struct.pack(">HHHBBHH", 1, 0, 6, 1, 4, 100, 125)
ANSWER_BYTES = 9 + 2 * 125


def measure(host: str, port: int, seconds: float) -> dict[str, int | float]:
    """Reads header, records and check (125 input registers, one read) for so long, one after the other.

    Returns `reads` and the latency's p50_ms, p99_ms and max_ms. Call it in another process than the server's, which would else
    share its interpreter lock with the client. Raises OSError when the connection fails.
    """
    latencies_ms: list[float] = []
    with socket.create_connection((host, port), timeout=5) as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            started = time.perf_counter()
            connection.sendall(REQUEST)
            _receive(connection, ANSWER_BYTES)
            latencies_ms.append(1000 * (time.perf_counter() - started))
            time.sleep(0.002)
    p50, p99, worst = np.percentile(latencies_ms, [50, 99, 100])
    return {"reads": len(latencies_ms), "p50_ms": float(p50), "p99_ms": float(p99), "max_ms": float(worst)}


def _receive(connection: socket.socket, count: int) -> None:
    while count > 0:
        chunk = connection.recv(count)
        if not chunk:
            raise ConnectionError("the Modbus server hung up")
        count -= len(chunk)
