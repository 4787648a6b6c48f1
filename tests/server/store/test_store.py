"""The store's promises, on SQLite and on PostgreSQL."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

from hand_made import SETTINGS, Say, make_ballot, states_plane, two_walls
from mapvote.codec.ballot import Ballot
from mapvote.config import FuseSettings
from mapvote.core.point_map import PointMap
from mapvote.core.types import CellState, MapvoteError
from mapvote.fusion.tile_vote import DAY_NS
from mapvote_server.errors import Conflict, Held, NotFound, Unavailable
from mapvote_server.store.policy import (
    GatePolicy,
    Policy,
    RoundPolicy,
    changed,
)
from mapvote_server.store.publish import preview, publish
from mapvote_server.store.rollback import rollback
from mapvote_server.store.store import Store
from stores import send

EMPTY, KEEPS = CellState.CHANGED_EMPTY, CellState.UNCHANGED_OCCUPIED
POLICY = FuseSettings(min_votes=2)
CELL, NEXT = (10, 10), (10, 11)
_count = itertools.count()


@pytest.fixture
def store(database_url: str) -> Iterator[Store]:
    store = Store.create(database_url, two_walls())
    yield store
    store.close()


def says(
    point_map: PointMap,
    vehicle: str,
    state: int,
    cell: tuple[int, int] = CELL,
    day: float = 0,
    **more: object,
) -> Ballot:
    drive = str(more.pop("drive", f"d{next(_count)}"))
    say = {(0, 0): Say(states_plane({cell: state}))}
    return make_ballot(point_map, say, vehicle, drive, end_ns=DAY_NS + round(day * DAY_NS), **more)  # type: ignore[arg-type]


def heights(store: Store, cell: tuple[int, int] = CELL) -> int:
    """Obstacle points of a cell of tile (0, 0) in the newest version."""
    points = store.point_map().tiles[0, 0].points
    inside = (np.floor(points[:, 1] / 0.3) == cell[0]) & (np.floor(points[:, 0] / 0.3) == cell[1])
    return int((inside & (points[:, 2] > 0.3)).sum())


@pytest.mark.contract
def test_a_map_survives_the_store(store: Store) -> None:
    before, after = two_walls(), store.point_map()
    assert after.map_id == before.map_id
    assert after.lattice == before.lattice
    for index, tile in before.tiles.items():
        assert after.tiles[index].points.tobytes() == tile.points.tobytes()
        assert after.tiles[index].ground_z.tobytes() == tile.ground_z.tobytes()


@pytest.mark.contract
def test_two_vehicles_take_a_wall_down_and_the_manifest_says_what_changed(store: Store) -> None:
    base = store.point_map()
    send(store, says(base, "a", EMPTY), says(base, "b", EMPTY))
    outcome = publish(store, POLICY)
    assert (outcome.version, outcome.published, outcome.points_deleted) == (2, True, 3)
    assert heights(store) == 0
    assert heights(store, NEXT) == 3
    assert list(store.manifest(since=1).tiles) == ["0,0"]
    assert store.manifest(since=2).tiles == {}
    assert not publish(store, POLICY).published
    assert len(store.point_map(1).tiles[0, 0].points) == len(base.tiles[0, 0].points)


def test_an_unknown_version_is_an_error_not_an_empty_list(store: Store) -> None:
    for ask in (lambda: store.manifest(7), lambda: store.manifest(since=7), lambda: store.tile(0, (0, 0))):
        with pytest.raises(NotFound, match="newest is 1"):
            ask()


@pytest.mark.contract
def test_sending_twice_is_harmless_and_sending_again_replaces(store: Store) -> None:
    base = store.point_map()
    first = says(base, "a", EMPTY, drive="d")
    assert send(store, first)[0].result == "created"
    assert send(store, first)[0].result == "repeated"
    send(store, says(base, "b", EMPTY))
    again = send(store, says(base, "a", KEEPS, drive="d"))[0]
    assert again.result == "replaced"
    assert not publish(store, POLICY).published


def test_a_vote_on_what_has_changed_since_counts_no_more(store: Store) -> None:
    base = store.point_map()
    send(store, says(base, "a", EMPTY), says(base, "b", EMPTY))
    publish(store, POLICY)
    with pytest.raises(Conflict, match="has changed since version 1"):
        send(store, says(base, "c", EMPTY))
    with pytest.raises(Conflict, match="is not that of version 1"):
        send(store, says(base, "c", EMPTY, NEXT, base={(0, 0): "f" * 64}))
    with pytest.raises(Conflict, match="no version 7 yet"):
        send(store, says(base, "c", EMPTY, NEXT, version=7))


def test_a_rollback_does_not_come_back_by_itself_but_by_new_votes(store: Store) -> None:
    base = store.point_map()
    old = [says(base, v, EMPTY) for v in "ab"]
    send(store, *old)
    publish(store, POLICY)
    version = rollback(store, 1, reason="it still stands")
    assert (version.number, version.kind, version.target) == (3, "rollback", 1)
    assert heights(store) == 3
    assert store.tiles(3) == store.tiles(1)
    assert (list(store.manifest(since=2).tiles), store.manifest(since=1).tiles) == (["0,0"], {})
    send(store, *old)
    assert not publish(store, POLICY).published
    base = store.point_map()
    send(store, says(base, "c", EMPTY, day=1))
    assert not publish(store, POLICY).published
    send(store, says(base, "d", EMPTY, day=1))
    assert publish(store, POLICY).published
    assert heights(store) == 0


@pytest.mark.parametrize("other", [{"method": "paper"}, {"settings_hash": "0" * 64}])
def test_the_policy_says_how_a_round_votes_and_never_mixes(store: Store, other: Any) -> None:
    """Whoever comes first, right or wrong, decides nothing for the others. With another policy old votes rest."""
    first = RoundPolicy(settings_hash=SETTINGS)
    store.set_policy(Policy(round=first))
    base = store.point_map()
    for vehicle in "ca":
        with pytest.raises(Conflict, match=r"accepts only .*\. Vote again with the fleet's configuration"):
            send(store, says(base, vehicle, EMPTY, **other))
    send(store, says(base, "a", EMPTY))
    wanted = {"method": "paper"} if "method" in other else {"settings_hash": "0" * 16}
    store.set_policy(Policy(round=first.model_copy(update=wanted)), by="ann", reason="a new release")
    with pytest.raises(Conflict, match="accepts only"):
        send(store, says(base, "b", EMPTY))
    send(store, says(base, "c", EMPTY, **other))
    assert not publish(store, POLICY).published, "a's vote was cast otherwise"
    send(store, says(base, "d", EMPTY, **other))
    assert publish(store, POLICY).points_deleted == 3
    assert [(change.by, change.reason) for change in store.policy_changes()][-1] == ("ann", "a new release")


@pytest.mark.contract
def test_a_policy_is_changed_by_name_and_a_wrong_name_is_told(store: Store) -> None:
    policy = changed(store.policy(), {"fuse.min_votes": "3", "round.stage": "one-stage"})
    assert (policy.fuse.min_votes, policy.round.stage) == (3, "one-stage")
    with pytest.raises(MapvoteError, match=r"did you mean 'fuse\.min_votes'"):
        changed(policy, {"fuse.min_vote": 3})
    nobody_means = {"fuse.min_votes": "0", "fuse.max_age_days": "nan", "fuse.min_age_s": "inf", "gate.drive": "\0"}
    for name, value in nobody_means.items():
        with pytest.raises(MapvoteError, match=f"policy: {name} = "):
            store.change_policy({name: value})
    assert store.policy() == Policy()


def test_another_map_is_refused_and_so_is_the_future(store: Store) -> None:
    base = store.point_map()
    with pytest.raises(Conflict, match="keeps map"):
        send(store, says(base, "a", EMPTY, map_id="elsewhere"))
    with pytest.raises(MapvoteError, match="future"):
        send(store, says(base, "a", EMPTY, day=365 * 200))


def test_dry_run_changes_nothing_and_a_held_version_says_why(store: Store) -> None:
    base = store.point_map()
    send(store, says(base, "a", EMPTY), says(base, "b", EMPTY))
    strict = FuseSettings(max_deleted_share=0.01)
    dry = preview(store, strict)
    assert (dry.published, dry.points_deleted, len(dry.held)) == (False, 3, 1)
    with pytest.raises(Held, match="deletes 25% of the points"):
        publish(store, strict)
    seen: list[PointMap] = []

    def gate(asked: GatePolicy, old: PointMap, new: PointMap) -> list[str]:
        seen.extend((old, new))
        return [f"worse by {asked.drive}"]

    assert not preview(store, POLICY, gate=gate).held, "the policy names no drive"
    store.set_policy(Policy(gate=GatePolicy(drive="ring")))
    with pytest.raises(Held, match="worse by ring"):
        publish(store, POLICY, gate=gate)
    old, new = seen
    assert len(old.tiles[0, 0].points) - len(new.tiles[0, 0].points) == 3
    assert new.tiles[0, 1] is old.tiles[0, 1]
    with pytest.raises(MapvoteError, match="judges versions by ring: publish by the server or mapvote publish"):
        publish(store, POLICY)
    assert store.current() == 1
    assert publish(store, strict, override=True, gate=lambda asked, old, new: []).published
    assert "in spite of" in store.versions()[-1].reason


@pytest.mark.contract
def test_of_64_publishers_one_wins(store: Store) -> None:
    base = store.point_map()
    send(store, says(base, "a", EMPTY), says(base, "b", EMPTY))
    barrier = threading.Barrier(64)

    def attempt(_: int) -> str:
        barrier.wait()
        try:
            return "published" if publish(store, POLICY, parent=1).published else "nothing"
        except Conflict:
            return "conflict"

    with ThreadPoolExecutor(64) as pool:
        results = list(pool.map(attempt, range(64)))
    assert sorted(results) == ["conflict"] * 63 + ["published"]
    assert store.current() == 2


@pytest.mark.contract
def test_readers_never_see_a_mixture(store: Store) -> None:
    """While versions appear, a manifest is always that of one version: both tiles change together or not at all."""
    stop = threading.Event()
    mixtures: list[int] = []

    def read() -> None:
        while not stop.is_set():
            manifest = store.manifest()
            if len({hashes.points for hashes in manifest.tiles.values()}) != 1:
                mixtures.append(manifest.version)

    reader = threading.Thread(target=read)
    reader.start()
    for _ in range(3):
        base = store.point_map()
        tiles = {index: Say(states_plane({CELL: EMPTY})) for index in base.tiles}
        send(store, *[make_ballot(base, tiles, v, f"d{next(_count)}") for v in "ab"])
        publish(store, POLICY, override=True)
        rollback(store, 1)
    stop.set()
    reader.join()
    assert mixtures == []


def test_what_is_no_store_says_so(database_url: str, store: Store) -> None:
    with pytest.raises(MapvoteError, match="holds a map already"):
        Store.create(database_url, two_walls())
    with pytest.raises(MapvoteError, match="no such store"):
        Store.open("sqlite:////nowhere/at/all.db")


@pytest.mark.contract
def test_a_database_that_is_gone_is_unavailable(database_url: str) -> None:
    with pytest.raises((MapvoteError, Unavailable)):
        Store.open(database_url)
