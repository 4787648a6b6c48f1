"""Autoware's map services over DDS, as rmw_cyclonedds has them: a request topic and a reply topic for each.

Before the members of a request, and of its reply, stand 16 bytes: the client's number (uint64) and the number of the
request (int64). The reply repeats both; by them a client knows its own. Read at rmw_cyclonedds' master of 2026-08.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from typing import Any

from mapvote.core.types import MapvoteError
from mapvote.live.cdr import blank_message, from_cdr, to_cdr
from mapvote.live.dds import Network, Publication, Subscription
from mapvote.live.map_loader import HASH, HASH_TOPIC, SERVICES, TABLE, TABLE_TOPIC, MapLoader

log = logging.getLogger("mapvote.live")
_DEPTH = 10


class LoaderService:
    """The services and topics of a map loader, on one network."""

    def __init__(self, network: Network, loader: MapLoader, services: Mapping[str, str] = SERVICES) -> None:
        """``services``: by type, the name of each that is offered."""
        self._network, self._loader, self.answered = network, loader, 0
        self._ends: list[tuple[str, Subscription, Publication]] = []
        for kind, name in services.items():
            requests = network.subscribe(f"rq{name}Request", f"{kind}_Request", reliable=True, depth=_DEPTH)
            replies = network.publish(f"rr{name}Reply", f"{kind}_Response", depth=_DEPTH)
            self._ends.append((kind, requests, replies))
        self._hash = network.publish(HASH_TOPIC, HASH, transient_local=True, depth=1)
        self._table = network.publish(TABLE_TOPIC, TABLE, transient_local=True, depth=1)

    def show(self) -> None:
        """Publish which map this is: its hash and its table, for those who come later, too."""
        self._hash.send(to_cdr(HASH, blank_message(HASH, pcd=self._loader.hash())))
        self._table.send(to_cdr(TABLE, self._loader.table(time.time_ns())))

    def serve(self, seconds: float) -> None:
        """Answer what was asked, or wait so long for a request."""
        self._network.wait(seconds)
        for kind, requests, replies in self._ends:
            for data in requests.take():
                try:
                    request = from_cdr(f"{kind}_Request", data)
                except MapvoteError as error:
                    log.warning("%s", error)
                    continue
                replies.send(to_cdr(f"{kind}_Response", self._answered(kind, request)))
                self.answered += 1

    def _answered(self, kind: str, request: Any) -> Any:
        return blank_message(
            f"{kind}_Response", guid=request.guid, seq=request.seq, **self._loader.answer(kind, request)
        )
