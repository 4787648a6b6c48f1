"""A real server process in trouble: its disk is full or read-only, its database goes away, it is stopped under load.

Nothing is half done, nothing acknowledged is lost, and it is well again afterwards (kills: store/test_crash.py)."""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx2
import numpy as np
import pytest
import sqlalchemy as sa

from hand_made import Say, make_ballot, make_map, make_tile, states_plane, two_walls, wall
from live_server import mapvote, serving
from mapvote.codec.ballot import Ballot, encode
from mapvote.core.point_map import PointMap
from mapvote.core.types import CellState
from mapvote_server.api.probe import PROBING
from mapvote_server.store import schema
from mapvote_server.store.store import Store
from postgres_cluster import PostgresCluster
from stores import send

CELL = (10, 10)


@contextmanager
def served(store: Path | str, home: Path) -> Iterator[tuple[httpx2.Client, subprocess.Popen[str]]]:
    with serving(store, log=home / "log") as (url, process), httpx2.Client(base_url=url, timeout=60.0) as http:
        yield http, process


def put(http: httpx2.Client, vehicle: str, drive: str) -> httpx2.Response:
    """A ballot of some 60 kB against the first map."""
    noise = np.random.default_rng(len(drive)).random((5000, 3), dtype=np.float32) * np.array([76, 76, 1], np.float32)
    say = Say(states_plane({CELL: CellState.CHANGED_EMPTY}), new_points=noise)
    ballot = make_ballot(two_walls(), {(0, 0): say}, vehicle, drive, end_ns=time.time_ns() - 10**9)
    return http.request("PUT", f"/v1/ballots/{vehicle}/{drive}", content=encode(ballot))


def send_until_refused(http: httpx2.Client) -> set[str]:
    """The drives that were acknowledged before the first refusal, which must be a clear one."""
    acknowledged: set[str] = set()
    for i in range(400):
        answer = put(http, f"v{i % 2}", f"d{i}")
        if answer.status_code != 201:
            assert_refused(answer)
            return acknowledged
        acknowledged.add(f"d{i}")
    raise AssertionError("400 ballots of 60 kB found room")


def assert_refused(answer: httpx2.Response) -> None:
    assert answer.status_code == 503, answer.text
    assert "Retry-After" in answer.headers
    assert "try again" in answer.json()["detail"]


def standing(url: str) -> set[str]:
    store = Store.open(url)
    with store.database.reading() as connection:
        drives = connection.execute(sa.select(schema.ballots.c.drive).where(schema.ballots.c.gone_seq.is_(None)))
        found = set(drives.scalars())
    store.close()
    return found


def assert_well_again(http: httpx2.Client, url: str, acknowledged: set[str]) -> None:
    assert put(http, "v2", "later").status_code == 201
    assert http.get("/healthz").status_code == 200
    assert http.get("/readyz").status_code == 200
    assert http.request("POST", "/v1/publish", json={"override": True}).json()["published"]
    assert standing(url) == {*acknowledged, "later"}


@pytest.mark.slow
def test_no_room_for_the_file_to_grow(tmp_path: Path) -> None:
    """A full disk, without being root: the process may not make its files longer than 3 MB for a while."""
    url = f"sqlite:///{tmp_path / 'store.db'}"
    Store.create(url, two_walls()).close()
    with served(tmp_path / "store.db", tmp_path) as (http, process):
        before = resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (3 << 20, resource.RLIM_INFINITY))
        acknowledged = send_until_refused(http)
        assert acknowledged
        for _ in range(3):
            assert_refused(put(http, "v0", "again"))
        assert http.get("/v1/map").status_code == 200, "who only reads is served"
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, before)
        assert_well_again(http, url, acknowledged)


@pytest.mark.slow
def test_a_store_on_a_read_only_disk_is_not_served(small_disk: Path) -> None:
    Store.create(f"sqlite:///{small_disk / 'store.db'}", two_walls()).close()
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    command = mapvote("serve", small_disk / "store.db", "--port", 0)
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 1
    assert "store.db" in done.stderr
    assert "Traceback" not in done.stderr
    subprocess.run(["mount", "-o", "remount,rw", str(small_disk)], check=True)


@pytest.fixture
def ext4(tmp_path: Path) -> Iterator[Path]:
    """A small ext4 file system in a file; only root may mount one."""
    image, disk = tmp_path / "image", tmp_path / "ext4"
    disk.mkdir()
    image.write_bytes(b"")
    os.truncate(image, 48 << 20)
    made = os.getuid() == 0 and shutil.which("mkfs.ext4") is not None
    made = made and not subprocess.run(["mkfs.ext4", "-q", str(image)], capture_output=True, check=False).returncode
    mount = ["mount", "-o", "loop", str(image), str(disk)]
    if not made or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("only root can mount a disk to break, and needs mkfs.ext4 and a loop device")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


@pytest.mark.slow
def test_a_disk_that_turns_read_only_under_the_server(ext4: Path, tmp_path: Path) -> None:
    """Linux's behaviour after a write error: the file system is read-only from one moment to the next, with files
    open."""
    url = f"sqlite:///{ext4 / 'store.db'}"
    Store.create(url, two_walls()).close()
    with served(ext4 / "store.db", tmp_path) as (http, _):
        for vehicle, drive in (("v0", "d0"), ("v1", "d1")):
            assert put(http, vehicle, drive).status_code == 201
        subprocess.run(["mount", "-o", "remount,abort", str(ext4)], check=True, capture_output=True)
        for _ in range(3):
            assert_refused(put(http, "v1", "refused"))
        assert_refused(http.request("POST", "/v1/publish", json={"override": True}))
    subprocess.run(["umount", str(ext4)], check=True)
    subprocess.run(["mount", "-o", "loop", str(tmp_path / "image"), str(ext4)], check=True)
    with served(ext4 / "store.db", tmp_path) as (http, _):
        assert_well_again(http, url, {"d0", "d1"})


@pytest.mark.slow
def test_a_database_gone_for_ten_seconds_is_503_and_then_all_is_well(
    postgres_cluster: PostgresCluster, postgres_url: str, tmp_path: Path
) -> None:
    Store.create(postgres_url, two_walls()).close()
    with served(postgres_url, tmp_path) as (http, _):
        assert put(http, "v1", "before").status_code == 201
        postgres_cluster.stop()
        try:
            gone = time.monotonic()
            while time.monotonic() - gone < 10.0:
                assert_refused(put(http, "v1", "during"))
                assert http.get("/livez").status_code == 200
                for path in ("/v1/map", "/healthz", "/readyz", "/v1/coverage"):
                    assert http.get(path).status_code == 503
                assert http.request("POST", "/v1/publish", json={}).status_code == 503
                time.sleep(0.5)
        finally:
            postgres_cluster.start()
        assert put(http, "v1", "after").status_code == 201
        time.sleep(PROBING.kept_s)  # a probe's answer holds for that long
        for path in ("/healthz", "/readyz"):
            assert http.get(path).status_code == 200
    assert standing(postgres_url) == {"before", "after"}


TILES = [(row, col) for row in range(20) for col in range(20)]


def street() -> PointMap:
    """400 tiles with a pillar each, none like another."""
    pillar = wall([CELL], [0.45, 0.75, 1.05])
    return make_map({tile: make_tile(pillar + np.float32(1e-3 * i)) for i, tile in enumerate(TILES)})


def gone_everywhere(point_map: PointMap, vehicle: str) -> Ballot:
    states = states_plane({CELL: CellState.CHANGED_EMPTY})
    return make_ballot(point_map, dict.fromkeys(TILES, Say(states)), vehicle, "all", time.time_ns())


def send_until_stopped(url: str, vehicle: str, point_map: PointMap, acknowledged: set[str]) -> None:
    say = {TILES[0]: Say(states_plane({CELL: CellState.UNCHANGED_OCCUPIED}))}
    with httpx2.Client(base_url=url, timeout=30.0) as http:
        for i in range(100_000):
            drive = f"{vehicle}.{i}"
            body = encode(make_ballot(point_map, say, vehicle, drive, time.time_ns()))
            try:
                answer = http.request("PUT", f"/v1/ballots/{vehicle}/{drive}", content=body)
            except httpx2.TransportError:
                return
            assert answer.status_code == 201, answer.text
            acknowledged.add(drive)


@pytest.mark.parametrize("after_s", [0.3, pytest.param(1.0, marks=pytest.mark.slow)])
def test_a_stop_under_load_is_soon_and_loses_nothing(tmp_path: Path, after_s: float) -> None:
    point_map = street()
    store = Store.create(f"sqlite:///{tmp_path / 's.db'}", point_map)
    send(store, *[gone_everywhere(point_map, vehicle) for vehicle in ("a", "b")])
    acknowledged: set[str] = set()
    published: list[int] = []
    connected = threading.Event()

    def publish(url: str) -> None:
        with httpx2.Client(base_url=url, timeout=60.0) as http:
            assert http.get("/healthz").status_code == 200
            connected.set()
            published.append(http.request("POST", "/v1/publish", json={"override": True}).status_code)

    settings = "[server]\ndrives_a_day = 1000000\n"
    with serving(tmp_path / "s.db", settings=settings, log=tmp_path / "log") as (url, process):
        senders = [
            threading.Thread(target=send_until_stopped, args=(url, f"v{i}", point_map, acknowledged)) for i in range(4)
        ]
        for sender in senders:
            sender.start()
        while len(acknowledged) < 20:
            time.sleep(0.01)
        publisher = threading.Thread(target=publish, args=(url,))
        publisher.start()
        assert connected.wait(30.0)
        time.sleep(after_s)
        process.terminate()
        assert process.wait(300) in (0, -15), "it waits neither for the publish nor for the senders"
        for thread in (*senders, publisher):
            thread.join()
    assert published[0] in (503, 200)
    assert store.current() == (2 if published == [200] else 1)
    assert len(store.point_map().tiles) == len(TILES)
    store.close()
    assert acknowledged <= standing(f"sqlite:///{tmp_path / 's.db'}")
