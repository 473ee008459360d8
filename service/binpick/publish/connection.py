"""One Modbus/TCP client: cuts the stream into requests and answers every one of them, in order, whatever its unit id."""

import asyncio
import socket
import struct
from typing import Protocol, cast, runtime_checkable

MBAP = struct.Struct(">HHHB")
"""Transaction, protocol (0), length of what follows it, unit."""
LENGTHS = range(2, 255)
"""Of unit, function code and data, bytes (Modbus Messaging on TCP/IP 1.0b, §4.1: a frame has at most 260)."""
REQUESTS_PER_TURN = 16
"""Answered in one callback; more of them wait for the loop's next turn."""


@runtime_checkable
class Server(Protocol):
    """Who answers."""

    def opened(self, connection: "Connection") -> None:
        """A client is there."""
        ...

    def closed(self, connection: "Connection") -> None:
        """A client is gone."""
        ...

    def answer(self, body: bytes, connection: "Connection") -> bytes:
        """The response to one request, each as function code and data."""
        ...


class Connection(asyncio.Protocol):
    """Bytes in, bytes out; hangs up on a client that does not speak Modbus/TCP."""

    def __init__(self, server: Server) -> None:
        self._server = server
        self._buffer = b""
        self._turn: asyncio.Handle | None = None
        self._transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """A client without power sends no goodbye: keep-alive finds out within 4 s."""
        self._transport = cast(asyncio.Transport, transport)
        peer: socket.socket = transport.get_extra_info("socket")
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in ((socket.TCP_KEEPIDLE, 1), (socket.TCP_KEEPINTVL, 1), (socket.TCP_KEEPCNT, 3)):
            peer.setsockopt(socket.IPPROTO_TCP, option, value)
        self._server.opened(self)

    def connection_lost(self, _exc: Exception | None) -> None:
        """The client went, or was sent away; what it asked and was not yet answered is dropped."""
        self._transport = None
        if self._turn is not None:
            self._turn.cancel()
        self._server.closed(self)

    def close(self) -> None:
        """Sends what is still to be sent, then hangs up."""
        if self._transport is not None:
            self._transport.close()

    def pause_writing(self) -> None:
        """The client does not read its answers: take no more requests from it."""
        if self._transport is not None:
            self._transport.pause_reading()

    def resume_writing(self) -> None:
        """It reads again."""
        if self._transport is not None:
            self._transport.resume_reading()

    def data_received(self, data: bytes) -> None:
        """A part of a request, or several requests."""
        self._buffer += data
        if self._turn is None:
            self._answer()

    def _answer(self) -> None:
        """Answers what is complete, but no more than one callback's worth."""
        self._turn = None
        answers: list[bytes] = []
        foreign = False
        while len(self._buffer) >= MBAP.size and len(answers) < REQUESTS_PER_TURN:
            transaction, protocol, length, unit = MBAP.unpack_from(self._buffer)
            end = MBAP.size - 1 + length
            foreign = protocol != 0 or length not in LENGTHS
            if foreign or len(self._buffer) < end:
                break
            response = self._server.answer(self._buffer[MBAP.size:end], self)
            answers.append(MBAP.pack(transaction, 0, len(response) + 1, unit) + response)
            self._buffer = self._buffer[end:]
        if self._transport is not None:
            self._transport.write(b"".join(answers))
        if foreign:
            self.close()
        elif len(answers) == REQUESTS_PER_TURN:
            self._turn = asyncio.get_running_loop().call_soon(self._answer)
