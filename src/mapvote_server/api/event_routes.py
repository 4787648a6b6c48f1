"""Events as they happen: to who listens, by server-sent events (WHATWG HTML, 9.2), and to an integrator's address by
POST, in order, repeated until they are taken, signed as Standard Webhooks.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Annotated

import httpx2
import msgspec
import structlog
from fastapi import APIRouter, Header, Query, Request
from fastapi.responses import StreamingResponse
from standardwebhooks import Webhook

from mapvote.core.record import record
from mapvote_server.api.connections import step_aside
from mapvote_server.api.problems import problems
from mapvote_server.api.schemas import MOST_SEQ
from mapvote_server.api.services import Known, Parts, Services
from mapvote_server.errors import TooMany, Unauthorised, Unavailable
from mapvote_server.questions.history import Event, newest_event, take, taken_up_to, without_names
from mapvote_server.store.keys import Key, any_issued


@record()
@dataclass(frozen=True, slots=True)
class ListenerTimes:
    """Times of the listeners of events."""

    poll_s: float = 1.0
    """Time between two looks for events, seconds."""
    still_there_s: float = 15.0
    """Time without an event after which a comment keeps the connection, seconds."""
    timeout_s: float = 10.0
    """Time limit of one delivery to a webhook, seconds."""
    longest_s: float = 60.0
    """Longest pause between two attempts of a delivery, seconds."""


LISTENER_TIMES = ListenerTimes()
router = APIRouter()


@router.get(
    "/v1/events",
    operation_id="listen",
    responses=problems() | {200: {"content": {"text/event-stream": {}}}},
    response_class=StreamingResponse,
    summary="What happens, as it happens",
)
async def listen(
    request: Request,
    parts: Parts,
    named: Known,
    after: Annotated[int | None, Query(ge=0, le=MOST_SEQ)] = None,
    last_event_id: Annotated[int | None, Header(ge=0, le=MOST_SEQ)] = None,
) -> StreamingResponse:
    """Ballots, verdicts, versions and held publishes. The id of an event is its number in the log.

    ``after`` (or ``Last-Event-ID``, which browsers send): the events after that number; else those to come. Events of
    ballots, and the names in all others, go to reviewers and operators only.
    """
    start = last_event_id if last_event_id is not None else after
    if start is None:
        start = await parts.look_up(newest_event, parts.store)
    key: Key | None = request.state.key
    if key is not None and parts.streams[key.name] >= parts.settings.server.streams_per_key:
        most = f"{key.name!r} listens to {parts.streams[key.name]} streams already"
        raise TooMany(f"{most} ([server] streams_per_key): end one of these first")
    step_aside()  # as long as it is listened to, other requests of its key go on
    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    stream = _counted(parts, key, _stream(request, parts, start, key, named))
    return StreamingResponse(stream, media_type="text/event-stream", headers=headers)


async def _counted(parts: Services, key: Key | None, stream: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    """The stream, counted for its key as long as it lasts."""
    if key is None:
        async for sent in stream:
            yield sent
        return
    if parts.streams[key.name] >= parts.settings.server.streams_per_key:  # others began since it was counted
        return
    parts.streams[key.name] += 1
    try:
        async for sent in stream:
            yield sent
    finally:
        parts.streams[key.name] -= 1
        if not parts.streams[key.name]:
            del parts.streams[key.name]


async def _stream(request: Request, parts: Services, seq: int, key: Key | None, named: bool) -> AsyncIterator[bytes]:
    """Events after ``seq``, until the key is revoked or expires: it is looked up after each batch was read, before the
    batch is sent."""
    yield b": listening\n\n"
    silent = 0.0
    while not parts.stopping.is_set() and not await request.is_disconnected():
        events = await parts.look_up(parts.feed.after, seq)
        if not await _still_open(parts, key, request.state.key_hash):
            return
        for event in events if named else without_names(events):
            yield as_sse(event)
        if events:
            seq = events[-1].seq
            silent = 0.0
            continue
        await asyncio.sleep(LISTENER_TIMES.poll_s)
        silent += LISTENER_TIMES.poll_s
        if silent >= LISTENER_TIMES.still_there_s:
            silent = 0.0
            yield b": still here\n\n"


async def _still_open(parts: Services, key: Key | None, key_hash: str | None) -> bool:
    """Whether the key of a stream is still good; without a key, whether the server still needs none."""
    if key is None:
        return not await parts.look_up(any_issued, parts.store)
    if key_hash is None:  # the owner of the store, in this process
        return True
    try:
        await parts.known_keys.put(key_hash)
    except Unauthorised:
        return False
    return True


def as_sse(event: Event) -> bytes:
    """One event on the wire. JSON holds no line break, so no text in it can begin another event."""
    return b"id: %d\ndata: %b\n\n" % (event.seq, msgspec.json.encode(event))


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
    configured = parts.settings.server
    seq = noted = await parts.look_up(taken_up_to, parts.store, configured.webhook_url)
    wait = LISTENER_TIMES.poll_s
    async with httpx2.AsyncClient(timeout=LISTENER_TIMES.timeout_s, follow_redirects=False) as client:
        while True:
            try:
                events = await parts.look_up(parts.feed.after, seq)
                if events:
                    body = msgspec.json.encode({"map_id": parts.store.map_id, "events": events})
                    at = datetime.fromtimestamp(parts.store.clock() // 10**9, UTC)
                    headers = signed(configured.webhook_secret, events, at, body)
                    (await client.post(configured.webhook_url, content=body, headers=headers)).raise_for_status()
                    seq = events[-1].seq
                if seq != noted:
                    await parts.look_up(take, parts.store, configured.webhook_url, seq)
                    noted = seq
                wait = LISTENER_TIMES.poll_s
            except (httpx2.HTTPError, Unavailable) as error:
                structlog.get_logger("mapvote").warning("webhook", error=type(error).__name__, again_in_s=wait)
                wait = min(2 * wait, LISTENER_TIMES.longest_s)
            await asyncio.sleep(wait)
