"""What a city needs of a server: curves measured on stores that fit here, and what follows from them.

    python benchmarks/scale.py --measure results/scale.csv    # a minute and a half of CPU
    python benchmarks/scale.py                                # the tables of docs/scale.md, from results/scale.csv

Measured: tiles of 29,000 points with 2 cm of noise (publish.py), ballots as in fusion.py, but packed as vehicles pack
them; some vehicles vote on all tiles, then a version is published. CPU and bytes, each a tile; medians of three stores.
"""

from __future__ import annotations

import argparse
import csv
import statistics
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

ROOT = Path(__file__).parents[1]
SIZES = ((4, 3), (16, 3), (64, 3), (256, 3), (16, 9), (16, 27))
"""(tiles, vehicles)"""
ROAD_KM, VEHICLES, KM_A_DAY, TILES_A_KM, PUBLISHED_A_DAY, KEPT_DAYS = 1000, 1000, 60, 28, 24, 30
PEAK = 4
"""Busiest hour over the mean one: a guess."""
Rows = Sequence[Mapping[str, float]]


def as_sent(say: Any) -> Any:
    """What a hand-made vehicle says, packed as a real one packs it: small rather than quickly."""
    import msgspec

    from hand_made import Say
    from mapvote.codec.arrays import pack_plane
    from mapvote.codec.ballot import pack_points

    small = {"states": pack_plane(say.states), "new_points": pack_points(say.new_points)}

    class Sent(Say):
        def packed(self, tile: Any) -> Any:
            return msgspec.structs.replace(super().packed(tile), **small)

    return Sent(**vars(say))


def sizes(store: Any) -> dict[str, tuple[int, int]]:
    """Rows and bytes of everything that is large."""
    import sqlalchemy as sa

    from mapvote.server.store import schema

    large = {
        "planes of tiles": (schema.blobs, ("data",)),
        "ballots": (schema.ballot_tiles, schema.BALLOT_PLANES),
        "decisions": (schema.decisions, ("states", "tally")),
    }
    found = {}
    with store.database.reading() as connection:
        for name, (table, columns) in large.items():
            size = sum((sa.func.coalesce(sa.func.length(table.c[c]), 0) for c in columns), start=sa.literal(0))
            row = connection.execute(sa.select(sa.func.count(), sa.func.coalesce(sa.func.sum(size), 0))).one()
            found[name] = int(row[0]), int(row[1])
    return found


def measure(folder: Path, tiles: int, vehicles: int) -> dict[str, float]:
    """One store, filled and published."""
    from fusion import Fleet
    from mapvote.config import FuseSettings
    from mapvote.server.store.policy import Policy
    from mapvote.server.store.publish import publish
    from mapvote.server.store.store import Store
    from publish import measured_street

    open_policy = Policy(fuse=FuseSettings(latest_vehicles=vehicles, max_deleted_share=1.0, max_change_m2=1e6))
    places = [(i // 16, i % 16) for i in range(tiles)]
    file = folder / "store.db"
    store = Store.create(f"sqlite:///{file}", measured_street(places), open_policy)
    drawn = sizes(store)
    fleet = Fleet(store, places, vehicles, "all")
    fleet.kinds = [as_sent(say) for say in fleet.kinds]
    start = time.process_time()
    fleet.vote(vehicles)
    voted, at = sizes(store), time.process_time()
    outcome = publish(store)
    took, after = time.process_time() - at, sizes(store)
    store.close()
    for old in folder.glob("store.db*"):
        old.unlink()
    assert len(outcome.tiles) == tiles
    return {
        "tiles": tiles,
        "vehicles": vehicles,
        "cast_and_taken_ms": 1e3 * (at - start) / tiles / vehicles,
        "publish_ms": 1e3 * took / tiles,
        "map_bytes": drawn["planes of tiles"][1] / tiles,
        "ballot_bytes": voted["ballots"][1] / voted["ballots"][0],
        "version_bytes": (after["planes of tiles"][1] - drawn["planes of tiles"][1]) / tiles,
        "decision_bytes": after["decisions"][1] / after["decisions"][0],
    }


def write(path: Path) -> None:
    rows = []
    with tempfile.TemporaryDirectory() as name:
        measure(Path(name), 4, 3)
        for tiles, vehicles in SIZES:
            turns = [measure(Path(name), tiles, vehicles) for _ in range(3)]
            rows.append({key: round(statistics.median(turn[key] for turn in turns), 2) for key in turns[0]})
            print(rows[-1], flush=True)
    with path.open("w", newline="") as file:
        out = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        out.writeheader()
        out.writerows(rows)


def read(path: Path) -> Rows:
    with path.open() as file:
        return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]


def curves(rows: Rows) -> list[str]:
    """What was measured, as a table."""
    lines = [
        "| tiles | vehicles on each | publish, ms of CPU a tile | map, kB a tile | a ballot, kB a tile |"
        " a changed tile in a version, kB | its decision, kB |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        kilobytes = (row[name] / 1e3 for name in ("map_bytes", "ballot_bytes", "version_bytes", "decision_bytes"))
        told = " | ".join(f"{size:.1f}" for size in kilobytes)
        lines.append(f"| {row['tiles']:.0f} | {row['vehicles']:.0f} | {row['publish_ms']:.1f} | {told} |")
    return lines


def city(rows: Rows) -> list[str]:
    """What 1,000 km and 1,000 vehicles need, as a table: each line says how it follows."""
    largest = max(rows, key=lambda row: row["tiles"])
    nine = next(row for row in rows if row["vehicles"] == 9)
    tiles = ROAD_KM * TILES_A_KM
    votes = VEHICLES * KM_A_DAY * TILES_A_KM
    sent_gb = votes * largest["ballot_bytes"] / 1e9
    round_s = tiles * nine["publish_ms"] / 1e3
    lines = [
        ("tiles of the map", f"{ROAD_KM:,} km x {TILES_A_KM} tiles a km", f"{tiles:,}"),
        ("the map on disk", "x map", f"{tiles * largest['map_bytes'] / 1e9:.1f} GB"),
        ("votes on a tile a day", f"{VEHICLES:,} vehicles x {KM_A_DAY} km x {TILES_A_KM}", f"{votes:,}"),
        ("sent to the server a day", "x a ballot", f"{sent_gb:.1f} GB, {1e3 * sent_gb / VEHICLES:.0f} MB a vehicle"),
        ("bandwidth in, mean and peak", f"x 8 bits / 86,400 s; x {PEAK}",
         f"{8e3 * sent_gb / 86400:.1f} and {PEAK * 8e3 * sent_gb / 86400:.1f} Mbit/s"),
        (f"ballots kept for {KEPT_DAYS} days", f"x {KEPT_DAYS}", f"{KEPT_DAYS * sent_gb:.0f} GB"),
        ("fusing every tile once, one core", "tiles x publish with 9 vehicles", f"{round_s / 60:.1f} min of CPU"),
        (f"cores for {PUBLISHED_A_DAY} versions a day", "x versions / 86,400 s",
         f"{PUBLISHED_A_DAY * round_s / 86400:.2f}"),
        ("decisions kept a day, if every tile is decided in each", "tiles x versions x its decision",
         f"{tiles * PUBLISHED_A_DAY * nine['decision_bytes'] / 1e9:.1f} GB"),
        ("a version in which 1 tile of 100 changes", "tiles / 100 x a changed tile",
         f"{tiles / 100 * largest['version_bytes'] / 1e6:.0f} MB"),
    ]  # fmt: skip
    return ["| what | how it follows | a city |", "|---|---|---|", *(f"| {' | '.join(line)} |" for line in lines)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--measure", type=Path)
    options = parser.parse_args()
    if options.measure is not None:
        write(options.measure)
    rows = read(options.measure or ROOT / "results" / "scale.csv")
    print("\n".join([*curves(rows), "", *city(rows)]))


if __name__ == "__main__":
    main()
