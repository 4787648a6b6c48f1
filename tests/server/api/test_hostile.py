"""A hostile network at a real server: no 500, no state change, the right status. Whatever bytes come, reading a ballot
ends in a ballot or in one clear refusal, in little memory."""

from __future__ import annotations

import json
import os
import re
import sqlite3
import subprocess
import sys
import tracemalloc
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
import msgspec
import pytest

from hand_made import SETTINGS, Say, make_ballot, states_plane, two_walls, wall, words_plane
from live_server import serving_here
from mapvote.codec.ballot import BALLOT_LIMITS, encode
from mapvote.core.types import CellState, MapvoteError
from mapvote_server.store import keys
from mapvote_server.store.examination import examine
from mapvote_server.store.policy import Policy, RoundPolicy
from mapvote_server.store.store import Store
from mutants import bomb, mutants

CONFIG = """
[server]
ballots_per_minute = 1e9
drives_a_day = 1000000000
max_body_bytes = 300000
work_s_per_minute = 1e9
rows_per_minute = 1e12
"""
EXAMPLES = os.environ.get("EXAMPLES", "6")
"""Generated requests of each kind and route."""
MUTANTS = int(os.environ.get("MUTANTS", "3000"))


class Site:
    """A running server, a vehicle's key, and a view of the store behind it."""

    def __init__(self, url: str, vehicle: str, operator: str, store: Store) -> None:
        self.url, self.operator, self.store = url, operator, store
        self.http = httpx2.Client(base_url=url, headers={"Authorization": f"Bearer {vehicle}"}, timeout=60.0)
        self.watch = sqlite3.connect(str(store.database.url.database))

    def put(self, data: bytes, path: str = "/v1/ballots/v1/d1", **headers: str) -> httpx2.Response:
        for last in (False, True):
            try:
                return self.http.request("PUT", path, content=data, headers=headers)
            except httpx2.RemoteProtocolError:  # a kept connection that the server was closing: sent once more
                if last:
                    raise
        raise AssertionError

    def commits(self) -> int:
        """Another number whenever anybody has committed anything to the store (SQLite's data_version)."""
        return int(self.watch.execute("PRAGMA data_version").fetchone()[0])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    home = tmp_path_factory.mktemp("hostile")
    store = Store.create(
        f"sqlite:///{home / 'store.db'}", two_walls(), Policy(round=RoundPolicy(settings_hash=SETTINGS))
    )
    vehicle, operator = keys.issue(store, "v1", "vehicle"), keys.issue(store, "boss", "operator")
    with serving_here(home / "store.db", settings=CONFIG, log=home / "log") as url:
        found = Site(url, vehicle, operator, store)
        yield found
        found.http.close()
        found.watch.close()
    store.close()


def honest() -> bytes:
    states = states_plane({(10, 10): CellState.CHANGED_EMPTY, (3, 3): CellState.CHANGED_OCCUPIED})
    say = Say(states=states, gone=words_plane({(10, 10): 7}), new_points=wall([(3, 3)], [0.5]), free=words_plane({}))
    return encode(make_ballot(two_walls(), {(0, 0): say, (0, 1): Say(states=states_plane())}))


def changed(**fields: Any) -> bytes:
    """The honest ballot with some fields replaced; ``tile_...`` in its first tile."""
    ballot = msgspec.msgpack.decode(honest())
    for name, value in fields.items():
        if name.startswith("tile_"):
            ballot["tiles"][0][name.removeprefix("tile_")] = value
        else:
            ballot[name] = value
    return msgspec.msgpack.encode(ballot)


@pytest.mark.slow
def test_thousands_of_mutated_ballots(site: Site) -> None:
    """A refusal leaves no trace, and says something."""
    answers: Counter[int] = Counter()
    before = site.commits()
    for data in mutants(honest(), MUTANTS, 2):
        answer = site.put(data)
        answers[answer.status_code] += 1
        assert answer.status_code in (200, 201, 403, 409, 413, 422), (answer.status_code, answer.text, data[:200])
        if answer.status_code >= 400:
            assert answer.json()["detail"]
            assert len(answer.content) < 2000
            assert site.commits() == before, f"a refused ballot changed the store: {answer.text}"
        before = site.commits()
    assert answers[422] > MUTANTS // 2, answers
    assert site.put(honest()).status_code in (200, 201)
    assert site.commits() != before, "who writes is seen"


def refusal_of(data: bytes) -> str | None:
    """Why a server refuses this, None if it can count it; MapvoteError is the only way to say no."""
    try:
        examine(data)
    except MapvoteError as error:
        return str(error)
    return None


def test_500_mutants_end_in_a_ballot_or_a_refusal() -> None:
    assert refusal_of(honest()) is None
    answers = [refusal_of(data) for data in mutants(honest(), 500)]
    refusals = [answer for answer in answers if answer is not None]
    assert 250 < len(refusals) < 500, "most are refused; a plane of the future and a harmless flip are not"
    assert all(refusal.startswith("ballot") and len(refusal) < 500 for refusal in refusals)


def test_a_bomb_of_a_gigabyte_costs_no_memory() -> None:
    small = msgspec.msgpack.decode(honest())
    small["tiles"][0]["new_points"] = bomb(1 << 30)
    data = msgspec.msgpack.encode(small)
    assert len(data) < 200_000
    tracemalloc.start()
    with pytest.raises(MapvoteError, match="larger than"):
        examine(data)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 120e6


@pytest.mark.parametrize(
    ("data", "status", "says"),
    [
        (b"", 422, "not readable"),
        (b"\x00" * 1000, 422, "not readable"),
        (bytes(400_000), 413, "300000"),
        (changed(tile_new_points=bomb(1 << 30)), 422, "larger than"),
        (changed(tile_tile=[BALLOT_LIMITS.tile_index + 1, 0]), 422, "outside any map"),
        (changed(map_id="another map"), 409, "another map"),
        (changed(vehicle="v2"), 422, "v2/d1"),
        (changed(end_ns=(1 << 64) - 1), 422, "future"),
        (changed(start_ns=0), None, ""),
        (changed(start_ns=-(1 << 63)), 422, "before 1970"),
        *((changed(start_ns=ns, end_ns=ns), 422, "before 1970") for ns in (-(1 << 63), -1, 0)),
        (changed(settings_hash="a\x00b"), 422, "not readable"),
        (changed(settings_hash="0" * 64), 409, "fleet's configuration"),
        (changed(method="evidence"), 409, "evidence"),
        (changed(base={"0,0": "f" * 64, "0,1": "f" * 64}), 409, "fetch"),
        (changed(base={}), 422, "base hash"),
        (changed(tiles=[]), 422, "no tile"),
        (changed(format_version=99), 422, "format 99"),
    ],
)
def test_each_absurdity_gets_its_status(site: Site, data: bytes, status: int | None, says: str) -> None:
    answer = site.put(data)
    if status is None:
        assert answer.status_code in (200, 201)
        return
    assert answer.status_code == status, answer.text
    assert says in answer.json()["detail"]


def test_a_body_without_an_announced_length_is_cut_off_too(site: Site) -> None:
    def endless() -> Iterator[bytes]:
        for _ in range(100):
            yield bytes(100_000)

    try:
        answer = site.http.request("PUT", "/v1/ballots/v1/d1", content=endless())
    except httpx2.TransportError:
        return  # cut off while still sending
    assert answer.status_code == 413


PATHS = ("ballots/../../etc/passwd", "ballots/v1/%2e%2e", "ballots/v1/a%00b", "tiles/..%2f..", "map/versions/%2e%2e")


@pytest.mark.parametrize("path", [*(f"/v1/{path}" for path in PATHS), "/viewer/..%2fapp.py", "/viewer/%2e%2e/app.py"])
def test_no_path_leads_out(site: Site, path: str) -> None:
    for method in ("GET", "PUT", "DELETE"):
        answer = site.http.request(method, path, content=b"x" if method == "PUT" else None)
        assert answer.status_code in (404, 405, 422), (method, path, answer.status_code)


@pytest.mark.parametrize("key", ["x", "Bearer", "ü" * 10, "a" * 20_000])
def test_odd_keys_are_refused(site: Site, key: str) -> None:
    header = f"Bearer {key}".encode()
    answer = httpx2.get(site.url + "/v1/map", headers=[(b"authorization", header)], timeout=300.0)
    assert answer.status_code in (400, 401, 431)


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("rollback", {"to": 1 << 80}),
        ("rollback", {"to": 1, "reason": "a\x00b"}),
        ("publish", {"parent": -(1 << 64)}),
        ("publish", {"reason": "a\nb"}),
        ("publish", {"reason": "a" * 201}),
        ("publish", {"reason": "a\ud800"}),
        ("publish", {"no such thing": 1}),
        ("publish", {"override": 0}),
        ("publish", {"dry_run": "true"}),
        ("rollback", {"to": True}),
        ("rollback", {"to": "1"}),
        ("replay", {"vehicle": "a\x00b"}),
        ("keys", {"name": "../boss"}),
        ("keys", {"name": "b", "role": "admin"}),
        ("keys", {"name": "b", "days": 1e300}),
        ("keys/rotate", {"name": "a\x00b"}),
        ("keys/rotate", {"name": "boss", "overlap_days": -1}),
        ("keys/revoke", {"name": "a\ud800"}),
    ],
)
def test_an_operators_slip_is_422(site: Site, path: str, body: dict[str, Any]) -> None:
    headers = {"Authorization": f"Bearer {site.operator}"}
    before = site.commits()
    headers["Content-Type"] = "application/json"
    answer = httpx2.post(f"{site.url}/v1/{path}", content=json.dumps(body), headers=headers, timeout=300.0)
    assert answer.status_code == 422
    assert site.commits() == before


ENDS_KEYS = ["--exclude-path-regex", "/v1/keys/.+"]
DEPENDS = """
[[operations]]
include-path-regex = "/v1/(ballots/.*|tiles/.*|policy|desk/reviews|changes/lanelets)"
checks.positive_data_acceptance.expected-statuses = ["2xx", "3xx", "401", "403", "404", "409", "422", "429", "5xx"]
"""
"""Bodies of bytes, and values that the policy or the desk know: a schema cannot say which of them are possible."""


@pytest.mark.slow
@pytest.mark.parametrize("role", keys.ROLES)
def test_schemathesis_on_every_route(site: Site, tmp_path: Path, role: keys.Role) -> None:
    """Generated requests of every role against the OpenAPI document, with all of schemathesis's checks: answers are
    what is declared, never a 500; valid requests are taken, others refused. All routes but the stream of events, which
    answers for as long as it is listened to, and what would end the operator's own key."""
    program = Path(sys.executable).parent / "schemathesis"
    if not program.exists():
        pytest.skip("schemathesis is not installed: pip install schemathesis")
    config = tmp_path / "schemathesis.toml"
    config.write_text(DEPENDS)
    key = keys.issue(site.store, f"fuzz-{role}", role)
    command = [str(program), "--config-file", str(config), "run", f"{site.url}/openapi.json", "--checks", "all"]
    command += ["--seed", "1", "--no-color", "--max-examples", EXAMPLES, "-H", f"Authorization: Bearer {key}"]
    # Wrong keys are limited to 60 a minute: an idle machine tries more, and gets 429 in place of 401.
    command += [
        "--exclude-checks",
        "ignored_auth",
        "--exclude-path",
        "/v1/events",
        *(ENDS_KEYS if role == "operator" else []),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=1200)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-1000:]
    tested = re.search(r"Selected: (\d+)/(\d+)", done.stdout)
    assert tested, done.stdout[-3000:]
    left_out = 3 if role == "operator" else 1
    assert int(tested[1]) == int(tested[2]) - left_out >= 40
