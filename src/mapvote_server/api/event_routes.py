"""Events as they happen: to who listens, by server-sent events (WHATWG HTML, 9.2), and to an integrator's address by
POST, in order, repeated until they are taken, signed as Standard Webhooks.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Sequence
from datetime import UTC, datetime
from functools import partial
from typing import Annotated

import httpx2
import msgspec
import structlog
from anyio import to_thread
from fastapi import APIRouter, Header, Query, Request
from fastapi.responses import StreamingResponse
from standardwebhooks import Webhook

from mapvote_server.api.schemas import problems
from mapvote_server.api.services import Known, Parts, Services
from mapvote_server.errors import Unavailable
from mapvote_server.questions.history import Event, newest_event, take, taken_up_to, without_names

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
    parts: Parts,
    named: Known,
    after: Annotated[int | None, Query(ge=0, le=_MOST)] = None,
    last_event_id: Annotated[int | None, Header(ge=0, le=_MOST)] = None,
) -> StreamingResponse:
    """Ballots, verdicts, versions and held publishes. The id of an event is its number in the log.

    ``after`` (or ``Last-Event-ID``, which browsers send): the events after that number; else those to come. Events of
    ballots, and the names in all others, go to reviewers and operators only.
    """
    start = last_event_id if last_event_id is not None else after
    if start is None:
        start = await to_thread.run_sync(newest_event, parts.store, limiter=parts.fetching)
    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    return StreamingResponse(_stream(request, parts, start, named), media_type="text/event-stream", headers=headers)


async def _stream(request: Request, parts: Services, seq: int, named: bool) -> AsyncIterator[bytes]:
    yield b": listening\n\n"
    silent = 0.0
    while not parts.stopping.is_set() and not await request.is_disconnected():
        found = await to_thread.run_sync(parts.feed.after, seq, limiter=parts.fetching)
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


_TIMEOUT_S = 10.0
_LONGEST_S = 60.0


def signed(secret: str, events: Sequence[Event], at: datetime, body: bytes) -> dict[str, str]:
    """The headers of a post of some events (Standard Webhooks 1.0.0): the same events have the same id when they are
    sent again."""
    name = f"events_{events[0].seq}_{events[-1].seq}"
    return {
        "Content-Type": "application/json",
        "webhook-id": name,
        "webhook-timestamp": str(int(at.timestamp())),
        "webhook-signature": Webhook(secret).sign(name, at, body.decode()),
    }


async def deliver(parts: Services) -> None:
    """Post events to ``[server] webhook_url`` until it is cancelled: from the first start with that address on, and
    after a restart from where it stopped. (A server killed between an answer and its note sends the last post again.)

    A post that is not answered by 2xx is repeated, after one second, then two, four, at most sixty; none overtakes it.
    """
    asked = parts.settings.server
    ask = partial(to_thread.run_sync, limiter=parts.fetching)
    seq = noted = await ask(taken_up_to, parts.store, asked.webhook_url)
    wait = _EVERY_S
    async with httpx2.AsyncClient(timeout=_TIMEOUT_S, follow_redirects=False) as client:
        while True:
            try:
                events = await ask(parts.feed.after, seq)
                if events:
                    body = msgspec.json.encode({"map_id": parts.store.map_id, "events": events})
                    at = datetime.fromtimestamp(parts.store.clock() // 10**9, UTC)
                    headers = signed(asked.webhook_secret, events, at, body)
                    (await client.post(asked.webhook_url, content=body, headers=headers)).raise_for_status()
                    seq = events[-1].seq
                if seq != noted:
                    await ask(take, parts.store, asked.webhook_url, seq)
                    noted = seq
                wait = _EVERY_S
            except (httpx2.HTTPError, Unavailable) as error:
                structlog.get_logger("mapvote").warning("webhook", error=type(error).__name__, again_in_s=wait)
                wait = min(2 * wait, _LONGEST_S)
            await asyncio.sleep(wait)
