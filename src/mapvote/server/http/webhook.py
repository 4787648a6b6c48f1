"""Events by POST to an integrator's address, in order, repeated until they are taken, signed as Standard Webhooks."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from datetime import UTC, datetime
from functools import partial

import httpx2
import msgspec
import structlog
from anyio import to_thread
from standardwebhooks import Webhook

from mapvote.server.errors import Unavailable
from mapvote.server.http.services import Services
from mapvote.server.views.events import Event, take, taken_up_to

_EVERY_S = 1.0
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
    ask = partial(to_thread.run_sync, limiter=parts.threads.fetching)
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
