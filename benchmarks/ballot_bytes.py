"""What a ballot's planes take, kB a tile, in this format and with new points as float32, which format 2 had.

    python benchmarks/ballot_bytes.py MAP DRIVE ...

Every drive votes once, its new points unrounded; then they are written in both ways.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

import msgspec

from mapvote import vehicle
from mapvote.codec.arrays import pack_plane
from mapvote.codec.ballot import Ballot, BallotTile, encode
from mapvote.codec.points import pack_points, unpack_points
from mapvote.formats import open_drive, read_map

PLANES = "states", "tally", "gone", "free", "intensity", "odds"


def by_voxels(tile: BallotTile) -> BallotTile:
    """The same tile, with its new points as ballots have them."""
    points = tile.new_points and pack_points(unpack_points(tile.new_points))
    return msgspec.structs.replace(tile, new_points=points)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("map", type=Path)
    parser.add_argument("drives", nargs="+", type=Path)
    options = parser.parse_args()
    vehicle.pack_points = pack_plane  # type: ignore[attr-defined]
    point_map = read_map(options.map)
    taken, tiles, points = Counter[str](), 0, 0
    for folder in options.drives:
        ballot: Ballot = vehicle.vote_drive(open_drive(folder), point_map)[0]
        tiles += len(ballot.tiles)
        for tile in ballot.tiles:
            taken.update({name: len(getattr(tile, name) or b"") for name in PLANES})
            points += 0 if tile.new_points is None else len(unpack_points(tile.new_points))
        rounded = msgspec.structs.replace(ballot, tiles=[by_voxels(tile) for tile in ballot.tiles])
        for name, written in (("as float32", ballot), ("by voxels", rounded)):
            taken[f"points {name}"] += sum(len(tile.new_points or b"") for tile in written.tiles)
            taken[f"whole, points {name}"] += len(encode(written))
    print(f"{tiles} tiles, {points} new points; kB a tile:")
    for name, size in sorted(taken.items(), key=lambda one: one[1]):
        print(f"| {name} | {size / tiles / 1e3:.2f} |")


if __name__ == "__main__":
    main()
