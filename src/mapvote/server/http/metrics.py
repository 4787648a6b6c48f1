"""The metrics of /metrics."""

from __future__ import annotations

from collections import Counter as TallyOf
from collections.abc import Sequence
from functools import lru_cache, partial
from typing import NamedTuple

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

from mapvote.server.store.integrity import KINDS


class Metrics:
    """All metrics of one server."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        counter, histogram = partial(Counter, registry=self.registry), partial(Histogram, registry=self.registry)
        self.requests = counter("mapvote_requests", "Requests answered", ["method", "status"])
        self.ballots = counter("mapvote_ballots", "Ballots acknowledged", ["result"])
        self.seconds = histogram("mapvote_request_seconds", "Time to answer", ["method"])
        self.publish_seconds = histogram("mapvote_publish_seconds", "Time to publish", buckets=(0.1, 1, 10, 60, 600))
        self.version = Gauge("mapvote_version", "Newest version", registry=self.registry)
        self.quarantined = Gauge("mapvote_quarantined", "Damaged, and set aside", ["kind"], registry=self.registry)
        self.of = lru_cache(maxsize=256)(self._of)

    def tell_damaged(self, found: Sequence[str]) -> None:
        """``found``: "kind name: why"."""
        counts = TallyOf(text.partition(" ")[0] for text in found)
        for kind in KINDS:
            self.quarantined.labels(kind).set(counts[kind])

    def text(self) -> bytes:
        """Prometheus' text format."""
        return generate_latest(self.registry)

    def _of(self, method: str, status: int) -> Counted:
        return Counted(self.requests.labels(method, status), self.seconds.labels(method))


class Counted(NamedTuple):
    """The counters of one kind of request."""

    requests: Counter
    seconds: Histogram
