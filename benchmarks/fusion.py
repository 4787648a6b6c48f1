"""How many votes on a cell the server fuses a second, from ballots in the store to what would be published.

    python benchmarks/fusion.py                        # 25 to 200 vehicles, 4 to 16 tiles, one and two threads
    python benchmarks/fusion.py --planes states        # votes alone: no delete masks, no points, no free space

A run is `preview()`: it reads every ballot from the database, decompresses it, checks which cells count,
decides, edits the tiles and packs them. One vehicle on one tile is 65,536 cell-votes, spoken or not. The ballots are
shaped like those of simulated drives: a corridor of street seen, noise along its borders, a house that fell and a
kiosk that rose. The peer is the same decision in plain numpy (`numpy_round`), from the same database with sqlite3 and
zstd, without edits and without looking at other planes; both take turns in one run.
"""

from __future__ import annotations

import argparse
import json
import sqlite3
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from backports import zstd

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from hand_made import Cell, Say, make_ballot, make_map, make_tile, wall
from mapvote.codec.ballot import encode
from mapvote.config import FuseSettings
from mapvote.core.grid import TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.types import NO_VOTE, U8, CellState
from mapvote.fusion.tile_vote import DAY_NS
from mapvote.server.store.admission import accept, examine
from mapvote.server.store.ballots import Receipt
from mapvote.server.store.publish import preview
from mapvote.server.store.store import Store

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
    """What one vehicle says about a tile after driving along it."""
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


def fill(store: Store, tiles: Sequence[TileIndex], vehicles: int, planes: str) -> float:
    """One ballot of every vehicle on all tiles; mean bytes a ballot and tile. No two say the same of a tile: such would
    be copies."""
    rng = np.random.default_rng(1)
    kinds = [said(rng) for _ in range(max(vehicles, 40))]
    base, size = store.point_map(), 0
    for vehicle in range(vehicles):
        says = {tile: kinds[(vehicle + i) % len(kinds)] for i, tile in enumerate(tiles)}
        if planes == "states":
            says = {tile: Say(say.states) for tile, say in says.items()}
        data = encode(make_ballot(base, says, f"v{vehicle:03}", "d", end_ns=DAY_NS + vehicle))
        size += len(data)
        (receipt,) = accept(store, [examine(data)])
        assert isinstance(receipt, Receipt), receipt
    return size / vehicles / len(tiles)


def numpy_tile(connection: sqlite3.Connection, tile: TileIndex) -> U8:
    """The peer: one tile's states by the columns rule with two votes for a change, in plain numpy."""
    rows = connection.execute("SELECT states FROM ballot_tiles WHERE row = ? AND col = ?", tile)
    planes = np.stack([np.frombuffer(zstd.decompress(data), np.uint8) for (data,) in rows])
    counts = np.stack([(planes == state).sum(axis=0) for state in range(5)])
    determined = counts[:4]
    best = determined.max(axis=0)
    states = determined.argmax(axis=0).astype(np.uint8)
    states[(determined == best).sum(axis=0) > 1] = CellState.UNDETERMINED
    states[best == 0] = np.where(counts[4] > 0, CellState.UNDETERMINED, NO_VOTE)[best == 0]
    change = (states == CellState.CHANGED_OCCUPIED) | (states == CellState.CHANGED_EMPTY)
    states[change & ((best < 2) | (2 * best <= determined.sum(axis=0)))] = CellState.UNDETERMINED
    return states


def numpy_round(file: Path, tiles: Sequence[TileIndex], threads: int) -> float:
    """Seconds for the peer."""

    def share(mine: Sequence[TileIndex]) -> None:
        connection = sqlite3.connect(file)
        for tile in mine:
            numpy_tile(connection, tile)
        connection.close()

    start = time.perf_counter()
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(share, [tiles[i::threads] for i in range(threads)]))
    return time.perf_counter() - start


def our_round(store: Store, policy: FuseSettings, threads: int) -> float:
    """Seconds for a dry run."""
    with ThreadPoolExecutor(threads) as pool:
        start = time.perf_counter()
        preview(store, policy, executor=pool)
        return time.perf_counter() - start


def measure(folder: Path, vehicles: int, n_tiles: int, planes: str, repeats: int) -> dict[str, Any]:
    """Medians over ``repeats`` turns of ours and the peer's with one and two threads, after one turn to warm up; also
    the best turn and the processor time of the cheapest, which a busy machine spoils less."""
    tiles = [(0, col) for col in range(n_tiles)]
    file = folder / f"{planes}_{vehicles}_{n_tiles}.db"
    store = Store.create(f"sqlite:///{file}", street(tiles))
    size = fill(store, tiles, vehicles, planes)
    policy = FuseSettings(latest_vehicles=vehicles, max_deleted_share=1.0)
    ours, theirs = partial(our_round, store, policy), partial(numpy_round, file, tiles)
    seconds: dict[str, list[float]] = {}
    cpu: dict[str, list[float]] = {}
    for turn in range(repeats + 1):
        for threads in (1, 2):
            for who, run in (("mapvote", ours), ("numpy", theirs)):
                start = time.process_time()
                took = run(threads)
                if turn:
                    seconds.setdefault(f"{who}_{threads}", []).append(took)
                    cpu.setdefault(f"{who}_{threads}", []).append(time.process_time() - start)
    store.close()
    file.unlink()
    votes = 256 * 256 * vehicles * n_tiles
    rate = {who: votes / statistics.median(s) / 1e9 for who, s in seconds.items()}
    best = {who: votes / min(s) / 1e9 for who, s in seconds.items()}
    return {
        "planes": planes,
        "vehicles": vehicles,
        "tiles": n_tiles,
        "bytes_a_ballot_and_tile": round(size),
        "G_cell_votes_per_s": {who: round(r, 3) for who, r in rate.items()},
        "best_turn": {who: round(r, 3) for who, r in best.items()},
        "cpu_ms_a_tile": {who: round(1e3 * min(s) / n_tiles, 2) for who, s in cpu.items()},
        "ratio_to_numpy_2_threads": round(rate["mapvote_2"] / rate["numpy_2"], 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--planes", choices=("all", "states"), default="all")
    parser.add_argument("--vehicles", type=int, nargs="+", default=[25, 50, 100, 200])
    parser.add_argument("--tiles", type=int, nargs="+", default=[4, 8, 16])
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    pairs = [(n, options.tiles[-1]) for n in options.vehicles]
    pairs += [(100, n) for n in options.tiles if (100, n) not in pairs]
    with tempfile.TemporaryDirectory() as name:
        for vehicles, tiles in pairs:
            print(json.dumps(measure(Path(name), vehicles, tiles, options.planes, options.repeats)), flush=True)


if __name__ == "__main__":
    main()
