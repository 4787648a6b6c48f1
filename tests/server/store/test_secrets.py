"""What the store sends to other machines."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any

import pytest
import sqlalchemy as sa

from hand_made import Say, make_ballot, states_plane, two_walls
from mapvote.config import FuseSettings
from mapvote.core.types import CellState
from mapvote.server.store import fusion_jobs
from mapvote.server.store.database import address_of
from mapvote.server.store.publish import publish
from mapvote.server.store.store import Store
from stores import send


class Elsewhere(Executor):
    """A cluster: what is to be done there is pickled on its way."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []

    def submit(self, fn: Callable[..., Any], /, *args: Any, **more: Any) -> Future[Any]:
        self.sent.append(pickle.dumps((fn, args, more)))
        done: Future[Any] = Future()
        function, arguments, named = pickle.loads(self.sent[-1])
        done.set_result(function(*arguments, **named))
        return done


def test_a_task_for_a_cluster_carries_no_password_its_worker_has_its_own(
    postgres_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = sa.make_url(postgres_url).set(password="a-secret")
    store = Store.create(whole.render_as_string(hide_password=False), two_walls())
    says = {(0, 0): Say(states_plane({(10, 10): CellState.CHANGED_EMPTY}))}
    send(store, *[make_ballot(two_walls(), says, vehicle, "d1") for vehicle in ("a", "b")])
    monkeypatch.setenv("MAPVOTE_STORE", whole.render_as_string(hide_password=False))
    fusion_jobs._database.cache_clear()
    cluster = Elsewhere()
    assert publish(store, FuseSettings(max_deleted_share=1.0), executor=cluster).version == 2
    assert cluster.sent
    assert not any(b"a-secret" in sent for sent in cluster.sent)
    used = fusion_jobs._database(address_of(whole))
    assert used.url.password == "a-secret"
    used.close()
    fusion_jobs._database.cache_clear()
    store.close()
