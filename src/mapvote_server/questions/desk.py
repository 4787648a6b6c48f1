"""The review desk: changes that a publish would make now, deletions beyond the budget, and verdicts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from threading import Lock
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from mapvote.codec.manifest import TileHashes
from mapvote.core.columns import EVERY_BIT
from mapvote.core.grid import CELL_SIZE, CELLS, TILE_CELLS, TileIndex
from mapvote.core.tile import Tile
from mapvote.core.types import Bool
from mapvote.fusion.edit import delete_points
from mapvote.fusion.loss_budget import PendingDeletions
from mapvote.shapes.change_objects import ChangedCells, ChangeObject, change_objects, changed_cells
from mapvote.shapes.geojson import to_geojson
from mapvote.shapes.packed_cloud import came_and_went
from mapvote_server.errors import NotFound
from mapvote_server.questions.coverage import waiting_votes
from mapvote_server.store.fusion_jobs import Fused, edited_tile
from mapvote_server.store.publish import Gate, Round, doubts_of, reasons_to_hold, round_at
from mapvote_server.store.queries import load_tile, tile_of
from mapvote_server.store.reviews import Review, Verdict, decide, standing
from mapvote_server.store.store import Store

_OF_REVIEW = "verdict."
_lock = Lock()


@dataclass(frozen=True, slots=True)
class Proposed:
    """A tile as a publish would make it."""

    hashes: TileHashes
    points: int
    make: Callable[[], Tile]
    """The tile itself."""


@dataclass(frozen=True, slots=True)
class Desk:
    """The desk at one moment."""

    version: int
    """The newest, on which a publish would build."""
    held: list[str]
    """The policy's reasons to hold the version."""
    doubts: list[str]
    """Warnings on the voters for a reviewer."""
    waits: str
    """Changes that lack only the quorum, if a publish would change nothing; else ""."""
    pending: dict[str, Any]
    """Changes that a publish would make, GeoJSON; accepted ones carry the verdict."""
    waiting: list[dict[str, Any]]
    """Deletions beyond the policy's budget of false deletions, GeoJSON features."""
    reviewed: list[Review]
    """Held and rejected changes, which a publish leaves out."""
    objects: Mapping[str, ChangeObject]
    """Pending changes by their ids."""
    edited: Mapping[TileIndex, Proposed]
    """Tiles as a publish would make them."""
    clouds: bytes
    """Points that would be added and deleted, as :meth:`mapvote.shapes.packed_cloud.Clouds.changed` gives them."""


_desks: WeakKeyDictionary[Round, Desk] = WeakKeyDictionary()
"""Desks of the rounds that are kept."""


def desk(store: Store, executor: Executor | None = None, gate: Gate | None = None) -> Desk:
    """The changes that a publish would make now. Nothing is written, and nothing is computed again while the round
    holds."""
    found = round_at(store, store.clock(), executor=executor, every=True)
    with _lock:
        known = _desks.get(found)
        if known is None:
            known = _desks[found] = _desk_of(store, found)
    return replace(known, held=reasons_to_hold(store, found, gate))


def _desk_of(store: Store, found: Round) -> Desk:
    version = found.newest.number
    budget = found.asked.settings.false_deletions
    looked = [_look_at(store, version, fused) for fused in found.changed]
    objects = change_objects([cells for cells, _ in looked])
    pending = to_geojson(
        objects, store.lattice, map_id=store.map_id, from_version=version, georeference=store.georeference
    )
    reviews = standing(store)
    known = {one.id: one for one in objects}
    for feature in pending["features"]:
        mine = _cells_of(known[feature["id"]]) if reviews else {}
        feature["properties"]["verdict"] = next(
            (_verdict_json(r) for r, theirs in reviews if _meet(mine, theirs)), None
        )
    left_out = [review for review, _ in reviews if review.verdict != "accepted"]
    edited = {fused.index: _proposed(store, version, fused) for fused in found.changed}
    clouds = b"".join(cloud for _, cloud in looked)
    waiting = _waiting_features(store, version, [*found.decided.values(), *found.beside.values()], budget)
    lacking = None if found.changed else waiting_votes(store)
    waits = "" if lacking is None else str(lacking)
    doubts = doubts_of(store, found).told(found.asked.settings)
    return Desk(version, [], doubts, waits, pending, waiting, left_out, known, edited, clouds)


def _look_at(store: Store, version: int, fused: Fused) -> tuple[ChangedCells, bytes]:
    """(changed cells of a tile that a publish would change, the points that would come and go)."""
    before = _tile(store, version, fused.index)
    after = edited_tile(fused, before)
    record = fused.record
    return changed_cells(before, after, [] if record is None else [(record, ())]), came_and_went(before, after)


def _proposed(store: Store, version: int, fused: Fused) -> Proposed:
    assert fused.hashes is not None
    points = fused.points + fused.added - fused.deleted
    return Proposed(fused.hashes, points, lambda: edited_tile(fused, _tile(store, version, fused.index)))


def review(
    store: Store,
    change: str,
    verdict: Verdict,
    *,
    by: str,
    comment: str = "",
    after: int | None = None,
    executor: Executor | None = None,
) -> int:
    """Decide about a pending change, or about one that was held or rejected (``verdict.N``); the verdict's number.

    ``after`` as in :func:`mapvote_server.store.reviews.decide`. NotFound if no such change is pending any more.
    """
    now = desk(store, executor)
    features = {f["id"]: f for f in now.pending["features"]}
    features |= {f"{_OF_REVIEW}{r.seq}": dict(r.feature) for r in now.reviewed}
    if change not in features:
        raise NotFound(f"no change {change[:80]!r} is pending any more: look again")
    feature = features[change] | {"properties": features[change]["properties"] | {"verdict": None}}
    cells = _cells_of(now.objects[change]) if change in now.objects else _cells_of_review(store, change)
    return decide(store, verdict, feature, cells, by=by, comment=comment, after=after)


def _cells_of_review(store: Store, change: str) -> Mapping[TileIndex, Bool]:
    """The cells of a change that was reviewed, by the id of its verdict."""
    return next(cells for one, cells in standing(store) if f"{_OF_REVIEW}{one.seq}" == change)


def verdict_of(review: Review) -> dict[str, Any]:
    """A held or rejected change as GeoJSON, in the state of its review, with the verdict."""
    properties = dict(review.feature["properties"]) | {"verdict": _verdict_json(review)}
    return dict(review.feature) | {"id": f"{_OF_REVIEW}{review.seq}", "properties": properties}


def _verdict_json(review: Review) -> dict[str, Any]:
    return {name: getattr(review, name) for name in ("seq", "verdict", "by", "comment", "at_ns")}


def _tile(store: Store, version: int, index: TileIndex) -> Tile:
    with store.database.reading() as connection:
        return load_tile(connection, store.lattice.tile(index), tile_of(connection, version, index))


def _cells_of(change: ChangeObject) -> dict[TileIndex, Bool]:
    found: dict[TileIndex, Bool] = {}
    rows, cols = change.where
    tiles = np.stack([rows // TILE_CELLS, cols // TILE_CELLS], axis=1)
    for index in np.unique(tiles, axis=0):
        mine = (tiles == index).all(axis=1)
        plane = np.zeros((TILE_CELLS, TILE_CELLS), dtype=np.bool_)
        plane[rows[mine] % TILE_CELLS, cols[mine] % TILE_CELLS] = True
        found[int(index[0]), int(index[1])] = plane
    return found


def _meet(mine: Mapping[TileIndex, Bool], theirs: Mapping[TileIndex, Bool]) -> bool:
    return any((mine[i] & theirs[i]).any() for i in mine.keys() & theirs.keys())


_WAITS = "waits."


def _waiting_features(store: Store, version: int, fused: Sequence[Fused], budget: float) -> list[dict[str, Any]]:
    """Deletions from a version's tiles that only the ``budget`` prevents, as GeoJSON features in map metres.

    "waits" is the reason, "false_deletion" the largest probability among its cells that something that stands would be
    deleted, "drive_by" the middle of its cells.
    """
    waits = {one.index: one.pending for one in fused if len(one.pending.cells)}
    tiles = [_tile(store, version, index) for index in waits]
    objects = change_objects([changed_cells(tile, _emptied(tile, waits[tile.index])) for tile in tiles])
    features: list[dict[str, Any]] = to_geojson(objects, store.lattice, map_id=store.map_id)["features"]
    for change, feature in zip(objects, features, strict=True):
        rows, cols = change.where
        likeliest = _likeliest(change, waits)
        middle = [store.lattice.x0, store.lattice.y0] + CELL_SIZE * (np.array([cols.mean(), rows.mean()]) + 0.5)
        feature["id"] = _WAITS + change.id
        feature["properties"] |= {
            "verdict": None,
            "waits": f"deleting it takes something that stands with a probability of up to {likeliest:.2g}; "
            f"the policy allows {budget:g}",
            "false_deletion": round(likeliest, 6),
            "drive_by": [round(float(value), 2) for value in middle],
        }
    return features


def _emptied(tile: Tile, waits: PendingDeletions) -> Tile:
    words = np.zeros(CELLS, dtype=np.uint64)
    words[waits.cells] = EVERY_BIT
    return delete_points(tile, words.reshape(TILE_CELLS, TILE_CELLS))[0]


def _likeliest(change: ChangeObject, waits: Mapping[TileIndex, PendingDeletions]) -> float:
    """The largest probability of its cells."""
    rows, cols = change.where
    largest = 0.0
    for index, pending in waits.items():
        mine = (rows // TILE_CELLS == index[0]) & (cols // TILE_CELLS == index[1])
        cells = rows[mine] % TILE_CELLS * TILE_CELLS + cols[mine] % TILE_CELLS
        largest = max(largest, float(pending.probability[np.isin(pending.cells, cells)].max(initial=0.0)))
    return largest
