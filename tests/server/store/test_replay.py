"""Un-vote after publication: the map becomes, byte for byte, that of a history without the vehicle."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from command_line import typed
from hand_made import Cell, Say, make_ballot, states_plane, two_walls, wall, words_plane
from mapvote.config import FuseSettings
from mapvote.core.point_map import PointMap
from mapvote.core.types import CellState, MapvoteError
from mapvote_server.errors import Conflict, NotFound
from mapvote_server.store.publish import publish, write_version
from mapvote_server.store.rollback import replay, rollback
from mapvote_server.store.store import Store
from stores import send

EMPTY, BUILT, KEEPS = CellState.CHANGED_EMPTY, CellState.CHANGED_OCCUPIED, CellState.UNCHANGED_OCCUPIED
WALL: list[Cell] = [(10, 10), (10, 11), (10, 12)]
LAWN: list[Cell] = [(20, 20), (20, 21)]
POND: Cell = (30, 30)
FAR: Cell = (200, 200)
POLICY = FuseSettings(max_deleted_share=1.0)
_number = itertools.count()
Clock = Callable[[], int]


def ticking() -> Clock:
    """A clock that goes on by a second whenever it is read: two stores that do the same agree on every time."""
    seconds = itertools.count(1_700_000_000)
    return lambda: next(seconds) * 10**9


def say(states: dict[Cell, int], shift: float = 0.0) -> Say:
    """States, points where something was built (``shift`` m off), and voxels seen free. The far cell always counts."""
    built = [cell for cell, state in states.items() if state == BUILT]
    points = wall(built, [0.45, 0.75]) + np.float32(shift) if built else None
    free = words_plane(dict.fromkeys(states, 0b111000))
    return Say(states_plane({FAR: CellState.UNCHANGED_EMPTY, **states}), new_points=points, free=free)


def cast(store: Store, base: PointMap, vehicle: str, says: Say, drive: str = "d", end_s: int = 1_700_000_000) -> None:
    send(store, make_ballot(base, {(0, 0): says}, vehicle, drive, end_ns=end_s * 10**9))


def content(store: Store) -> dict[tuple[int, int], tuple[bytes, bytes, bytes | None]]:
    """The newest version, byte for byte."""
    return {
        index: (tile.points.tobytes(), tile.ground_z.tobytes(), None if tile.free is None else tile.free.tobytes())
        for index, tile in store.point_map().tiles.items()
    }


def a_year(store: Store, liar: bool) -> None:
    """Three rounds and a rollback. With the liar walls fall that should stand, and something stands in the pond."""
    base = store.point_map(1)

    def sends(vehicle: str, says: Say, drive: str) -> None:
        if vehicle != "liar" or liar:
            cast(store, base, vehicle, says, drive)

    sends("liar", say({WALL[0]: EMPTY, LAWN[0]: BUILT}, shift=0.1), "d1")
    sends("a", say({WALL[0]: EMPTY, LAWN[0]: BUILT}), "d1")
    sends("b", say({WALL[1]: EMPTY, LAWN[0]: BUILT}, shift=0.02), "d1")
    sends("c", say({WALL[1]: EMPTY}), "d1")
    publish(store, POLICY)
    sends("liar", say({WALL[2]: EMPTY}), "d2")
    sends("d", say({WALL[2]: EMPTY}), "d1")
    publish(store, POLICY)
    rollback(store, 1)
    sends("e", say({WALL[1]: EMPTY, LAWN[1]: BUILT}), "d1")
    sends("f", say({WALL[1]: EMPTY, LAWN[1]: BUILT, POND: BUILT}), "d1")
    sends("liar", say({LAWN[1]: BUILT, POND: BUILT}, shift=0.1), "d3")
    publish(store, POLICY)


@pytest.fixture
def store(database_url: str) -> Iterator[Store]:
    store = Store.create(database_url, two_walls(), clock=ticking())
    yield store
    store.close()


@pytest.fixture
def honest(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """The same year without the liar."""
    file = tmp_path_factory.mktemp("honest") / "store.db"
    store = Store.create(f"sqlite:///{file}", two_walls(), clock=ticking())
    a_year(store, liar=False)
    yield store
    store.close()


@pytest.mark.contract
def test_the_map_becomes_that_of_a_history_without_the_vehicle(store: Store, honest: Store) -> None:
    a_year(store, liar=True)
    newest = store.current()
    assert content(store) != content(honest), "the liar has left a mark, or nothing is tested here"
    shown = replay(store, "liar")
    assert (shown.version, shown.published) == (newest, False)
    assert store.current() == newest
    with ThreadPoolExecutor(2) as executor:
        done = replay(store, "liar", dry_run=False, executor=executor)
    assert (done.version, done.published, done.tiles) == (newest + 1, True, shown.tiles)
    assert (done.points_added, done.points_deleted) == (shown.points_added, shown.points_deleted)
    assert content(store) == content(honest)
    assert set(store.point_map(newest).tiles) == set(two_walls().tiles), "older versions can still be read whole"
    version = store.versions()[-1]
    assert (version.kind, version.policy) == ("replay", {"unvoted": "liar"})
    assert not publish(store, POLICY).published, "nothing of the liar is left to publish"
    with pytest.raises(NotFound, match="never voted"):
        replay(store, "nobody")


def test_publishing_meanwhile_is_a_conflict(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    a_year(store, liar=True)

    def late(*arguments: object, **more: object) -> object:
        monkeypatch.undo()
        rollback(store, 1)
        return write_version(*arguments, **more)  # type: ignore[arg-type]

    monkeypatch.setattr("mapvote_server.store.rollback.write_version", late)
    with pytest.raises(Conflict, match="somebody else"):
        replay(store, "liar", dry_run=False)
    assert store.versions()[-1].kind == "rollback"


def test_from_the_command_line(store: Store, honest: Store, database_url: str) -> None:
    a_year(store, liar=True)
    newest, before = store.current(), content(store)
    name = database_url.removeprefix("sqlite:///")
    run = partial(typed, "unvote", name)
    shown = run("liar", "--replay")
    assert "only shown: --yes publishes it" in shown
    assert (store.current(), content(store)) == (newest, before)
    assert f"version {newest + 1} (published)" in run("liar", "--replay", "--yes")
    assert content(store) == content(honest)
    with pytest.raises(MapvoteError, match="leave out --drive"):
        run("liar", "--replay", "--drive", "d1")


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=5, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_history(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    """Random rounds of six vehicles, with publishes and rollbacks in between, all on the first map."""
    folder, number = tmp_path_factory.mktemp("any"), next(_number)
    stores = [Store.create(f"sqlite:///{folder / f'{number}_{i}.db'}", two_walls(), clock=ticking()) for i in range(2)]
    base, rng = two_walls(), random.Random(seed)
    for step in range(14):
        what = rng.choice(["vote", "vote", "vote", "publish", "rollback"])
        vehicle, shift = rng.choice(["liar", "a", "b", "c", "d", "e"]), rng.uniform(0.0, 0.05)
        states: dict[Cell, int] = {cell: rng.choice([EMPTY, KEEPS]) for cell in WALL}
        states |= {cell: BUILT for cell in LAWN if rng.random() < 0.5}
        if what == "vote":
            for store in stores if vehicle != "liar" else stores[:1]:
                cast(store, base, vehicle, say(states, shift), f"d{step}", 1_700_000_000 + step)
        elif what == "publish":
            if publish(stores[0], POLICY).published:  # what made no version is not history
                publish(stores[1], POLICY)
        elif stores[0].current() > 1:
            rollback(stores[0], 1)
            with suppress(Conflict):  # without the liar there is nothing to roll back
                rollback(stores[1], 1)
    with suppress(NotFound):  # the liar kept silent
        replay(stores[0], "liar", dry_run=False)
    assert content(stores[0]) == content(stores[1])
    for store in stores:
        store.close()
