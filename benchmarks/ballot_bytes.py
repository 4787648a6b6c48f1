"""What a ballot's planes take, kB a tile, in this format and with new points as float32, which format 2 had.

    python benchmarks/ballot_bytes.py OUT/v1.ballot ...

Ballots of either format: points are written anew in both.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

import msgspec

from mapvote.codec.arrays import pack_plane
from mapvote.codec.ballot import BallotTile, decode, encode
from mapvote.codec.points import pack_points, unpack_points

PLANES = "states", "tally", "gone", "free", "intensity"


def with_points(tile: BallotTile, as_float32: bool) -> BallotTile:
    """The same tile with its new points written in one of two ways."""
    if tile.new_points is None:
        return tile
    points = unpack_points(tile.new_points)
    return msgspec.structs.replace(tile, new_points=pack_plane(points) if as_float32 else pack_points(points))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ballots", nargs="+", type=Path)
    taken, tiles, points = Counter[str](), 0, 0
    for file in parser.parse_args().ballots:
        ballot = decode(file.read_bytes())
        tiles += len(ballot.tiles)
        for tile in ballot.tiles:
            taken.update({name: len(getattr(tile, name) or b"") for name in PLANES})
            points += 0 if tile.new_points is None else len(unpack_points(tile.new_points))
        for name, as_float32 in (("as float32", True), ("by voxels", False)):
            again = msgspec.structs.replace(ballot, tiles=[with_points(tile, as_float32) for tile in ballot.tiles])
            taken[f"points {name}"] += sum(len(tile.new_points or b"") for tile in again.tiles)
            taken[f"whole, points {name}"] += len(encode(again))
    print(f"{tiles} tiles, {points} new points; kB a tile:")
    for name, size in sorted(taken.items(), key=lambda one: one[1]):
        print(f"| {name} | {size / tiles / 1e3:.2f} |")


if __name__ == "__main__":
    main()
