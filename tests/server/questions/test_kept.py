"""Kept results equal new ones, whatever has happened since: random histories of a street."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import sqlalchemy as sa
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hand_made import Cell, Say, make_ballot, make_map, make_tile, states_plane, wall
from mapvote.codec.ballot import pack_path
from mapvote.codec.planes import unpack_bytes
from mapvote.codec.tile_planes import TILE_PLANE_SIZES
from mapvote.config import FuseSettings
from mapvote.core.grid import TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.types import CellState, MapvoteError
from mapvote.fusion.tile_vote import DAY_NS
from mapvote_server.questions.changes import changes_between
from mapvote_server.questions.coverage import waiting_votes, wanted_passes
from mapvote_server.questions.freshness import tiles_seen
from mapvote_server.questions.vehicles import vehicle_standings
from mapvote_server.store import schema
from mapvote_server.store.integrity import check, restore_plane
from mapvote_server.store.keys import issue, revoke
from mapvote_server.store.policy import KeepPolicy, Policy
from mapvote_server.store.publish import publish
from mapvote_server.store.queries import oldest_kept
from mapvote_server.store.retention import clear
from mapvote_server.store.reviews import decide, standing, undo
from mapvote_server.store.rollback import replay, rollback
from mapvote_server.store.store import Store
from mapvote_server.store.votes import withdraw
from stores import Clock, send

TILES: list[TileIndex] = [(0, 0), (0, 1), (0, 2)]
WALL: list[Cell] = [(10, c) for c in range(10, 15)]
LAWN: list[Cell] = [(30, c) for c in range(10, 15)]
START_NS = 1_700_000_000 * 10**9


def oldest_of(store: Store) -> int:
    with store.database.reading() as connection:
        return oldest_kept(connection)


QUESTIONS: dict[str, Callable[[Store], object]] = {
    "vehicles": vehicle_standings,
    "coverage": lambda store: tiles_seen(store, True),
    "coverage by days": lambda store: tiles_seen(store, False),
    "waiting votes": waiting_votes,
    "wanted passes": wanted_passes,
    "changes": lambda store: changes_between(store, oldest_of(store), store.current()),
}
"""All that answer from what they kept."""
SAYS = {
    "nothing": ([], CellState.UNCHANGED_EMPTY),
    "wall gone": (WALL, CellState.CHANGED_EMPTY),
    "wall built": (WALL, CellState.CHANGED_OCCUPIED),
    "lawn built on": (LAWN, CellState.CHANGED_OCCUPIED),
}
"""The cells that a vehicle says have changed, and how."""
Step = tuple[Any, ...]


def street() -> PointMap:
    points = np.concatenate([wall(WALL + LAWN, [0.05]), wall(WALL, [0.45, 0.75, 1.05])])
    return make_map({index: make_tile(points, index=index) for index in TILES})


class Street:
    """A store that is asked again and again, and never forgets what it found."""

    def __init__(self, store: Store, clock: Clock) -> None:
        self.store = store
        self.clock = clock
        self.lost: dict[str, bytes] = {}

    def vote(self, vehicle: str, drive: str, tiles: list[TileIndex], says: str, days_ago: int = 0) -> None:
        """A drive that passed so many days ago says that the wall or the lawn changed, or that nothing did."""
        base = self.store.point_map()
        states = states_plane(dict.fromkeys(WALL, CellState.UNCHANGED_OCCUPIED), fill=CellState.UNCHANGED_EMPTY)
        changed, state = SAYS[says]
        for cell in changed:
            states[cell] = state
        points = wall(changed, [0.4547, 0.7547]) if state == CellState.CHANGED_OCCUPIED else None
        say = Say(states, new_points=points)
        end_ns = self.clock.now - days_ago * DAY_NS
        ballot = make_ballot(base, dict.fromkeys(tiles, say), vehicle, drive, end_ns)
        if vehicle != "d":  # whose ballots do not say where it drove
            x = np.arange(76.8 * tiles[0][1] + 1.0, 76.8 * (tiles[0][1] + 1), 4.0)
            path = pack_path([np.array([at, 6.0]) for at in x], base.lattice)
            ballot = msgspec.structs.replace(ballot, path=path)
        send(self.store, ballot)

    def publish(self) -> None:
        publish(self.store, override=True)

    def roll_back(self, by: int) -> None:
        if self.store.current() > 1:
            rollback(self.store, max(1, self.store.current() - by))

    def withdraw(self, vehicle: str) -> None:
        withdraw(self.store, vehicle, by="operator")

    def replay(self, vehicle: str) -> None:
        replay(self.store, vehicle, dry_run=False)

    def revoke(self, vehicle: str, keep_votes: bool) -> None:
        issue(self.store, vehicle, "vehicle")
        revoke(self.store, vehicle, keep_votes=keep_votes)

    def policy(self, quorum: int, latest: int, age_days: float, min_age_days: float) -> None:
        fuse = FuseSettings(
            min_votes=quorum, latest_vehicles=latest, max_age_days=age_days, min_age_s=min_age_days * 86_400,
            prior_stay_days=27.0,
        )  # fmt: skip
        self.store.set_policy(Policy(fuse=fuse))

    def clear(self, versions: int) -> None:
        self.store.change_policy({"keep.versions": versions})
        clear(self.store, dry_run=False)

    def review(self, verdict: Any, tile: TileIndex) -> None:
        cells = np.zeros((256, 256), dtype=np.bool_)
        cells[tuple(zip(*WALL, strict=True))] = True
        decide(self.store, verdict, {"id": "x", "properties": {"kind": "demolished"}}, {tile: cells}, by="anna")

    def take_back(self) -> None:
        for one, _ in standing(self.store):
            undo(self.store, one.given.seq, by="anna")

    def spoil_ballot(self, which: int) -> None:
        """A ballot on a tile is not what was sent any more, and a check says so."""
        t = schema.ballot_tiles
        with self.store.database.writing() as connection:
            rows = connection.execute(sa.select(t.c.ballot, t.c.row, t.c.col).order_by(t.c.ballot, t.c.col)).all()
            if rows:
                ballot, row, col = rows[which % len(rows)]
                here = (t.c.ballot == ballot) & (t.c.row == row) & (t.c.col == col)
                connection.execute(t.update().where(here).values(votes=b"spoilt"))
        check(self.store, mend=True)

    def lose_plane(self, which: int) -> None:
        """A plane that the map shows is lost, a check says so, and another quorum makes the server read it."""
        b = schema.blobs
        with self.store.database.writing() as connection:
            shown = [hashes.points for hashes in self.store.tiles(self.store.current()).values()]
            digest = shown[which % len(shown)]
            data = bytes(connection.execute(sa.select(b.c.data).where(b.c.hash == digest)).scalar_one())
            if digest not in self.lost:
                self.lost[digest] = unpack_bytes(data, TILE_PLANE_SIZES.plane_bytes, "plane")
            connection.execute(b.update().where(b.c.hash == digest).values(data=b"spoilt"))
        check(self.store, mend=True)
        self.store.change_policy({"fuse.min_votes": 1 + self.store.policy().fuse.min_votes % 3})

    def mend(self) -> None:
        """Lost planes are put back."""
        for digest, raw in self.lost.items():
            restore_plane(self.store, digest, raw, by="operator")

    def wait(self, days: int) -> None:
        self.clock.now += days * DAY_NS


vehicles, numbers = st.sampled_from("abcd"), st.integers(0, 7)
some_tiles = st.lists(st.sampled_from(TILES), min_size=1, unique=True).map(sorted)
says = st.sampled_from(["wall gone", *SAYS])
votes = st.tuples(
    st.just("vote"), vehicles, st.sampled_from(["d1", "d2"]), some_tiles, says, st.sampled_from([0, 1, 5, 40])
)
events: st.SearchStrategy[Step] = st.one_of(
    votes,
    votes,
    votes,
    st.tuples(st.just("publish")),
    st.tuples(st.just("roll_back"), st.integers(1, 3)),
    st.tuples(st.just("withdraw"), vehicles),
    st.tuples(st.just("replay"), vehicles),
    st.tuples(st.just("revoke"), vehicles, st.booleans()),
    st.tuples(
        st.just("policy"), st.integers(1, 3), st.integers(1, 4), st.sampled_from([2.0, 30.0]), st.sampled_from([0, 3])
    ),
    st.tuples(st.just("clear"), st.integers(1, 2)),
    st.tuples(st.just("review"), st.sampled_from(["held", "rejected", "accepted"]), st.sampled_from(TILES)),
    st.tuples(st.just("take_back")),
    st.tuples(st.just("spoil_ballot"), numbers),
    st.tuples(st.just("lose_plane"), numbers),
    st.tuples(st.just("mend")),
    st.tuples(st.just("wait"), st.sampled_from([1, 4, 60])),
)
histories = st.lists(st.tuples(events, st.sampled_from([True, True, False])), min_size=1, max_size=14)


@pytest.fixture(scope="module")
def template() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "first.db"
        policy = Policy(fuse=FuseSettings(prior_stay_days=27.0), keep=KeepPolicy())
        Store.create(f"sqlite:///{file}", street(), policy, clock=Clock(START_NS)).close()
        yield file


@contextmanager
def opened(file: Path, clock: Clock) -> Iterator[Store]:
    store = Store.open(f"sqlite:///{file}", clock=clock)
    try:
        yield store
    finally:
        store.close()


def live(template: Path, history: list[tuple[Step, bool]]) -> None:
    """Every step, after which what was kept is compared with what a store finds that has kept nothing; after some
    steps nobody asks."""
    with tempfile.TemporaryDirectory() as folder:
        file, clock = Path(folder) / "store.db", Clock(START_NS)
        shutil.copy(template, file)
        with opened(file, clock) as store:
            street = Street(store, clock)
            for number, ((name, *given), is_asked) in enumerate(history):
                clock.now += 60 * 10**9
                with suppress(MapvoteError):  # nothing to withdraw, or cleared away, or reviewed already
                    getattr(street, name)(*given)
                if not is_asked and number < len(history) - 1:
                    continue
                with opened(file, clock) as fresh:
                    for what, question in QUESTIONS.items():
                        assert question(store) == question(fresh), f"{what} after step {number}, {name}"


@given(histories)
@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_what_is_kept_is_what_would_be_found_anew(template: Path, history: list[tuple[Step, bool]]) -> None:
    live(template, history)


@pytest.mark.slow
@given(histories)
@settings(max_examples=int(os.environ.get("HISTORIES", "60")), deadline=None, suppress_health_check=list(HealthCheck))
def test_what_is_kept_is_what_would_be_found_anew_in_many_histories(
    template: Path, history: list[tuple[Step, bool]]
) -> None:
    live(template, history)


FIRST = [(0, 0)]
LACKS_ONE: Step = ("vote", "a", "d1", FIRST, "wall gone")
"""The wall is gone, by one of the two vehicles that it takes."""
GONE: list[Step] = [LACKS_ONE, ("vote", "b", "d1", FIRST, "wall gone"), ("publish",)]
MATTER: dict[str, tuple[list[Step], Step]] = {
    "a ballot": ([LACKS_ONE], ("vote", "b", "d1", FIRST, "wall gone")),
    "a ballot on a new tile": ([LACKS_ONE], ("vote", "b", "d1", [(0, 1)], "wall gone")),
    "a ballot in the place of another": ([LACKS_ONE], ("vote", "a", "d1", FIRST, "nothing")),
    "a withdrawal": ([LACKS_ONE], ("withdraw", "a")),
    "a revoked key": ([LACKS_ONE], ("revoke", "a", False)),
    "a vehicle taken out": ([LACKS_ONE], ("replay", "a")),
    "a larger quorum": ([LACKS_ONE], ("policy", 3, 4, 30.0, 0)),
    "a shorter window": ([LACKS_ONE, ("vote", "b", "d1", FIRST, "lawn built on", 5)], ("policy", 2, 4, 2.0, 0)),
    "a ballot that ripens": ([("policy", 2, 4, 30.0, 3), LACKS_ONE], ("wait", 4)),
    "a rollback": ([*GONE, ("wait", 1), ("vote", "c", "d1", FIRST, "wall built")], ("roll_back", 1)),
    "a hold": ([LACKS_ONE], ("review", "held", (0, 0))),
    "a hold taken back": ([LACKS_ONE, ("review", "held", (0, 0))], ("take_back",)),
    "a damaged ballot": ([LACKS_ONE], ("spoil_ballot", 0)),
    "a damaged ballot that counted": (GONE, ("spoil_ballot", 0)),
    "a plane put back": ([LACKS_ONE, ("lose_plane", 0)], ("mend",)),
    "a withdrawal where a plane is lost": ([LACKS_ONE, ("lose_plane", 0)], ("withdraw", "a")),
    "a ballot cleared away": (
        [("vote", "a", "d1", FIRST, "nothing", 1_000), ("vote", "b", "d1", FIRST, "wall gone"),
         ("vote", "b", "d2", [(0, 2)], "wall gone"), ("vote", "c", "d2", [(0, 2)], "wall gone"), ("publish",)],
        ("clear", 1),
    ),
    "a liar who is withdrawn": (
        [("vote", name, "d1", FIRST, says, days) for days, (name, says) in
         enumerate([("d", "nothing"), ("c", "nothing"), ("b", "wall gone"), ("a", "nothing"), ("d", "nothing")])],
        ("withdraw", "b"),
    ),
}  # fmt: skip
"""Steps to an event that changes an answer, and the event."""


@pytest.mark.parametrize("event", MATTER)
def test_what_an_event_changes_is_found_anew(event: str, template: Path) -> None:
    history, (name, *given) = MATTER[event]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(shutil.copy(template, Path(folder) / "store.db"))
        clock = Clock(START_NS)
        with opened(file, clock) as store, opened(file, clock) as fresh:
            street = Street(store, clock)
            for before, *more in history:
                getattr(street, before)(*more)
            earlier = [question(store) for question in QUESTIONS.values()]
            getattr(street, name)(*given)
            now = [question(store) for question in QUESTIONS.values()]
            assert now != earlier, "the event matters"
            assert now == [question(fresh) for question in QUESTIONS.values()]
