"""How many votes on a cell the server fuses a second, from ballots in the store to what would be published.

    python benchmarks/fusion.py                        # 25 to 200 vehicles, 4 to 16 tiles
    python benchmarks/fusion.py --publish --tiles 16   # a publish of three vehicles, from the plan to the commit

A run is `preview()`: it reads every ballot from the database, decompresses it, checks which cells count,
decides, edits the tiles and packs them. One vehicle on one tile is 65,536 cell-votes, spoken or not. The ballots are
shaped like those of simulated drives: a corridor of street seen, noise along its borders, a house that fell and a
kiosk that rose. All take turns in one run:

    mapvote            as a process that has just begun: every ballot is unpacked
    mapvote, 1 new     one more vehicle has voted since: the others' ballots were unpacked before
    numpy              the same decision in plain numpy, from the same database with sqlite3 and zstd: states alone, no
                       check of any sum, no copies, no edits (`numpy_tile`)
    numpy, whole       that, and masks, points and free space are read too and counted in plain numpy: what goes, what
                       comes and what is free, though no tile is loaded, edited or packed (`numpy_whole_tile`)
"""

from __future__ import annotations

import argparse
import shutil
import sqlite3
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from mapvote.codec.planes import zstd

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from hand_made import Cell, Say, make_ballot, make_map, make_tile, wall
from mapvote.codec.ballot import encode
from mapvote.config import FuseSettings
from mapvote.core.grid import TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.types import NO_VOTE, U8, CellState
from mapvote.fusion.tile_vote import DAY_NS
from mapvote_server.store import database
from mapvote_server.store.admission import Intake, Receipt
from mapvote_server.store.examination import examine
from mapvote_server.store.policy import Policy
from mapvote_server.store.publish import preview, publish
from mapvote_server.store.store import Store
from stores import send

SHAPE = (256, 256)
HOUSE = [(r, c) for r in range(100, 118) for c in (40, 57)] + [(r, c) for r in (100, 117) for c in range(40, 58)]
KIOSK = [(r, c) for r in range(60, 68) for c in range(200, 208)]
FACADES = [(r, c) for r in (90, 180) for c in range(256)]
HEIGHTS = [0.45 + 0.3 * i for i in range(10)]


def street(tiles: Sequence[TileIndex]) -> PointMap:
    """Two facades, a house and the road in each tile: some 29,000 points."""
    ground = [(r, c) for r in range(91, 180) for c in range(256)]
    points = np.concatenate([wall([*FACADES, *HOUSE], HEIGHTS), wall(ground, [0.05])])
    return make_map({tile: make_tile(points) for tile in tiles})


def said(rng: np.random.Generator) -> Say:
    """One vehicle's statement on a tile after driving along it."""
    states = np.full(SHAPE, NO_VOTE, dtype=np.uint8)
    reach = rng.integers(-6, 7, (2, 256)).cumsum(axis=1).clip(-12, 12)
    rows = np.arange(256)[:, None]
    seen = (rows >= 88 + reach[0]) & (rows <= 184 + reach[1])
    states[seen] = CellState.UNCHANGED_EMPTY
    for cells, state in ((FACADES, CellState.UNCHANGED_OCCUPIED), (HOUSE, CellState.CHANGED_EMPTY)):
        states[tuple(np.transpose(cells))] = state
    states[tuple(np.transpose(KIOSK))] = CellState.CHANGED_OCCUPIED
    noise = seen & (rng.random(SHAPE) < 0.02)
    states[noise] = rng.choice(np.array([0, 2, 3, 4, 4, 4], np.uint8), int(noise.sum()))
    gone = np.where(states == CellState.CHANGED_EMPTY, np.uint64(0x7FE), np.uint64(0))
    free = np.where(seen & (rng.random(SHAPE) < 0.05), np.uint64(0xFF0), np.uint64(0))
    risen: list[Cell] = [(int(r), int(c)) for r, c in np.argwhere(states == CellState.CHANGED_OCCUPIED)]
    points = wall(risen, HEIGHTS[:4]) + rng.uniform(-0.05, 0.05, (4 * len(risen), 3)).astype(np.float32)
    return Say(states, gone=gone, free=free, new_points=points)


class Fleet:
    """Vehicles that vote on all tiles of a store, one after another. No two say the same of a tile: such would be
    copies."""

    def __init__(self, store: Store, tiles: Sequence[TileIndex], most: int) -> None:
        rng = np.random.default_rng(1)
        self.store, self.tiles, self.base = store, tiles, store.point_map()
        self.kinds = [said(rng) for _ in range(max(most, 40))]
        self.vehicles, self.bytes = 0, 0

    def vote(self, vehicles: int) -> None:
        """So many more."""
        for vehicle in range(self.vehicles, self.vehicles + vehicles):
            says = {tile: self.kinds[(vehicle + i) % len(self.kinds)] for i, tile in enumerate(self.tiles)}
            data = encode(make_ballot(self.base, says, f"v{vehicle:03}", "d", end_ns=DAY_NS + vehicle))
            self.bytes += len(data)
            (receipt,) = Intake(self.store).write([examine(data)])
            assert isinstance(receipt, Receipt), receipt
        self.vehicles += vehicles


def votes_on(connection: sqlite3.Connection, tile: TileIndex) -> list[dict[str, bytes]]:
    """The packed planes of every vote on a tile, by name."""
    rows = connection.execute("SELECT votes FROM ballot_tiles WHERE row = ? AND col = ?", tile)
    return [msgspec.msgpack.decode(votes) for (votes,) in rows]


def numpy_tile(connection: sqlite3.Connection, tile: TileIndex) -> U8:
    """The peer: one tile's states by the columns rule with two votes for a change, in plain numpy."""
    planes = np.stack(
        [np.frombuffer(zstd.decompress(votes["states"]), np.uint8) for votes in votes_on(connection, tile)]
    )
    counts = np.stack([(planes == state).sum(axis=0) for state in range(5)])
    determined = counts[:4]
    best = determined.max(axis=0)
    states = determined.argmax(axis=0).astype(np.uint8)
    states[(determined == best).sum(axis=0) > 1] = CellState.UNDETERMINED
    states[best == 0] = np.where(counts[4] > 0, CellState.UNDETERMINED, NO_VOTE)[best == 0]
    change = (states == CellState.CHANGED_OCCUPIED) | (states == CellState.CHANGED_EMPTY)
    states[change & ((best < 2) | (2 * best <= determined.sum(axis=0)))] = CellState.UNDETERMINED
    return states


def unpacked_words(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """(flat cells, words) of a mask or of free space, see codec/planes.py."""
    raw = np.frombuffer(zstd.decompress(data), np.uint8)
    n = len(raw) // 10
    ways = raw[:n].astype(np.int64) + 256 * raw[n : 2 * n].astype(np.int64)
    return np.cumsum(ways), np.ascontiguousarray(raw[2 * n :].reshape(8, n).T).view("<u8").reshape(-1)


def unpacked_voxels(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """(flat cells, layers) of new points, see codec/ballot.py: what the peer needs to know of where they lie."""
    planes = np.frombuffer(zstd.decompress(data), np.uint8).reshape(9, -1).astype(np.int64)
    cells = np.cumsum(planes[0] + (planes[1] << 8)) & (SHAPE[0] * SHAPE[1] - 1)
    ways = planes[2] + (planes[3] << 8) + (planes[4] << 16) + (planes[5] << 24)
    return cells, (np.cumsum(ways) + (1 << 31) & 0xFFFFFFFF) - (1 << 31)


def numpy_whole_tile(connection: sqlite3.Connection, tile: TileIndex) -> tuple[U8, np.ndarray, np.ndarray, np.ndarray]:
    """The peer with all planes: (states, bits that go, voxels that come, bits that are free), each by two vehicles."""
    decided = numpy_tile(connection, tile)
    gone, free = np.zeros((2, 2, len(decided)), np.uint64)
    offered = []
    for votes in votes_on(connection, tile):
        states, mask, points, passed = (votes[name] for name in ("states", "gone", "new_points", "free"))
        own = np.frombuffer(zstd.decompress(states), np.uint8)
        for data, reached, counts in ((mask, gone, (own == 3) & (decided == 3)), (passed, free, own != NO_VOTE)):
            cells, words = unpacked_words(data)
            cells, words = cells[counts[cells]], words[counts[cells]]
            reached[1][cells] |= reached[0][cells] & words
            reached[0][cells] |= words
        cells, layers = unpacked_voxels(points)
        counts = (own[cells] == 2) & (decided[cells] == 2)
        offered.append(np.unique(cells[counts] * 1024 + layers[counts]))
    voxels, vehicles = np.unique(np.concatenate(offered), return_counts=True)
    return decided, gone[1], voxels[vehicles >= 2], free[1]


PEERS = {"numpy": numpy_tile, "numpy, whole": numpy_whole_tile}


def measure(folder: Path, vehicles: int, n_tiles: int, repeats: int) -> dict[str, Any]:
    """Milliseconds of CPU a tile, the median of ``repeats`` turns after one to warm up. Every turn has one vehicle
    more."""
    tiles = [(0, col) for col in range(n_tiles)]
    file = folder / f"{vehicles}_{n_tiles}.db"
    store = Store.create(f"sqlite:///{file}", street(tiles))
    fleet = Fleet(store, tiles, vehicles + repeats + 1)
    fleet.vote(vehicles - 1)
    cpu: dict[str, list[float]] = {name: [] for name in ("mapvote", "mapvote, 1 new", *PEERS)}

    def timed(name: str, act: Callable[[], object]) -> None:
        start = time.process_time()
        act()
        cpu[name].append(1e3 * (time.process_time() - start) / n_tiles)

    for _ in range(repeats + 1):
        policy = FuseSettings(latest_vehicles=fleet.vehicles + 1, max_deleted_share=1.0)
        database.remembered.clear()
        preview(store, policy)
        fleet.vote(1)
        timed("mapvote, 1 new", partial(preview, store, policy))
        database.remembered.clear()
        timed("mapvote", partial(preview, store, policy))
        with closing(sqlite3.connect(file)) as connection:
            for name, peer in PEERS.items():
                timed(name, lambda connection=connection, peer=peer: [peer(connection, tile) for tile in tiles])
    store.close()
    file.unlink()
    median = {name: round(statistics.median(took[1:]), 2) for name, took in cpu.items()}
    bytes_each = round(fleet.bytes / fleet.vehicles / n_tiles)
    return {"vehicles": vehicles, "tiles": n_tiles, "bytes a ballot and tile": bytes_each, "CPU ms a tile": median}


def noisy_street(tiles: Sequence[TileIndex]) -> PointMap:
    """The street as a LiDAR measures it."""
    exact, rng = street(tiles), np.random.default_rng(2)
    for index, tile in exact.tiles.items():
        points = tile.points + rng.normal(0.0, 0.02, tile.points.shape).astype(np.float32)
        points[:, :2] = points[:, :2].clip(0.0, 76.7)
        exact.tiles[index] = tile.but(points=points)  # type: ignore[index]
    return exact


def kiosk_gone(say: Say) -> Say:
    """Statement of a vehicle that passes when the house is history and the kiosk has left again."""
    assert say.states is not None
    say.states[tuple(np.transpose(HOUSE))] = CellState.UNCHANGED_EMPTY
    say.states[tuple(np.transpose(KIOSK))] = CellState.CHANGED_EMPTY
    gone = np.where(say.states == CellState.CHANGED_EMPTY, np.uint64(0x7FE), np.uint64(0))
    return Say(say.states, gone=gone, free=say.free)


def published_ms(file: Path, tiles: Sequence[TileIndex], says: Sequence[Say]) -> float:
    """CPU of a publish, a tile, after three vehicles have said this."""
    store = Store.open(f"sqlite:///{file}")
    base, version = store.point_map(), store.current()
    for vehicle in range(3):
        mine = {tile: says[(vehicle + i) % len(says)] for i, tile in enumerate(tiles)}
        end_ns = DAY_NS + vehicle + 10**9 * version
        send(store, make_ballot(base, mine, f"v{vehicle}", f"d{version}", end_ns=end_ns, version=version))
    start = time.process_time()
    outcome = publish(store)
    took = 1e3 * (time.process_time() - start) / len(tiles)
    store.close()
    assert len(outcome.tiles) == len(tiles), outcome
    return took


def publishes(folder: Path, n_tiles: int, repeats: int) -> None:
    """Prints a line for each of the two."""
    rng, tiles = np.random.default_rng(1), [(0, col) for col in range(n_tiles)]
    policy = Policy(fuse=FuseSettings(max_deleted_share=1.0, max_freed_share=1.0, max_change_m2=1e6))
    Store.create(f"sqlite:///{folder}/first.db", noisy_street(tiles), policy).close()
    took: dict[str, list[float]] = {"first": [], "again": []}
    for _ in range(repeats + 1):
        file = Path(shutil.copy(folder / "first.db", folder / "store.db"))
        took["first"].append(published_ms(file, tiles, [said(rng) for _ in range(20)]))
        took["again"].append(published_ms(file, tiles, [kiosk_gone(said(rng)) for _ in range(20)]))
        file.unlink()
    for name, ms in took.items():
        told = f"{statistics.median(ms[1:]):.1f} | {statistics.fmean(ms[1:]):.1f} | {max(ms[1:]):.1f}"
        print(f"| {name}, {n_tiles} tiles | {told} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vehicles", type=int, nargs="+", default=[25, 50, 100, 200])
    parser.add_argument("--tiles", type=int, nargs="+", default=[4, 16])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--publish", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        for tiles in options.tiles if options.publish else ():
            publishes(Path(name), tiles, options.repeats)
        for vehicles in () if options.publish else options.vehicles:
            for tiles in options.tiles:
                print(measure(Path(name), vehicles, tiles, options.repeats), flush=True)


if __name__ == "__main__":
    main()
