"""Results of a question by tile, kept until an event touches the tile: the cost of an answer grows with the changes
since the last one.

Results stay when a question runs out of time, so the next one goes on from there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from threading import Lock
from typing import Generic, TypeVar

import sqlalchemy as sa

from mapvote.config import FuseSettings
from mapvote.core.grid import TileIndex
from mapvote_server.store.integrity import tiles_hurt_or_mended
from mapvote_server.store.policy import RoundPolicy
from mapvote_server.store.queries import newest_seq, tiles_set_between, version_of
from mapvote_server.store.retention import cleared_since
from mapvote_server.store.votes import Electorate, next_ripe_ns, standing_tiles
from mapvote_server.work import check_time

Found = TypeVar("Found")


@dataclass(frozen=True, slots=True)
class _Moment:
    """State that the kept tiles follow from."""

    mark: int
    """The last event that they know of."""
    version: int
    rules: tuple[FuseSettings, RoundPolicy]
    """Part of the policy that decides which votes count."""
    until_ns: int | None
    """When the next ballot is old enough to count; None: none waits for that."""


class KeptTiles(Generic[Found]):
    """Results of one question on each tile of one store; thread-safe.

    ``look`` gives it, None for nothing. ``came`` is told of each that is kept, ``went`` of each that is dropped: for
    sums over all tiles.
    """

    def __init__(
        self, came: Callable[[Found], None] | None = None, went: Callable[[Found], None] | None = None
    ) -> None:
        self.lock = Lock()
        """To be held while a question is asked."""
        self.found: dict[TileIndex, Found] = {}
        self._came = came
        self._went = went
        self._unread: set[TileIndex] = set()
        self._moment: _Moment | None = None

    def refresh(
        self, connection: sa.Connection, electorate: Electorate, now_ns: int, look: Callable[[TileIndex], Found | None]
    ) -> None:
        """Look at every tile that an event touched since the last time; at all of them at first, under another policy,
        and once ballots were cleared away."""
        last = self._moment
        newest = version_of(connection).number
        rules = electorate.policy.fuse, electorate.policy.round
        moment = _Moment(newest_seq(connection), newest, rules, next_ripe_ns(connection, electorate))
        ripe = last is not None and last.until_ns is not None and now_ns >= last.until_ns
        if last is None or last.rules != moment.rules or ripe or cleared_since(connection, last.mark):
            self._unread = {*self.found, *standing_tiles(connection, moment.mark)}
        elif last.mark != moment.mark:
            self._unread |= {*standing_tiles(connection, moment.mark, last.mark)}
            self._unread |= tiles_hurt_or_mended(connection, last.mark)
            self._unread |= {*tiles_set_between(connection, last.version, newest)}
        self._moment = moment
        for index in sorted(self._unread):
            check_time()
            self._put(index, look(index))
            self._unread.discard(index)

    def _put(self, index: TileIndex, answer: Found | None) -> None:
        before = self.found.pop(index, None)
        if before is not None and self._went is not None:
            self._went(before)
        if answer is not None:
            self.found[index] = answer
            if self._came is not None:
                self._came(answer)
