"""Events as they happen, by server-sent events (WHATWG HTML, 9.2)."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Annotated

import msgspec
from anyio import to_thread
from fastapi import APIRouter, Header, Query, Request
from fastapi.responses import StreamingResponse

from mapvote.server.http.auth import sees_names
from mapvote.server.http.schemas import problems
from mapvote.server.http.services import Services, services
from mapvote.server.views.events import Event, newest_event, without_names

_EVERY_S = 1.0
_STILL_THERE_S = 15.0
_MOST = (1 << 62) - 1
router = APIRouter()


@router.get(
    "/v1/events",
    responses=problems() | {200: {"content": {"text/event-stream": {}}}},
    response_class=StreamingResponse,
    summary="What happens, as it happens",
)
async def listen(
    request: Request,
    after: Annotated[int | None, Query(ge=0, le=_MOST)] = None,
    last_event_id: Annotated[int | None, Header(ge=0, le=_MOST)] = None,
) -> StreamingResponse:
    """Ballots, verdicts, versions and held publishes. The id of an event is its number in the log.

    ``after`` (or ``Last-Event-ID``, which browsers send): the events after that number; else those to come. Events of
    ballots, and the names in all others, go to reviewers and operators only.
    """
    parts, named = services(request), sees_names(request)
    start = last_event_id if last_event_id is not None else after
    if start is None:
        start = await to_thread.run_sync(newest_event, parts.store, limiter=parts.threads.fetching)
    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    return StreamingResponse(_told(request, parts, start, named), media_type="text/event-stream", headers=headers)


async def _told(request: Request, parts: Services, seq: int, named: bool) -> AsyncIterator[bytes]:
    yield b": listening\n\n"
    silent = 0.0
    while not parts.stopping.is_set() and not await request.is_disconnected():
        found = await to_thread.run_sync(parts.feed.after, seq, limiter=parts.threads.fetching)
        for event in found if named else without_names(found):
            yield as_sse(event)
        if found:
            seq, silent = found[-1].seq, 0.0
            continue
        await asyncio.sleep(_EVERY_S)
        silent += _EVERY_S
        if silent >= _STILL_THERE_S:
            silent = 0.0
            yield b": still here\n\n"


def as_sse(event: Event) -> bytes:
    """One event on the wire. JSON holds no line break, so no text in it can begin another event."""
    return b"id: %d\ndata: %b\n\n" % (event.seq, msgspec.json.encode(event))
