"""Built and demolished objects between two versions: compared once, kept by the two versions."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from threading import Lock

import msgspec
import numpy as np
import sqlalchemy as sa

from mapvote.codec.ballot import tile_key
from mapvote.core.grid import CELL_SIZE, Lattice, TileIndex
from mapvote.core.record import record
from mapvote.core.tile import Tile
from mapvote.core.types import NO_VOTE, U8, CellState, MapvoteError
from mapvote.fusion.decision_record import Record
from mapvote.fusion.tile_vote import Vote
from mapvote.shapes.change_objects import ChangedCells, ChangeObject, Decided, change_objects, changed_cells
from mapvote.shapes.cutout import Cutout, Tiles, of_feature, whole_page
from mapvote.shapes.geojson import Bounds, Changes, meet, to_geojson
from mapvote_server.errors import Unavailable
from mapvote_server.questions.explain import seen, sound_votes
from mapvote_server.store.integrity import hurt_or_mended_since
from mapvote_server.store.queries import load_tile, newest_seq, records_of, tile_of, tiles_that_differ, version_of
from mapvote_server.store.retention import cleared_since
from mapvote_server.store.store import PerStore, Store
from mapvote_server.work import check_time


@record()
@dataclass(frozen=True, slots=True)
class KeptChanges:
    """Limits of what is kept of compared versions."""

    pairs: int = 16
    """Pairs of versions that were asked for last."""
    cells: int = 2_000_000
    """Changed cells of all these pairs; the pair asked for last stays in any case."""


KEPT_CHANGES = KeptChanges()


@dataclass(frozen=True, slots=True)
class Comparison:
    """The differences between two versions."""

    old: int
    new: int
    objects: Sequence[ChangeObject]
    """The largest first."""
    damaged: Sequence[str]
    """Keys of the tiles that cannot be read; they are left out."""
    digest: str
    """SHA-256 of all this, in hex."""


@dataclass(slots=True)
class _Pair:
    """Results for two versions so far: a comparison that ran out of time goes on from there."""

    comparing: Lock = field(default_factory=Lock)
    tiles: dict[TileIndex, ChangedCells | None] = field(default_factory=dict)
    """None: cannot be read."""
    made: Comparison | None = None
    cells: int = 0


class _Kept:
    """The pairs of one store that were asked for last."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._pairs: OrderedDict[tuple[int, int], _Pair] = OrderedDict()
        self._mark: int | None = None
        """The last event that the pairs know of."""

    def pair(self, connection: sa.Connection, old: int, new: int) -> _Pair:
        """Comparisons by their two versions. All are forgotten once a plane or a ballot is cleared away, set aside or
        mended: it may have been a part of any."""
        with self._lock:
            mark = self._mark
            if mark is not None and (cleared_since(connection, mark) or hurt_or_mended_since(connection, mark)):
                self._pairs.clear()
            self._mark = newest_seq(connection)
            kept = self._pairs.setdefault((old, new), _Pair())
            self._pairs.move_to_end((old, new))
            while len(self._pairs) > 1 and self._are_too_many():
                self._pairs.popitem(last=False)
            return kept

    def _are_too_many(self) -> bool:
        cells = sum(pair.cells for pair in self._pairs.values())
        return len(self._pairs) > KEPT_CHANGES.pairs or cells > KEPT_CHANGES.cells


_kept = PerStore(_Kept)


def compare_versions(store: Store, old: int, new: int) -> Comparison:
    """The things built and demolished from version ``old`` to ``new``; made once, as no version ever changes.

    NotFound if one of the versions does not exist.
    """
    kept = _kept.of(store)
    with store.database.reading() as connection:
        for number in (old, new):
            version_of(connection, number)
        pair = kept.pair(connection, old, new)
        with pair.comparing:
            if pair.made is None:
                pair.made = _compare(store, connection, old, new, pair)
            return pair.made


def _compare(store: Store, connection: sa.Connection, old: int, new: int, pair: _Pair) -> Comparison:
    """Tiles that ``pair`` has are not read again."""
    for index, *states in tiles_that_differ(connection, old, new):
        if index in pair.tiles:
            continue
        check_time()
        try:
            before, after = (load_tile(connection, store.lattice.tile(index), hashes) for hashes in states)
            decided = _decided(connection, index, min(old, new), max(old, new))
            pair.tiles[index] = changed_cells(before, after, decided)
        except Unavailable:
            raise
        except MapvoteError:
            pair.tiles[index] = None
    changed = [cells for cells in pair.tiles.values() if cells is not None]
    objects = sorted(change_objects(changed), key=lambda one: -one.cells)
    damaged = [tile_key(index) for index, cells in sorted(pair.tiles.items()) if cells is None]
    pair.cells = sum(one.cells for one in objects)
    pair.tiles.clear()
    said = msgspec.json.encode((old, new, objects, damaged), enc_hook=np.ndarray.tolist)
    return Comparison(old, new, objects, damaged, hashlib.sha256(said).hexdigest())


def changes_between(
    store: Store,
    old: int,
    new: int,
    min_cells: int = 1,
    *,
    lonlat: bool = False,
    with_names: bool = True,
    box: Bounds | None = None,
    part: slice = slice(None),
) -> Changes:
    """Change objects from version ``old`` to ``new`` as GeoJSON in map metres, or longitude and latitude (``lonlat``),
    the largest first. ``with_names``: see :func:`seen`. Tiles that cannot be read are left out, and named as "damaged".

    ``box``: only those whose own box meets it.

    ``part``: these of them. "numberMatched" is the number of all with at least ``min_cells`` cells, "numberReturned" of
    those here (OGC API Features). NotFound if one of the versions does not exist.
    """
    compared = compare_versions(store, old, new)
    large = [thing for thing in compared.objects if thing.cells >= min_cells]
    listed = [thing for thing in large if box is None or meet(box, _bounds(thing, store.lattice))]
    features = to_geojson(
        [
            replace(
                thing,
                first_seen_ns=seen(thing.first_seen_ns, with_names),
                last_seen_ns=seen(thing.last_seen_ns, with_names),
            )
            for thing in listed[part]
        ],
        store.lattice,
        map_id=store.map_id,
        from_version=old,
        to_version=new,
        georeference=store.georeference,
        lonlat=lonlat,
        among=listed,
    )
    return replace(features, damaged=list(compared.damaged) or None)


def _bounds(change: ChangeObject, lattice: Lattice) -> Bounds:
    col0, row0, col1, row1 = (CELL_SIZE * corner for corner in change.box)
    return lattice.x0 + col0, lattice.y0 + row0, lattice.x0 + col1, lattice.y0 + row1


def cutouts_between(store: Store, old: int, new: int, changes: Changes, most: int = 12) -> list[Cutout]:
    """The largest things of :func:`changes_between` with their surroundings, before and after."""
    tiles = tiles_at(store, old), tiles_at(store, new)
    large = [feature for feature in changes.features if feature.properties.size == "large"] or changes.features
    largest = sorted(large, key=lambda feature: -feature.properties.area_m2)[:most]
    return [of_feature(feature, tiles, store.lattice) for feature in largest]


def page_between(store: Store, old: int, new: int, changes: Changes) -> str:
    """HTML of :func:`cutouts_between`, one file without any request."""
    return whole_page(f"{changes.map_id}: version {old} to {new}", cutouts_between(store, old, new, changes))


def tiles_at(store: Store, version: int) -> Tiles:
    """Tiles of one version by their index, each loaded once. NotFound if there is no such version."""
    with store.database.reading() as connection:
        version_of(connection, version)

    @cache
    def load(index: TileIndex) -> Tile:
        with store.database.reading() as connection:
            return load_tile(connection, store.lattice.tile(index), tile_of(connection, version, index))

    return load


def _decided(connection: sa.Connection, index: TileIndex, old: int, new: int) -> list[Decided]:
    """The decisions of the versions after ``old`` up to ``new`` on a tile, and the ballots that counted; MapvoteError
    if a record is damaged."""
    records = records_of(connection, index, after=old, upto=new)
    counted = {vote.ballot for record in records for vote in record.standings if not vote.why}
    sound = sound_votes(connection, index, counted)
    return [(record, _drives(record, sound)) for record in records]


def _drives(record: Record, sound: Mapping[int, Vote]) -> list[tuple[int, U8]]:
    """(end_ns, states) of the ballots that counted, in the cells where they did. A cell that the version trimmed is
    CHANGED_EMPTY where the ballot marks voxels of it as gone."""
    drives = []
    for standing in record.standings:
        vote = sound.get(standing.ballot)
        if not standing.why and vote is not None and vote.states is not None:
            states = vote.states.copy()
            if vote.gone is not None:
                trimmed = np.intersect1d(vote.gone.cells, record.edit_votes.cells, assume_unique=True)
                at = states.reshape(-1)[trimmed] == CellState.UNCHANGED_OCCUPIED
                states.reshape(-1)[trimmed[at]] = CellState.CHANGED_EMPTY
            for cells in (standing.spent, standing.reviewed):
                states.reshape(-1)[cells] = NO_VOTE
            drives.append((vote.end_ns, states))
    return drives
