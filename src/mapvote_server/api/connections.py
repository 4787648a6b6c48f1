"""Time limits and a head limit for each connection, and a limit on their number.

uvicorn limits only the pause between two requests. :class:`Connection` stands between the socket and uvicorn's
protocol. It uses only the interface of :class:`asyncio.Protocol`. :func:`tracked` calls it when a request begins and
ends. h11 limits what uvicorn keeps of an unfinished event (heads, chunk lines, trailers) to :data:`HEAD_BYTES`, too.
"""

from __future__ import annotations

import asyncio
import re
from contextvars import ContextVar
from dataclasses import dataclass
from typing import cast

from starlette.types import ASGIApp, Message, Receive, Scope, Send

HEAD_BYTES = 32_000
"""A request's line and headers."""
_LINGER_S = 1.0
_END_OF_HEAD = re.compile(rb"\n\r?\n")
_REFUSAL = "HTTP/1.1 {}\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"
_TOO_SLOW = _REFUSAL.format("408 Request Timeout").encode()
_TOO_LARGE = _REFUSAL.format("431 Request Header Fields Too Large").encode()


@dataclass(frozen=True, slots=True)
class Patience:
    """Time limits in seconds, and the number of connections."""

    header_s: float
    """Time from the connection, or from the first byte of a later request, to the end of its headers."""
    body_s: float
    """Time from the end of the headers to the end of the body."""
    answer_s: float
    """For a client that does not take what it asked for."""
    connections: int


class Crowd:
    """All connections of a server, and those without a request under way, oldest first."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._all: set[Connection] = set()
        self._silent: dict[Connection, None] = {}

    def add(self, connection: Connection) -> None:
        """A new one. Beyond the limit the connection that has been idle longest is closed, which may be this one."""
        self._all.add(connection)
        self._silent[connection] = None
        if len(self._all) > self._most:
            oldest = next(iter(self._silent))
            self.remove(oldest)
            oldest.transport.abort()

    def silent(self, connection: Connection) -> None:
        """Its request is answered."""
        if connection in self._all:
            self._silent[connection] = None

    def busy(self, connection: Connection) -> None:
        """A request of its own is under way: it stays."""
        self._silent.pop(connection, None)

    def remove(self, connection: Connection) -> None:
        """It is gone."""
        self._all.discard(connection)
        self._silent.pop(connection, None)


class Connection(asyncio.Protocol):
    """One connection: passes everything on to ``inner``, and closes if the client exceeds a time limit."""

    def __init__(self, inner: asyncio.Protocol, patience: Patience, crowd: Crowd) -> None:
        self._inner, self._patience, self._crowd = inner, patience, crowd
        self._loop = asyncio.get_running_loop()
        self._clock: asyncio.TimerHandle | None = None
        """Runs while a head or a body is awaited."""
        self._unread: asyncio.TimerHandle | None = None
        """Runs while the client takes nothing of an answer."""
        self._head: bytearray | None = bytearray()
        """Bytes of the head so far; None from its end to the end of its request's body."""
        self._asked = self._answering = False
        self._body_left = self._refused = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Wait for a head."""
        self.transport = cast("asyncio.Transport", transport)  # uvloop's is none by its class
        self._inner.connection_made(transport)
        self._start(self._patience.header_s)
        self._crowd.add(self)

    def data_received(self, data: bytes) -> None:
        """Whatever comes between two requests, even a single byte, starts the clock of the next one's head."""
        if self._refused:
            return
        if self._head is not None:
            self._head += data
            if _END_OF_HEAD.search(self._head, 0, HEAD_BYTES):
                self._head = None
            elif len(self._head) > HEAD_BYTES:
                self._refuse(_TOO_LARGE)
                return
        _CONNECTION.set(self)
        self._inner.data_received(data)
        if self._clock is None and not self._answering:
            self._start(self._patience.header_s)

    def eof_received(self) -> bool | None:
        """As the server wishes."""
        return self._inner.eof_received()

    def connection_lost(self, error: Exception | None) -> None:
        """Stop both clocks."""
        self._crowd.remove(self)
        self._stop()
        self._read_again()
        self._inner.connection_lost(error)

    def pause_writing(self) -> None:
        """The client does not read."""
        self._unread = self._loop.call_later(self._patience.answer_s, self.transport.abort)
        self._inner.pause_writing()

    def resume_writing(self) -> None:
        """It does again."""
        self._read_again()
        self._inner.resume_writing()

    def begin_request(self, has_body: bool) -> None:
        """A head is complete: wait for its body, if it has one."""
        self._head, self._asked, self._answering, self._body_left = None, True, True, has_body
        self._crowd.busy(self)
        self._stop()
        if has_body:
            self._start(self._patience.body_s)

    def end_body(self) -> None:
        """Now the client waits for the server."""
        self._body_left = False
        self._stop()

    def end_request(self) -> None:
        """Its answer is sent. What is left of an unread body stays under its clock; h11 throws it away."""
        self._answering = False
        self._head = None if self._body_left else bytearray()
        self._crowd.silent(self)

    def _start(self, seconds: float) -> None:
        self._clock = self._loop.call_later(seconds, self._too_slow)

    def _stop(self) -> None:
        if self._clock is not None:
            self._clock.cancel()
            self._clock = None

    def _read_again(self) -> None:
        if self._unread is not None:
            self._unread.cancel()
            self._unread = None

    def _too_slow(self) -> None:
        self._clock = None
        if self._asked:
            self.transport.abort()
        else:
            self._refuse(_TOO_SLOW)

    def _refuse(self, answer: bytes) -> None:
        """Answer and hang up. What still comes is thrown away for a moment: to close at once would reset the line, and
        the client would never read the answer."""
        self._refused = True
        self._stop()
        if not self.transport.is_closing():
            self.transport.write(answer)
            self.transport.write_eof()
            self._clock = self._loop.call_later(_LINGER_S, self.transport.abort)


_CONNECTION: ContextVar[Connection | None] = ContextVar("mapvote_connection", default=None)
"""The connection of the current request: uvicorn starts a request's task while it receives the request's bytes."""


def watched(inner: type[asyncio.Protocol], patience: Patience) -> type[asyncio.Protocol]:
    """A factory of protocols, each behind a :class:`Connection`; uvicorn calls it as the class ``inner``."""
    crowd = Crowd(patience.connections)
    return cast("type[asyncio.Protocol]", lambda **uvicorns: Connection(inner(**uvicorns), patience, crowd))


def tracked(app: ASGIApp) -> ASGIApp:
    """``app`` that reports to the connection when a request begins, when its body is complete, and when it ends."""

    async def run(scope: Scope, receive: Receive, send: Send) -> None:
        connection = _CONNECTION.get()
        if connection is None or scope["type"] != "http":
            await app(scope, receive, send)
            return

        async def received() -> Message:
            message = await receive()
            if message["type"] == "http.request" and not message.get("more_body", False):
                connection.end_body()
            return message

        sized = {name: value for name, value in scope["headers"] if name in (b"content-length", b"transfer-encoding")}
        connection.begin_request(has_body=bool(sized) and sized.get(b"content-length") != b"0")
        try:
            await app(scope, received, send)
        finally:
            connection.end_request()

    return run
