"""The coarse picture of the newest version, made before anybody asks: whoever opens the page need not wait for it."""

from __future__ import annotations

import asyncio
from contextlib import suppress

import structlog
from anyio import to_thread

from mapvote.core.types import MapvoteError
from mapvote.server.errors import Unavailable
from mapvote.server.http.services import Services

_EVERY_S = 2.0


async def keep_overview(parts: Services) -> None:
    """Make the overview of each new version, until it is cancelled; one tile at a time, and no more once the server
    stops."""
    known = None
    while True:
        with suppress(Unavailable):
            newest = await parts.newest.put(None)
            if newest != known:
                known = newest
                await _make(parts, newest)
        await asyncio.sleep(_EVERY_S)


async def _make(parts: Services, version: int) -> None:
    try:
        make, stop = parts.clouds.overview, parts.stopping.is_set
        await to_thread.run_sync(make, version, stop, limiter=parts.threads.fetching)
    except Unavailable:
        raise
    except MapvoteError as error:  # a damaged tile: whoever asks for the picture is told
        structlog.get_logger("mapvote").warning("overview", version=version, error=str(error)[:200])
