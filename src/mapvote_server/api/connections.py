"""Limits of each connection: time, a strict head, one request at a time; and a limit on their number.

uvicorn limits only the pause between two requests. :class:`Connection` stands between the socket and uvicorn's
protocol. It uses the interface of :class:`asyncio.Protocol`, and asks h11 what came after a request. :func:`tracked`
calls it when a request begins and ends. h11 limits what uvicorn keeps of an unfinished event (heads, chunk lines,
trailers) to ``HeadLimits.head_bytes``, too.

Requests are parsed in one thread, so their order decides who waits. A request that came before the answer to the one
before it (pipelining) is not read: its connection is closed after that answer, as RFC 9112, 9.3.2 lets a server do.
Only a few requests of one key, or of one address without a right key, are under way at a time (:class:`Line`).
"""

from __future__ import annotations

import asyncio
import re
from collections import Counter, deque
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, cast

import h11
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from mapvote.core.record import record
from mapvote_server.errors import Unavailable


@record()
@dataclass(frozen=True, slots=True)
class HeadLimits:
    """Limits of one connection."""

    head_bytes: int = 32_000
    """Bytes of a request's line and headers."""
    linger_s: float = 1.0
    """Time for which bytes after a refusal are discarded, seconds."""
    surplus_bytes: int = 1_000_000
    """Bytes that nobody reads and that are discarded; after more of them the connection is not read any more."""


HEAD_LIMITS = HeadLimits()
_END_OF_HEAD = re.compile(rb"\n\r?\n")
_BARE_LINE_END = re.compile(rb"(?<!\r)\n")
_LENGTHS = b"\r\ncontent-length:", b"\r\ntransfer-encoding:"
_REFUSAL = "HTTP/1.1 {}\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"
_MALFORMED = _REFUSAL.format("400 Bad Request").encode()
_TOO_SLOW = _REFUSAL.format("408 Request Timeout").encode()
_TOO_LARGE = _REFUSAL.format("431 Request Header Fields Too Large").encode()


@record()
@dataclass(frozen=True, slots=True)
class Crowding:
    """How connections share one server."""

    headers: int = 100
    """Headers of one request, at most."""
    strangers: int = 8
    """Requests of one address under way at a time without a right key: probes, without any key, with a new one."""
    of_key: int = 8
    """Requests of one right key under way at a time, without those that wait for a thread."""
    kept: int = 8
    """Connections beyond the limit for probes and for keys of reviewers and operators."""


CROWDING = Crowding()


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
    """All connections of a server: those without a request under way, oldest first, and the others."""

    def __init__(self, most: int, numbers: Crowding = CROWDING) -> None:
        self._most = most
        self._kept = numbers.kept
        self._all: set[Connection] = set()
        self._silent: dict[Connection, None] = {}
        self._busy: dict[Connection, None] = {}

    def add(self, connection: Connection) -> None:
        """A new one. Beyond the limit the connection that has been idle longest is closed; if all are busy, the newest
        of the key (or address) that holds most; if none holds two, the new one takes a place that is kept."""
        self._all.add(connection)
        self._silent[connection] = None
        if len(self._all) <= self._most:
            return
        leaves: Connection | None = next(iter(self._silent))
        if leaves is connection:
            leaves = self._newest_of_the_greediest()
        if leaves is None:
            leaves = connection if len(self._all) > self._most + self._kept else None
        if leaves is not None:
            self.remove(leaves)
            leaves.transport.abort()

    def silent(self, connection: Connection) -> None:
        """Its request is answered."""
        self._busy.pop(connection, None)
        if connection in self._all:
            self._silent[connection] = None

    def busy(self, connection: Connection) -> None:
        """A request of its own is under way: it stays."""
        if connection in self._all:
            self._silent.pop(connection, None)
            self._busy[connection] = None

    def remove(self, connection: Connection) -> None:
        """It is gone."""
        self._all.discard(connection)
        self._silent.pop(connection, None)
        self._busy.pop(connection, None)

    def check_place(self, *, privileged: bool) -> None:
        """Unavailable for a request in a place that is kept for others."""
        if len(self._all) > self._most and not privileged:
            raise Unavailable("all connections of this server are busy ([server] connections); try again")

    def _newest_of_the_greediest(self) -> Connection | None:
        held = Counter(connection.holder for connection in self._busy if not connection.privileged)
        if not held:
            return None
        holder, count = held.most_common(1)[0]
        if count < 2:
            return None
        return next(one for one in reversed(self._busy) if one.holder == holder and not one.privileged)


@dataclass(frozen=True, slots=True)
class Caller:
    """Who sends a request, as far as its head tells."""

    name: str = ""
    """The hash of a right key; else what kind of request of an address it is."""
    has_key: bool = False
    """Whether its key was right when it came last."""


class Line:
    """Requests that wait for others of the same caller: so many at a time, the others wait in order."""

    def __init__(self, numbers: Crowding = CROWDING) -> None:
        self._numbers = numbers
        self._under_way: Counter[Caller] = Counter()
        self._waiting: dict[Caller, deque[Connection]] = {}

    def enter(self, connection: Connection) -> bool:
        """Whether its request may begin; else :meth:`Connection.go_on` is called once it may."""
        caller = connection.caller
        most = self._numbers.of_key if caller.has_key else self._numbers.strangers
        if self._under_way[caller] < most:
            self._under_way[caller] += 1
            return True
        self._waiting.setdefault(caller, deque()).append(connection)
        return False

    def leave(self, caller: Caller) -> None:
        """One of this caller is done, or its key is known: the next one may begin."""
        queue = self._waiting.get(caller)
        if queue:
            queue.popleft().go_on()
        else:
            self._under_way[caller] -= 1
            if not self._under_way[caller]:
                del self._under_way[caller]
        if not queue:
            self._waiting.pop(caller, None)

    def give_up(self, connection: Connection) -> None:
        """It waits no longer."""
        queue = self._waiting.get(connection.caller)
        if queue and connection in queue:
            queue.remove(connection)


Know = Callable[[bytes], Caller]
"""From a request's head to its caller, without the address."""


class Connection(asyncio.Protocol):
    """One connection: passes everything on to ``inner``, and closes if the client exceeds a time limit."""

    def __init__(self, inner: asyncio.Protocol, patience: Patience, crowd: Crowd, line: Line, know: Know) -> None:
        self._inner = inner
        self._know = know
        self._patience = patience
        self._crowd = crowd
        self._line = line
        self._loop = asyncio.get_running_loop()
        self._clock: asyncio.TimerHandle | None = None
        """Runs while a head or a body is awaited."""
        self._unread: asyncio.TimerHandle | None = None
        """Runs while the client takes nothing of an answer."""
        self._head: bytearray | None = bytearray()
        """Bytes of the head so far; None from its end to the end of its request's body."""
        self._held = b""
        """The end of a head that waits in line."""
        self._surplus = 0
        """Bytes that were discarded."""
        self._asked = self._answering = False
        self._body_left = self._refused = self._pipelined = False
        self._in_line = self._waits = False
        self.caller = Caller()
        self.address = self.holder = ""
        self.privileged = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Wait for a head."""
        self.transport = cast("asyncio.Transport", transport)  # uvloop's is none by its class
        self.address = self.holder = str((transport.get_extra_info("peername") or ("",))[0])
        self._inner.connection_made(transport)
        self._start(self._patience.header_s)
        self._crowd.add(self)

    def data_received(self, data: bytes) -> None:
        """Whatever comes between two requests, even a single byte, starts the clock of the next one's head."""
        if self._refused:
            self._discard(data)
            return
        if self._waits:
            self._held += data
            return
        if self._answering and not self._body_left:
            self._pipelined = True  # the connection ends after this answer
            self._discard(data)
            return
        if self._head is not None:
            self._head += data
            end = _END_OF_HEAD.search(self._head, 0, HEAD_LIMITS.head_bytes)
            fault = _fault_of(bytes(self._head[: end.end() if end else HEAD_LIMITS.head_bytes]))
            if fault is None and end is None and len(self._head) > HEAD_LIMITS.head_bytes:
                fault = _TOO_LARGE
            if fault is not None:
                self._refuse(fault)
                return
            if end:
                data = self._end_head(data, len(self._head) - end.end())
                if not self._may_begin(data):
                    return
        self._pass_on(data)

    def go_on(self) -> None:
        """Its turn in line has come."""
        self._waits = False
        self._in_line = True
        self._loop.call_soon(self._begin_held)

    def identify(self, name: str, *, privileged: bool) -> None:
        """The key of the request under way is known: its name, and whether it is a reviewer's or an operator's.
        Unavailable if the connection has a place that is kept for those."""
        self.privileged = privileged
        self.holder = name or self.address
        if not self.caller.has_key:
            self.step_aside()
        self._crowd.check_place(privileged=privileged)

    def step_aside(self) -> None:
        """Let the next one in line begin."""
        if self._in_line:
            self._in_line = False
            self._line.leave(self.caller)

    def _end_head(self, data: bytes, after: int) -> bytes:
        """The head is complete, with so many bytes after it: the part of ``data`` that belongs to its request."""
        assert self._head is not None
        head = bytes(self._head[: len(self._head) - after])
        self._head = None
        self._crowd.busy(self)
        caller = self._know(head)
        self.caller = caller if caller.has_key else Caller(f"{self.address} {caller.name}")
        begun = head.lower()
        if after and not any(length in begun for length in _LENGTHS):
            self._pipelined = True
            return data[:-after]
        return data

    def _may_begin(self, data: bytes) -> bool:
        """Whether the request of a complete head begins now; else it is held until its turn."""
        self._in_line = self._line.enter(self)
        if not self._in_line:
            self._waits = True
            self._held = data
            self._stop()
            self.transport.pause_reading()
        return self._in_line

    def _begin_held(self) -> None:
        data = self._held
        self._held = b""
        if not self.transport.is_closing():
            self.transport.resume_reading()
            self._pass_on(data)

    def _discard(self, data: bytes) -> None:
        """Discard bytes that nobody reads. To take them as fast as they come would cost other clients their turns."""
        self._surplus += len(data)
        if self._surplus > HEAD_LIMITS.surplus_bytes:
            self.transport.pause_reading()
            if self._refused:
                self._stop()
                self._clock = self._loop.call_later(HEAD_LIMITS.linger_s, self.transport.abort)

    def _pass_on(self, data: bytes) -> None:
        _CONNECTION.set(self)
        self._inner.data_received(data)
        if self._clock is None and not self._answering:
            self._start(self._patience.header_s)

    def eof_received(self) -> bool | None:
        """Close the connection as the server wishes."""
        return self._inner.eof_received()

    def connection_lost(self, error: Exception | None) -> None:
        """Stop both clocks."""
        self._crowd.remove(self)
        self._line.give_up(self)
        self.step_aside()
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
        self._head = None
        self._asked = True
        self._answering = True
        self._body_left = has_body
        self._crowd.busy(self)
        self._stop()
        if has_body:
            self._start(self._patience.body_s)

    def end_body(self) -> None:
        """Now the client waits for the server."""
        self._body_left = False
        self._stop()

    def is_last(self) -> bool:
        """Whether the client has sent more before it was answered: the connection ends after this answer."""
        conn = cast("Any", self._inner).conn
        return self._pipelined or (conn.their_state is h11.DONE and bool(conn.trailing_data[0]))

    def end_request(self) -> None:
        """Its answer is sent. A connection with an unread body ends: its rest is discarded under the body's clock."""
        if not self._answering:
            return
        self._answering = False
        self.step_aside()
        self._crowd.silent(self)
        if self._pipelined:
            self._refused = True
            self.transport.close()
        elif self._body_left and cast("Any", self._inner).conn.their_state is h11.SEND_BODY:
            self._refused = True
            if not self.transport.is_closing():
                self.transport.write_eof()
        else:
            self.end_body()
            self._head = bytearray()

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
        """Answer and hang up. Further bytes are discarded for a moment: to close at once would reset the line, and the
        client would never read the answer."""
        self._refused = True
        self._stop()
        if not self.transport.is_closing():
            self.transport.write(answer)
            self.transport.write_eof()
            self._clock = self._loop.call_later(HEAD_LIMITS.linger_s, self.transport.abort)


_CONNECTION: ContextVar[Connection | None] = ContextVar("mapvote_connection", default=None)
"""The connection of the current request: uvicorn starts a request's task while it receives the request's bytes."""


def identify(name: str, *, privileged: bool) -> None:
    """:meth:`Connection.identify` of the current request; nothing within a process."""
    connection = _CONNECTION.get()
    if connection is not None:
        connection.identify(name, privileged=privileged)


def step_aside(*, with_key: bool = True) -> None:
    """Let the next request of the same caller begin, though the current one is still under way; without ``with_key``
    only if it came without a right key."""
    connection = _CONNECTION.get()
    if connection is not None and (with_key or not connection.caller.has_key):
        connection.step_aside()


def _fault_of(head: bytes) -> bytes | None:
    """The refusal of a head, or of its beginning, that an HTTP client does not send: too many headers; a line that ends
    without CR, or goes on in the next one; a length beside a transfer encoding. Two programs would read it as different
    requests (RFC 9112, 11.2)."""
    head = head.lstrip(b"\r\n")
    if head.count(b"\n") > CROWDING.headers + 2:
        return _TOO_LARGE
    lines = head.lower()
    if _BARE_LINE_END.search(head) or b"\r\n " in head or b"\r\n\t" in head:
        return _MALFORMED
    return _MALFORMED if all(length in lines for length in _LENGTHS) else None


def watched(inner: type[asyncio.Protocol], patience: Patience, know: Know) -> type[asyncio.Protocol]:
    """A factory of protocols, each behind a :class:`Connection`; uvicorn calls it as the class ``inner``."""
    crowd = Crowd(patience.connections)
    line = Line()
    return cast("type[asyncio.Protocol]", lambda **uvicorns: Connection(inner(**uvicorns), patience, crowd, line, know))


class _Ending:
    """Where an answer ends: with its last message, or with the last byte of its Content-Length. A client that has that
    byte may send its next request before an empty last message is sent, which then looked like pipelining."""

    def __init__(self) -> None:
        self._left: int | None = None
        """Bytes of a declared length that are still to come."""
        self.is_over = False

    def told(self, message: Message) -> Message:
        """The message, as the last one if it is."""
        if message["type"] == "http.response.start":
            lengths = [int(value) for name, value in message.get("headers", ()) if name.lower() == b"content-length"]
            self._left = lengths[0] if lengths else None
        elif message["type"] == "http.response.body":
            more = message.get("more_body", False)
            if self._left is not None and more:
                self._left -= len(message.get("body", b""))
                more = self._left > 0
                message = {**message, "more_body": more}
            self.is_over = not more
        return message


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

        ending = _Ending()

        async def sent(message: Message) -> None:
            if ending.is_over:
                return
            if message["type"] == "http.response.start" and connection.is_last():
                message = {**message, "headers": [*message.get("headers", ()), (b"connection", b"close")]}
            message = ending.told(message)
            await send(message)
            if ending.is_over:
                connection.end_request()

        sized = {name: value for name, value in scope["headers"] if name in (b"content-length", b"transfer-encoding")}
        connection.begin_request(has_body=bool(sized) and sized.get(b"content-length") != b"0")
        try:
            crowded = len(scope["headers"]) > CROWDING.headers
            await (Response(status_code=431) if crowded else app)(scope, received, sent)
        finally:
            connection.end_request()

    return run
