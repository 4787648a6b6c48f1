"""Changes between versions, coverage of tiles, consistency of vehicles."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import islice
from typing import Any

import sqlalchemy as sa

from mapvote.codec.ballot import tile_key
from mapvote.codec.manifest import TileHashes
from mapvote.codec.tile_planes import names_in_plane
from mapvote.core.grid import TileIndex
from mapvote.core.tile import Tile
from mapvote.core.types import NO_VOTE, U8, MapvoteError
from mapvote.fusion.tile_vote import TileVote
from mapvote.server.errors import Unavailable
from mapvote.server.store import schema
from mapvote.server.store.decisions import Standing, cells_in, records_of
from mapvote.server.store.integrity import set_aside
from mapvote.server.store.queries import (
    current_version,
    load_blob,
    load_tile,
    oldest_kept,
    tiles_of,
    tiles_that_differ,
    version_of,
)
from mapvote.server.store.store import Store
from mapvote.server.store.votes import (
    StoredVote,
)
from mapvote.server.views.change_objects import Decided, change_objects, changed_cells
from mapvote.server.views.cutout import Cutout, Tiles, of_feature, whole_page
from mapvote.server.views.events import last_events
from mapvote.server.views.explain import seen, sound_votes
from mapvote.server.views.geojson import to_geojson

_LOOKED_AT = 3


def overview(store: Store) -> dict[str, Any]:
    """The figures of `mapvote info`."""
    b, t = schema.ballots, schema.ballot_tiles
    standing = sa.select(sa.func.count(), sa.func.count(sa.distinct(b.c.vehicle))).where(b.c.gone_seq.is_(None))
    with store.database.reading() as connection:
        newest = current_version(connection)
        ballots, vehicles = connection.execute(standing).one()
        planes, size = connection.execute(
            sa.select(sa.func.count(), sa.func.coalesce(sa.func.sum(sa.func.length(schema.blobs.c.data)), 0))
        ).one()
        votes = connection.execute(sa.select(sa.func.count()).select_from(t)).scalar_one()
        tiles = tiles_of(connection, newest.number)
        return {
            "map_id": store.map_id,
            "version": newest.number,
            "published_ns": newest.created_ns,
            "oldest_version": oldest_kept(connection),
            "tiles": len(tiles),
            "fields": _fields(connection, tiles.values()),
            "ballots": ballots,
            "vehicles": vehicles,
            "votes_on_tiles": votes,
            "planes": planes,
            "plane_bytes": int(size),
            "quarantined": len(set_aside(connection)),
        }


def _fields(connection: sa.Connection, tiles: Iterable[TileHashes]) -> str:
    """Names of the point fields, by the first readable tiles that have any."""
    names: dict[str, None] = {}
    for digest in islice((hashes.fields for hashes in tiles if hashes.fields is not None), _LOOKED_AT):
        try:
            names |= dict.fromkeys(names_in_plane(load_blob(connection, digest), digest))
        except Unavailable:
            raise
        except MapvoteError:
            continue
    return ", ".join(names) or "none"


def log_of(store: Store, last: int) -> dict[str, Any]:
    """The versions, oldest first, and the ``last`` so many events, newest first."""
    columns = ("number", "parent", "kind", "target", "created_ns", "published_by", "reason")
    versions = [{name: getattr(version, name) for name in columns} for version in store.versions()]
    return {"versions": versions, "events": last_events(store, last) if last else []}


def changes_between(
    store: Store, old: int, new: int, min_cells: int = 1, *, lonlat: bool = False, known: bool = True
) -> dict[str, Any]:
    """Change objects from version ``old`` to ``new`` as GeoJSON in map metres, or longitude and latitude (``lonlat``).
    ``known``: see :func:`seen`. Tiles that cannot be read are left out, and named as "damaged".

    NotFound if one of the versions does not exist.
    """
    with store.database.reading() as connection:
        found, damaged = [], []
        for index, *pair in tiles_that_differ(connection, old, new):
            try:
                tiles = [load_tile(connection, store.lattice.tile(index), hashes) for hashes in pair]
                decided = _decided(connection, index, min(old, new), max(old, new))
            except Unavailable:
                raise
            except MapvoteError:
                damaged.append(tile_key(index))
                continue
            found.append(changed_cells(tiles[0], tiles[1], decided))
    collection = to_geojson(
        [
            replace(thing, first_seen_ns=seen(thing.first_seen_ns, known), last_seen_ns=seen(thing.last_seen_ns, known))
            for thing in change_objects(found, min_cells)
        ],
        store.lattice,
        map_id=store.map_id,
        from_version=old,
        to_version=new,
        georeference=store.georeference,
        lonlat=lonlat,
    )
    return collection | ({"damaged": damaged} if damaged else {})


def cutouts_between(store: Store, old: int, new: int, found: Mapping[str, Any], most: int = 12) -> list[Cutout]:
    """The largest things of :func:`changes_between` with their surroundings, before and after."""
    tiles = tiles_at(store, old), tiles_at(store, new)
    large = [f for f in found["features"] if f["properties"]["size"] == "large"] or list(found["features"])
    largest = sorted(large, key=lambda f: -f["properties"]["area_m2"])[:most]
    return [of_feature(feature, tiles, store.lattice) for feature in largest]


def page_between(store: Store, old: int, new: int, found: Mapping[str, Any]) -> str:
    """HTML of :func:`cutouts_between`, one file without any request."""
    return whole_page(f"{found['map_id']}: version {old} to {new}", cutouts_between(store, old, new, found))


def tiles_at(store: Store, version: int) -> Tiles:
    """Tiles of one version by their index, each loaded once. NotFound if there is no such version."""
    with store.database.reading() as connection:
        version_of(connection, version)
        hashes = tiles_of(connection, version)

    @cache
    def load(index: TileIndex) -> Tile:
        with store.database.reading() as connection:
            return load_tile(connection, store.lattice.tile(index), hashes.get(index))

    return load


def _decided(connection: sa.Connection, index: TileIndex, old: int, new: int) -> list[Decided]:
    """What the versions after ``old`` up to ``new`` decided about a tile, and what the ballots said that counted."""
    records = records_of(connection, index, after=old, upto=new)
    counted = {standing.ballot for record in records for standing in record.standings if not standing.why}
    sound = sound_votes(connection, index, counted)
    return [
        Decided(record.version, record.states, record.tally, _drives(record.standings, sound), record.odds)
        for record in records
    ]


def _drives(standings: Sequence[Standing], sound: Mapping[int, tuple[StoredVote, TileVote]]) -> list[tuple[int, U8]]:
    """(end_ns, states) of the ballots that counted, in the cells where they did."""
    found = []
    for standing in standings:
        _, vote = sound.get(standing.ballot, (None, None))
        if not standing.why and vote is not None and vote.states is not None:
            states = vote.states.copy()
            for cells in (standing.spent, standing.reviewed):
                states.reshape(-1)[cells_in(cells)] = NO_VOTE
            found.append((vote.end_ns, states))
    return found
