"""A map loader that follows a server: a thread keeps the folder at the newest version, the caller answers requests."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from mapvote.core.record import record
from mapvote.core.types import MapvoteError
from mapvote.formats.maps.autoware import Change
from mapvote.live.log_lines import Repeated
from mapvote.live.map_loader import LoaderService


@record()
@dataclass(frozen=True, slots=True)
class FollowingTimes:
    """Times of a folder that follows a server's versions."""

    round_s: float = 0.2
    """Time of one round of the service of requests, seconds."""
    log_every_s: float = 60.0
    """Time between two log lines that no version has come yet, seconds."""


FOLLOWING_TIMES = FollowingTimes()


class Follower:
    """A thread that lays the newest version of the server's map into the folder, again and again."""

    def __init__(
        self, lay: Callable[[], Change | None], every_s: float, ended: threading.Event, say: Callable[[str], object]
    ) -> None:
        """``lay`` lays the newest version; it gives None if nothing changed, and may raise."""
        self._lay = lay
        self._every_s = every_s
        self._ended = ended
        self._say = say
        self._repeated = Repeated(say)
        self.trouble = ""
        """Why the newest version is not in the folder; "" while it is."""
        self._thread = threading.Thread(target=self._follow, name="follower", daemon=True)
        self._thread.start()

    def _follow(self) -> None:
        while not self._ended.is_set():
            try:
                change = self._lay()
                self.trouble = ""
            except Exception as error:  # the services answer on from the folder, whatever stops the thread's work
                if self._ended.is_set():
                    return  # the connection was closed
                expected = isinstance(error, (MapvoteError, OSError))
                self.trouble = str(error) if expected else f"{type(error).__name__}: {error}"
                self._repeated(self.trouble, f"{self.trouble}; the folder stays as it is")
            else:
                if change is not None:
                    tiles = f"{change.tiles} tiles, {change.written} new"
                    self._say(f"version {change.version} is in the folder: {tiles}")
            self._ended.wait(self._every_s)


def serve_followed(
    service: LoaderService, follower: Follower, ended: threading.Event, say: Callable[[str], object]
) -> None:
    """Offer the services from the first table of tiles on, and answer until ``ended``. Requests that arrived before
    are answered before this returns."""
    repeated = Repeated(say)
    told_s = time.monotonic() + 5.0
    while not ended.is_set():
        try:
            if service.refresh():
                say(f"serving {service.tiles} tiles")
        except MapvoteError as error:
            repeated("table", f"{error}; the tiles before are served")
        if not service.exists and time.monotonic() >= told_s:
            told_s = time.monotonic() + FOLLOWING_TIMES.log_every_s
            say(f"no version of the map is here yet, and no service is offered: {follower.trouble or 'it is fetched'}")
        service.serve(FOLLOWING_TIMES.round_s)
    service.close()
