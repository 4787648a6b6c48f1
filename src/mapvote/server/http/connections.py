"""How long a connection may take, and how many there may be.

uvicorn waits for ever for a request's headers, for its body, and for a reader to take the answer; it limits only the
pause between two requests. Here every connection is always under one of four clocks, and when there are too many, the
one that has kept silent longest makes room: half-open connections cannot keep an honest vehicle out.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol, RequestResponseCycle

_TOO_SLOW = b"HTTP/1.1 408 Request Timeout\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"
_PIPELINED = 16


@dataclass(frozen=True, slots=True)
class Patience:
    """What a server waits for, in seconds, and how many connections it holds at once."""

    header_s: float
    """From the connection, or from the first byte of a later request, to the end of its headers."""
    body_s: float
    """From there to the end of its body."""
    answer_s: float
    """For a client that does not take what it asked for."""
    connections: int


class Crowd:
    """All connections of a server, and which of them have asked for nothing yet, the oldest first."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._all: set[Connection] = set()
        self._silent: dict[Connection, None] = {}

    def add(self, connection: Connection) -> None:
        """A new one; if that is one too many, the longest silent goes, which may be this one."""
        self._all.add(connection)
        self._silent[connection] = None
        if len(self._all) > self._most:
            oldest = next(iter(self._silent))
            self.remove(oldest)
            oldest.transport.abort()

    def silent(self, connection: Connection) -> None:
        """It has had its answer and asks for nothing at the moment."""
        if connection in self._all:
            self._silent[connection] = None

    def busy(self, connection: Connection) -> None:
        """A request of its own is under way: it stays."""
        self._silent.pop(connection, None)

    def remove(self, connection: Connection) -> None:
        """It is gone."""
        self._all.discard(connection)
        self._silent.pop(connection, None)


class Connection(HttpToolsProtocol):
    """One connection of uvicorn's, watched."""

    def __init__(self, *, patience: Patience, crowd: Crowd, **uvicorns: Any) -> None:
        super().__init__(**uvicorns)
        self._patience, self._crowd = patience, crowd
        self._clock: asyncio.TimerHandle | None = None
        """Runs while something is awaited from the client."""
        self._unread: asyncio.TimerHandle | None = None
        """Runs while the client takes nothing of an answer."""
        self._answering: RequestResponseCycle | None = None
        """The request that is being answered; uvicorn's ``cycle`` is the one that came last."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Wait for headers."""
        super().connection_made(transport)
        self._start(self._patience.header_s)
        self._crowd.add(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop every clock, and whatever still writes to nobody; uvicorn tells only the request that came last."""
        super().connection_lost(exc)
        self.pipeline.clear()
        if self._answering is not None:
            self._answering.disconnected = True
            self._answering.message_event.set()
        self._crowd.remove(self)
        self._stop()
        self.resume_writing()

    def data_received(self, data: bytes) -> None:
        """Whatever comes between two requests, even a single byte, starts the clock of the next one's headers."""
        super().data_received(data)
        if self._idle() and self._clock is None and self.timeout_keep_alive_task is None:
            self._start(self._patience.header_s)

    def on_headers_complete(self) -> None:
        """Wait for the body. Of requests that come before an answer uvicorn would queue any number."""
        if len(self.pipeline) >= _PIPELINED:
            raise ValueError("too many requests in one go")  # uvicorn answers 400 and hangs up
        self._start(self._patience.body_s)
        self._crowd.busy(self)
        super().on_headers_complete()

    def on_message_complete(self) -> None:
        """Now the client waits for us."""
        self._stop()
        super().on_message_complete()

    def on_response_complete(self) -> None:
        """Silent until the next request: uvicorn's own clock runs. What is left of an unread body stays under ours."""
        super().on_response_complete()
        if self._idle():
            self._crowd.silent(self)

    def _start_asgi_task(self, cycle: RequestResponseCycle, app: Any) -> None:
        self._answering = cycle
        super()._start_asgi_task(cycle, app)

    def pause_writing(self) -> None:
        """The client does not read."""
        super().pause_writing()
        self._unread = self.loop.call_later(self._patience.answer_s, self.transport.abort)

    def resume_writing(self) -> None:
        """It does again."""
        if self._unread is not None:
            self._unread.cancel()
            self._unread = None
        super().resume_writing()

    def _idle(self) -> bool:
        return self.cycle is None or bool(self.cycle.response_complete)

    def _start(self, seconds: float) -> None:
        self._stop()
        self._clock = self.loop.call_later(seconds, self._too_slow)

    def _stop(self) -> None:
        if self._clock is not None:
            self._clock.cancel()
            self._clock = None

    def _too_slow(self) -> None:
        """Before any answer has begun there is room for one; else the line is cut."""
        self._clock = None
        if self.cycle is None and not self.transport.is_closing():
            self.transport.write(_TOO_SLOW)
            self.transport.close()
        else:
            self.transport.abort()
