"""By how many bytes does a store grow? Measured with real ballots on their map.

python benchmarks/growth.py MAP BALLOT...

The ballots are sent as a round, one vehicle each, and published. What each thing takes is read off the tables, and what
the database adds off the file.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import msgspec
import sqlalchemy as sa

from mapvote.codec.ballot import decode, encode
from mapvote.config import FuseSettings
from mapvote.formats import read_map
from mapvote.server.store import schema
from mapvote.server.store.admission import accept, examine
from mapvote.server.store.ballots import Receipt
from mapvote.server.store.policy import Policy, RoundPolicy
from mapvote.server.store.publish import publish
from mapvote.server.store.store import Store

_BLOBS = {
    "planes of tiles": (schema.blobs, ("data",)),
    "ballots": (schema.ballot_tiles, schema.BALLOT_PLANES),
    "decisions": (schema.decisions, ("states", "tally")),
}


def sizes(store: Store) -> dict[str, tuple[int, int]]:
    """Rows and bytes of everything that is large."""
    found = {}
    with store.database.reading() as connection:
        for name, (table, columns) in _BLOBS.items():
            size = sum((sa.func.coalesce(sa.func.length(table.c[c]), 0) for c in columns), start=sa.literal(0))
            row = connection.execute(sa.select(sa.func.count(), sa.func.coalesce(sa.func.sum(size), 0))).one()
            found[name] = int(row[0]), int(row[1])
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("map", type=Path)
    parser.add_argument("ballots", type=Path, nargs="+")
    asked = parser.parse_args()
    ballots = [decode(path.read_bytes()) for path in asked.ballots]
    first = ballots[0]
    policy = Policy(
        round=RoundPolicy.model_validate({"method": first.method}),
        fuse=FuseSettings(max_deleted_share=1.0, max_change_m2=1e6, max_freed_share=1.0),
    )
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "store.db"
        store = Store.create(f"sqlite:///{file}", read_map(asked.map), policy)
        before = sizes(store)
        print(f"the map: {before['planes of tiles'][0]} planes, {before['planes of tiles'][1]:,} bytes")
        for number, ballot in enumerate(ballots):
            mine = msgspec.structs.replace(ballot, vehicle=f"v{number}", version=1, map_id=store.map_id)
            (receipt,) = accept(store, [examine(encode(mine))])
            assert isinstance(receipt, Receipt), receipt
        voted = sizes(store)
        done = publish(store)
        after = sizes(store)
        rows, size = voted["ballots"]
        print(f"a ballot on a tile: {size / rows:,.0f} bytes ({rows} of them, {len(ballots)} ballots)")
        tiles = len(done.tiles)
        planes = after["planes of tiles"][1] - before["planes of tiles"][1]
        print(f"a tile that changed, in a version: {planes / max(tiles, 1):,.0f} bytes of planes ({tiles} of them)")
        rows, size = after["decisions"]
        print(f"a tile that was decided, in a version: {size / rows:,.0f} bytes ({rows} of them)")
        held = sum(size for _, size in after.values())
        store.close()
        print(f"the file: {file.stat().st_size:,} bytes for {held:,} bytes of these")


if __name__ == "__main__":
    main()
