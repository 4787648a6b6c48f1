"""The large parts of a round: on disk they are what they are in memory."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hand_made import make_map, make_tile, wall
from mapvote_server.errors import Unavailable
from mapvote_server.store.database import address_of
from mapvote_server.store.fusion_jobs import JOB_SIZES, Fused, Task, fuse_round
from mapvote_server.store.round_file import Bulk, OnDisk, RoundFile
from mapvote_server.store.store import Store
from mapvote_server.store.votes import electorate_now
from stores import WALL, vote_gone

TILES = [(0, col) for col in range(3)]


def test_a_round_on_disk_decides_what_it_decides_in_memory(tmp_path: Path) -> None:
    points = wall(WALL, [0.05, 0.45, 0.75])
    store = Store.create(f"sqlite:///{tmp_path / 's.db'}", make_map({tile: make_tile(points) for tile in TILES}))
    vote_gone(store, tiles=TILES)
    with store.database.reading() as connection:
        asked = electorate_now(connection, store.clock())
    hashes = store.tiles()
    url = address_of(store.database.url)
    tasks = [Task(url, store.lattice.tile(tile), 2, hashes[tile], asked) for tile in TILES]
    here = fuse_round(tasks, store.database)
    there = fuse_round(tasks, store.database, sizes=replace(JOB_SIZES, sites=1))
    store.close()
    for one, other in zip(here, there, strict=True):
        assert isinstance(one, Fused)
        assert isinstance(other, Fused)
        assert one.deleted == other.deleted == 2 * len(WALL)
        assert one.planes == other.planes != {}
        assert one.record == other.record is not None
    assert [isinstance(one.bulk, OnDisk) for one in there if isinstance(one, Fused)] == [True, True, True]
    assert not any(isinstance(one.bulk, OnDisk) for one in here if isinstance(one, Fused))


def test_a_full_disk_is_named_with_its_folder(small_disk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(small_disk))
    file = RoundFile()
    noise = np.random.default_rng(1)

    def fill() -> None:
        for _ in range(20):
            file.put(Bulk(planes={"a": noise.bytes(1 << 20)}))

    with pytest.raises(Unavailable, match=f"no room for a round in {small_disk} .*TMPDIR"):
        fill()
