"""What is done before anybody asks: what the first ballot needs is loaded, and the coarse picture of the newest version
is made, so that whoever opens the page need not wait for it."""

from __future__ import annotations

import asyncio
import gc
from contextlib import suppress

import numpy as np
import structlog
from anyio import to_thread

from mapvote.codec.ballot import check_states
from mapvote.core.types import NO_VOTE, MapvoteError
from mapvote.server.errors import Unavailable
from mapvote.server.http.services import Services

_EVERY_S = 2.0


def settle() -> None:
    """Load what the first ballot would wait for, and keep all that is loaded out of the garbage collector's sight.

    It stops every thread while it goes through all there is, a quarter of a second on a busy machine, and libraries
    are nearly all of that.
    """
    check_states(np.full(1, NO_VOTE, dtype=np.uint8))
    gc.collect()
    gc.freeze()


async def keep_overview(parts: Services) -> None:
    """Make the overview of each new version, until it is cancelled; no tile is begun once the server stops."""
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
    except MapvoteError as error:  # damaged beyond a tile: whoever asks for the picture is told
        structlog.get_logger("mapvote").warning("overview", version=version, error=str(error)[:200])
