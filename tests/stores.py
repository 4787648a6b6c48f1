"""Ballots that vehicles send to a store in tests, and its clock."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from hand_made import Cell, Say, make_ballot, states_plane
from mapvote.codec.ballot import Ballot, encode
from mapvote.core.grid import TileIndex
from mapvote.core.types import I8, NO_VOTE, CellState, MapvoteError
from mapvote_server.store.admission import Intake, Receipt
from mapvote_server.store.examination import examine
from mapvote_server.store.store import Store

NewStore = Callable[..., Store]
"""See conftest.py."""
WALL: list[Cell] = [(10, 10), (10, 11), (10, 12)]
"""The cells of the wall in each tile of :func:`hand_made.two_walls`."""


@dataclass
class Clock:
    """Clock of a store: nanoseconds since 1970. It stands until a test moves it on."""

    now: int

    def __call__(self) -> int:
        return self.now


def send(store: Store | Intake, *ballots: Ballot) -> list[Receipt]:
    """Receipts of these ballots, stored in one transaction; the first refusal is raised."""
    examined = [examine(encode(ballot)) for ballot in ballots]
    receipts = (store if isinstance(store, Intake) else Intake(store)).write(examined)
    for receipt in receipts:
        if isinstance(receipt, MapvoteError):
            raise receipt
    return [receipt for receipt in receipts if isinstance(receipt, Receipt)]


def wall_gone(fill: int = NO_VOTE, odds: I8 | None = None) -> Say:
    """The wall is not there any more; ``fill``: the state of all other cells."""
    return Say(states_plane(dict.fromkeys(WALL, CellState.CHANGED_EMPTY), fill), odds=odds)


def vote_gone(
    store: Store,
    vehicles: Iterable[str] = "ab",
    drive: str = "d1",
    tiles: Iterable[TileIndex] = ((0, 0),),
    fill: int = NO_VOTE,
    odds: I8 | None = None,
) -> None:
    """These vehicles say on the newest map that the walls of these tiles are gone."""
    base, says = store.point_map(), dict.fromkeys(tiles, wall_gone(fill, odds))
    send(store, *[make_ballot(base, says, name, drive, end_ns=store.clock()) for name in vehicles])
