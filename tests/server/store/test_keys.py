"""Keys: roles, ends, rotation, pseudonyms."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from hand_made import Say, make_ballot, states_plane, two_walls
from mapvote.codec.ballot import Ballot, encode
from mapvote.core.types import CellState, MapvoteError
from mapvote.fusion.tile_vote import DAY_NS
from mapvote_server.errors import Conflict, NotFound, Unauthorised
from mapvote_server.store import keys
from mapvote_server.store.admission import Intake
from mapvote_server.store.examination import examine
from mapvote_server.store.publish import publish
from mapvote_server.store.rollback import replay
from mapvote_server.store.store import Store
from stores import Clock, send

NOON = 1_700_000_000 * 10**9


@pytest.fixture
def clock() -> Clock:
    return Clock(NOON)


@pytest.fixture
def store(database_url: str, clock: Clock) -> Iterator[Store]:
    store = Store.create(database_url, two_walls(), clock=clock)
    yield store
    store.close()


def opens(store: Store, secret: str) -> str | None:
    """The role that a key opens the store as."""
    (found,) = keys.check(store, [keys.hash_of(secret)])
    assert isinstance(found, keys.Key | Unauthorised)
    return found.role if isinstance(found, keys.Key) else None


@pytest.mark.contract
def test_a_key_opens_by_its_role_until_its_end(store: Store, clock: Clock) -> None:
    ann, reader = keys.issue(store, "ann", "operator"), keys.issue(store, "map-room", "reader", days=2)
    assert (opens(store, ann), opens(store, reader), opens(store, "guess")) == ("operator", "reader", None)
    clock.now += 2 * DAY_NS
    assert (opens(store, ann), opens(store, reader)) == ("operator", None)


def test_rotation_gives_a_new_key_of_the_same_role_and_the_old_one_an_end(store: Store, clock: Clock) -> None:
    old = keys.issue(store, "v1", "vehicle", days=10)
    new = keys.rotate(store, "v1", overlap_days=1)
    assert (opens(store, old), opens(store, new)) == ("vehicle", "vehicle")
    clock.now += 2 * DAY_NS
    assert (opens(store, old), opens(store, new)) == (None, "vehicle")
    clock.now += 8 * DAY_NS
    assert opens(store, new) is None, "it lasts as long as the one before"
    with pytest.raises(NotFound, match="no valid key"):
        keys.rotate(store, "v1")


def test_a_name_has_one_role(store: Store) -> None:
    keys.issue(store, "ann", "reviewer")
    with pytest.raises(Conflict, match="a name has one role"):
        keys.issue(store, "ann", "vehicle")
    keys.revoke(store, "ann")
    keys.issue(store, "ann", "vehicle")
    with pytest.raises(MapvoteError, match="is no role; choose one of vehicle, reader, reviewer, operator"):
        keys.issue(store, "bob", "admin")  # type: ignore[arg-type]


def test_a_pseudonym_is_always_the_same_and_tells_nothing(store: Store) -> None:
    shown = keys.pseudonyms(store, ["v1", "v2"])
    assert shown == keys.pseudonyms(store, ["v2", "v1"])
    assert len(set(shown.values())) == 2
    assert not any(name in text.removeprefix("vehicle-") for name, text in shown.items())


def takes_the_wall_down(vehicle: str) -> Ballot:
    say = Say(states_plane({(10, 10): CellState.CHANGED_EMPTY}))
    return make_ballot(two_walls(), {(0, 0): say}, vehicle, end_ns=NOON)


def test_whose_key_is_revoked_is_not_heard_any_more_unless_one_says_so_and_what_it_published_stays(
    store: Store,
) -> None:
    for vehicle in ("v1", "v2", "v3"):
        keys.issue(store, vehicle, "vehicle")
        send(store, takes_the_wall_down(vehicle))
    assert keys.revoke(store, "v3") == (1, 1)
    assert keys.revoke(store, "v2", keep_votes=True) == (1, 0)
    assert publish(store, override=True).points_deleted == 3, "v1 and v2"
    keys.revoke(store, "v1")
    assert not publish(store).published, "nothing comes back by itself"
    assert replay(store, "v1", dry_run=False).points_added == 3


def test_a_ballot_on_its_way_while_its_key_is_revoked_is_refused(store: Store) -> None:
    secret, intake = keys.issue(store, "v1", "vehicle"), Intake(store)
    decoded = examine(encode(takes_the_wall_down("v1")), key_hash=keys.hash_of(secret))
    keys.revoke(store, "v1")
    (answer,) = intake.write([decoded])
    assert isinstance(answer, Unauthorised)
