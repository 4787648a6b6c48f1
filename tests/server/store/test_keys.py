"""Keys: roles, ends, rotation, pseudonyms."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from hand_made import two_walls
from mapvote.core.types import MapvoteError
from mapvote.fusion.tile_vote import DAY_NS
from mapvote.server.errors import NotFound, Unauthorised
from mapvote.server.store import keys
from mapvote.server.store.store import Store

NOON = 1_700_000_000 * 10**9


class Clock:
    """A clock that stands until it is set."""

    now = NOON

    def __call__(self) -> int:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


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
    with pytest.raises(MapvoteError, match="a name has one role"):
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
