"""What a publish costs a tile: three vehicles, as a server does it, from the plan to the commit.

    python benchmarks/publish.py [--tiles 16] [--repeats 7]

Tiles of some 29,000 points with 2 cm of noise, and ballots as in fusion.py. First a house goes and a kiosk comes; then
the kiosk goes again, on tiles that by now remember what came and know of free space. CPU milliseconds a tile: median,
mean and worst publish, each on a copy of the store.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fusion import HOUSE, KIOSK, said, street
from hand_made import Say, make_ballot
from mapvote.config import FuseSettings
from mapvote.core.grid import TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.types import CellState
from mapvote.fusion.tile_vote import DAY_NS
from mapvote.server.store.policy import Policy
from mapvote.server.store.publish import publish
from mapvote.server.store.store import Store
from stores import send

VEHICLES = 3


def measured_street(tiles: list[TileIndex]) -> PointMap:
    """The street as a LiDAR measures it."""
    exact, rng = street(tiles), np.random.default_rng(2)
    for index, tile in exact.tiles.items():
        points = tile.points + rng.normal(0.0, 0.02, tile.points.shape).astype(np.float32)
        points[:, :2] = points[:, :2].clip(0.0, 76.7)
        exact.tiles[index] = tile.but(points=points)  # type: ignore[index]
    return exact


def kiosk_gone(rng: np.random.Generator) -> Say:
    """What a vehicle says that passes when the house is history and the kiosk has left again."""
    say = said(rng)
    assert say.states is not None
    say.states[tuple(np.transpose(HOUSE))] = CellState.UNCHANGED_EMPTY
    say.states[tuple(np.transpose(KIOSK))] = CellState.CHANGED_EMPTY
    gone = np.where(say.states == CellState.CHANGED_EMPTY, np.uint64(0x7FE), np.uint64(0))
    return Say(say.states, gone=gone, free=say.free)


def vote(store: Store, says: list[Say], drive: str) -> None:
    """A ballot on all tiles of each vehicle."""
    point_map = store.point_map()
    for vehicle in range(VEHICLES):
        mine = {tile: says[(vehicle + i) % len(says)] for i, tile in enumerate(point_map.tiles)}
        end_ns = DAY_NS + vehicle + 10**9 * store.current()
        send(store, make_ballot(point_map, mine, f"v{vehicle}", drive, end_ns=end_ns, version=store.current()))


def timed(file: Path, tiles: int) -> float:
    """Milliseconds of CPU a tile of a publish."""
    store = Store.open(f"sqlite:///{file}")
    start = time.process_time()
    outcome = publish(store)
    took = 1e3 * (time.process_time() - start) / tiles
    store.close()
    assert len(outcome.tiles) == tiles, outcome
    return took


def measure(folder: Path, tiles: int, repeats: int) -> dict[str, list[float]]:
    first, file = folder / "first.db", folder / "store.db"
    policy = Policy(fuse=FuseSettings(max_deleted_share=1.0, max_freed_share=1.0, max_change_m2=1e6))
    store = Store.create(f"sqlite:///{first}", measured_street([(0, col) for col in range(tiles)]), policy)
    rng = np.random.default_rng(1)
    vote(store, [said(rng) for _ in range(20)], "d1")
    store.close()
    took: dict[str, list[float]] = {"first": [], "again": []}
    for turn in range(repeats + 1):
        shutil.copy(first, file)
        once = timed(file, tiles)
        store = Store.open(f"sqlite:///{file}")
        vote(store, [kiosk_gone(rng) for _ in range(20)], "d2")
        store.close()
        again = timed(file, tiles)
        if turn:
            took["first"].append(once)
            took["again"].append(again)
        for old in folder.glob("store.db*"):
            old.unlink()
    return took


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tiles", type=int, default=16)
    parser.add_argument("--repeats", type=int, default=7)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for name, took in measure(Path(folder), options.tiles, options.repeats).items():
            told = f"{statistics.median(took):.1f} | {statistics.fmean(took):.1f} | {max(took):.1f}"
            print(f"| {name}, {options.tiles} tiles | {told} |")


if __name__ == "__main__":
    main()
