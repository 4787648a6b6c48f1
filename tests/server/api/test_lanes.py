"""Threads by kind of work: keys take turns, greed is charged to the greedy, and a question ends in time."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Awaitable, Callable
from contextvars import copy_context
from pathlib import Path

import pytest
import sqlalchemy as sa
from fastapi.testclient import TestClient

from hand_made import two_walls
from mapvote.config import ServerSettings, Settings
from mapvote_server.api.app import create_app
from mapvote_server.api.lanes import QUEUES, Budget, Lane, asker
from mapvote_server.api.security import FLOODS
from mapvote_server.errors import TooMany, TooSlow
from mapvote_server.store.database import Database
from mapvote_server.store.keys import issue
from mapvote_server.store.store import Store
from mapvote_server.work import Work, check_time, count_rows, current


def as_key(name: str | None, work: Callable[[], Awaitable[object]]) -> asyncio.Task[object]:
    """A request with the key of ``name``."""

    async def ask() -> object:
        asker.set(name)
        return await work()

    return asyncio.get_running_loop().create_task(ask(), context=copy_context())


def test_a_key_that_asks_forty_times_holds_one_thread_and_another_key_does_not_wait_for_it() -> None:
    order: list[str] = []
    most = [0, 0]
    gate = threading.Event()

    def busy(name: str) -> None:
        most[0] += 1
        most[1] = max(most)
        gate.wait(10.0)
        most[0] -= 1
        order.append(name)

    async def story() -> None:
        lane = Lane("questions", 1, each=1)
        greedy = [as_key("greedy", lambda: lane.run(busy, "greedy")) for _ in range(30)]
        honest = as_key("honest", lambda: lane.run(busy, "honest"))
        await asyncio.sleep(0.01)  # all of them are in line now
        gate.set()
        await asyncio.gather(honest, *greedy)
        assert order.index("honest") <= 2
        lane.close()

    asyncio.run(story())
    assert most[1] == 1
    assert len(order) == 31


def test_one_key_has_as_many_threads_as_it_may_and_others_the_rest() -> None:
    gate = threading.Event()

    async def story() -> None:
        lane = Lane("questions", 2, each=1)
        held = [as_key("greedy", lambda: lane.run(gate.wait, 10.0)) for _ in range(3)]
        await asyncio.sleep(0.01)
        assert await as_key("honest", lambda: lane.run(int, 7)) == 7
        gate.set()
        await asyncio.gather(*held)
        lane.close()

    asyncio.run(story())


def test_a_client_that_goes_away_frees_its_turn_but_not_a_thread_that_still_works() -> None:
    gate = threading.Event()

    async def story() -> None:
        lane = Lane("questions", 1, each=1)
        first = as_key("a", lambda: lane.run(gate.wait, 10.0))
        waiting = as_key("a", lambda: lane.run(int, 1))
        await asyncio.sleep(0.01)
        for gone in (first, waiting):
            gone.cancel()
        later = as_key("b", lambda: lane.run(int, 2))
        await asyncio.sleep(0.05)
        assert not later.done(), "the thread is still at work for the client that went away"
        gate.set()
        assert await later == 2
        lane.close()

    asyncio.run(story())


def test_more_requests_of_one_key_than_may_wait_are_refused_at_once() -> None:
    gate = threading.Event()

    async def story() -> None:
        lane = Lane("questions", 1, each=1, limit_s=60.0)
        held = [as_key("greedy", lambda: lane.run(gate.wait, 10.0)) for _ in range(QUEUES.waiting + 1)]
        await asyncio.sleep(0.01)
        with pytest.raises(TooMany, match="wait already"):
            await as_key("greedy", lambda: lane.run(int, 1))
        gate.set()
        await asyncio.gather(*held)
        lane.close()

    asyncio.run(story())


def burn(seconds: float) -> None:
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass


def test_work_is_charged_to_its_key_also_if_it_fails_and_other_keys_go_on() -> None:
    def fail() -> None:
        burn(0.1)
        raise ValueError("no")

    async def story() -> None:
        lane = Lane("questions", 1, each=1, budget=Budget(0.05, 1e9))
        with pytest.raises(ValueError, match="no"):
            await as_key("a", lambda: lane.run(fail))
        await asyncio.sleep(0.01)
        with pytest.raises(TooMany, match="seconds of work") as refused:
            await as_key("a", lambda: lane.run(int, 1))
        assert refused.value.after_s >= 1.0
        assert await as_key("b", lambda: lane.run(int, 1)) == 1
        for _ in range(3):
            await as_key(None, lambda: lane.run(burn, 0.1))
        lane.close()

    asyncio.run(story())


def test_rows_are_charged_as_well() -> None:
    async def story() -> None:
        lane = Lane("questions", 1, each=1, budget=Budget(1e9, 100))
        await as_key("a", lambda: lane.run(count_rows, 150))
        await asyncio.sleep(0.01)
        with pytest.raises(TooMany, match="100 rows a minute"):
            await as_key("a", lambda: lane.run(int, 1))
        lane.close()

    asyncio.run(story())


def test_a_budget_comes_back_with_time() -> None:
    now = 0.0
    budget = Budget(30.0, 1e6, clock=lambda: now)
    budget.spend("a", 45.0, 1)
    with pytest.raises(TooMany) as refused:
        budget.check("a")
    assert refused.value.after_s == pytest.approx(30.0)
    now = 30.1
    budget.check("a")


def test_a_question_beyond_its_time_is_answered_and_its_thread_ends_at_the_next_check() -> None:
    ended = threading.Event()

    def endless() -> None:
        try:
            while True:
                time.sleep(0.01)
                check_time()
        finally:
            ended.set()

    async def story() -> None:
        lane = Lane("questions", 1, each=1, limit_s=0.1)
        with pytest.raises(TooSlow, match="question_s"):
            await as_key("a", lambda: lane.run(endless))
        assert ended.wait(5.0)
        begun = time.monotonic()
        with pytest.raises(TooSlow):
            await as_key("a", lambda: lane.run(time.sleep, 2.0))
        assert time.monotonic() - begun < 1.9, "also if the thread does not notice it"
        lane.close()

    asyncio.run(story())


def test_a_statement_that_takes_too_long_is_ended_by_the_database(database_url: str) -> None:
    Store.create(database_url, two_walls()).close()
    database = Database(database_url)
    endless = (
        "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < 2000000000) SELECT count(*) FROM n"
    )
    work = Work(0.3)

    def ask() -> None:
        current.set(work)
        work.begin()
        with database.reading() as connection:
            connection.execute(sa.text(endless))

    begun = time.monotonic()
    with pytest.raises(TooSlow, match=r"0\.3 s"):
        copy_context().run(ask)
    assert time.monotonic() - begun < 5.0
    with database.reading() as connection:
        assert connection.execute(sa.text("SELECT 1")).scalar_one() == 1, "the next question is asked as before"
    database.close()


def test_a_probe_neither_waits_for_a_writer_nor_looks_twice_at_once(tmp_path: Path) -> None:
    from mapvote_server.api.probe import Probe
    from mapvote_server.errors import Unavailable

    store = Store.create(f"sqlite:///{tmp_path / 's.db'}", two_walls())

    async def story() -> None:
        probe = Probe(store.database)
        assert await probe.newest() == 1
        with store.database.writing():
            await asyncio.sleep(1.1)
            begun = time.monotonic()
            answers = await asyncio.gather(*[probe.newest() for _ in range(20)], return_exceptions=True)
            waited_s = time.monotonic() - begun
        assert all(isinstance(answer, Unavailable) for answer in answers)
        assert waited_s < 0.95, "one look for all of them"
        await asyncio.sleep(1.1)
        assert await probe.newest() == 1
        probe.close()

    asyncio.run(story())
    store.close()


def test_a_key_without_budget_waits_for_its_refusal_and_operators_still_command(tmp_path: Path) -> None:
    store = Store.create(f"sqlite:///{tmp_path / 's.db'}", two_walls())
    vehicle, operator = issue(store, "v1", "vehicle"), issue(store, "boss", "operator")
    app = create_app(store)
    with TestClient(app, base_url="http://localhost") as client:
        for name in ("v1", "boss"):
            app.state.services.budget.spend(name, 100.0, 0)
        begun_s = time.monotonic()
        refused = client.get("/v1/map", headers={"Authorization": f"Bearer {vehicle}"})
        assert (refused.status_code, int(refused.headers["retry-after"]) > 60) == (429, True)
        assert time.monotonic() - begun_s >= FLOODS.pause_s
        headers = {"Authorization": f"Bearer {operator}"}
        assert client.post("/v1/keys/revoke", headers=headers, json={"name": "v1"}).status_code == 200
    store.close()


def test_every_request_is_charged_to_its_key(tmp_path: Path) -> None:
    store = Store.create(f"sqlite:///{tmp_path / 's.db'}", two_walls())
    headers = {"Authorization": f"Bearer {issue(store, 'v1', 'vehicle')}"}
    app = create_app(store, Settings(server=ServerSettings(work_s_per_minute=FLOODS.request_s * 5)))
    with TestClient(app, base_url="http://localhost") as client:
        answered = 0
        while client.get("/livez", headers=headers).status_code == 200:
            answered += 1
    assert 5 <= answered <= 10
    store.close()
