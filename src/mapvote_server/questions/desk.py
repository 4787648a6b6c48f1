"""The review desk: changes that a publish would make now, deletions beyond the budget, and verdicts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from threading import Lock
from typing import Any
from weakref import WeakKeyDictionary

import msgspec
import numpy as np

from mapvote.codec.ballot import tile_key
from mapvote.codec.manifest import TileHashes
from mapvote.core.answers import answer
from mapvote.core.columns import EVERY_BIT
from mapvote.core.grid import CELL_SIZE, CELLS, TILE_CELLS, TileIndex
from mapvote.core.tile import Tile
from mapvote.core.types import Bool
from mapvote.fusion.edit import delete_points
from mapvote.fusion.loss_budget import PendingDeletions
from mapvote.shapes.change_objects import ChangedCells, ChangeObject, change_objects, changed_cells
from mapvote.shapes.geojson import (
    Bounds,
    ChangeCollection,
    ChangeFacts,
    ChangeFeature,
    bounds_of,
    meet,
    members_of,
    to_geojson,
)
from mapvote.shapes.packed_cloud import came_and_went
from mapvote_server.errors import NotFound
from mapvote_server.questions.coverage import waiting_votes
from mapvote_server.store.fusion_jobs import Fused, edited_tile
from mapvote_server.store.publish import Gate, Round, doubts_of, reasons_to_hold, round_at
from mapvote_server.store.queries import load_tile, tile_of
from mapvote_server.store.reviews import Review, Verdict, VerdictAnswer, decide, standing
from mapvote_server.store.store import Store

_OF_REVIEW = "verdict."
_WAITS = "waits."
_lock = Lock()


@answer
@dataclass(frozen=True, slots=True)
class PendingFacts(ChangeFacts):
    """A change on the desk."""

    verdict: VerdictAnswer | None
    waits: str | None = None
    """why it is not deleted yet"""
    false_deletion: float | None = None
    """largest probability that something that stands goes"""
    drive_by: list[float] | None = None
    """x, y where a vehicle should drive by"""


@answer
@dataclass(frozen=True, slots=True)
class PendingFeature(ChangeFeature):
    """GeoJSON."""

    properties: PendingFacts


@answer
@dataclass(frozen=True, slots=True)
class Pending(ChangeCollection):
    """The changes that a publish would make."""

    features: list[PendingFeature]


@answer
@dataclass(frozen=True, slots=True)
class Drawn:
    """The planes of a tile that the page draws."""

    points: str
    ground: str


@answer
@dataclass(frozen=True, slots=True)
class DeskAnswer:
    """The review desk."""

    version: int
    """the newest, on which a publish would build"""
    held: list[str]
    """why the policy would hold the version"""
    doubts: list[str]
    """what a reviewer should know about the voters"""
    waits: str
    """changes that lack only the quorum, if nothing is pending"""
    pending: Pending
    waiting: list[PendingFeature]
    """deletions beyond the policy's budget of false deletions"""
    reviewed: list[PendingFeature]
    """held and rejected changes, which a publish leaves out"""
    tiles: dict[str, Drawn | None]
    """as a publish would make them; null: without points"""

    def within(self, box: Bounds | None) -> DeskAnswer:
        """The desk with the changes that meet a box."""
        if box is None:
            return self
        pending, waiting, reviewed = (
            [one for one in features if meet(box, bounds_of(one.geometry))]
            for features in (self.pending.features, self.waiting, self.reviewed)
        )
        return replace(self, pending=replace(self.pending, features=pending), waiting=waiting, reviewed=reviewed)

    def in_one(self) -> Pending:
        """All changes as one collection."""
        return replace(self.pending, features=[*self.pending.features, *self.waiting, *self.reviewed])


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

    answer: DeskAnswer
    reviews: Sequence[Review]
    """Of the held and rejected changes."""
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
    fused_round = round_at(store, store.clock(), executor=executor, every=True)
    with _lock:
        last_desk = _desks.get(fused_round)
        if last_desk is None:
            last_desk = _desks[fused_round] = _desk_of(store, fused_round)
    held = list(reasons_to_hold(store, fused_round, gate))
    return replace(last_desk, answer=replace(last_desk.answer, held=held))


def _desk_of(store: Store, fused_round: Round) -> Desk:
    version = fused_round.newest.number
    looked = [_look_at(store, version, fused) for fused in fused_round.changed]
    objects = change_objects([cells for cells, _ in looked])
    edited = {fused.index: _proposed(store, version, fused) for fused in fused_round.changed}
    reviews = standing(store)
    left_out = [review for review, _ in reviews if review.given.verdict != "accepted"]
    budget = fused_round.electorate.settings.false_deletions
    lacking = None if fused_round.changed else waiting_votes(store)
    content = DeskAnswer(
        version=version,
        held=[],
        doubts=list(doubts_of(store, fused_round).told(fused_round.electorate.settings)),
        waits="" if lacking is None else str(lacking),
        pending=_pending(store, version, objects, reviews),
        waiting=_waiting_features(
            store, version, [*fused_round.decided.values(), *fused_round.beside.values()], budget
        ),
        reviewed=list(map(_reviewed, left_out)),
        tiles={tile_key(index): _drawn(made) for index, made in edited.items()},
    )
    return Desk(content, left_out, {one.id: one for one in objects}, edited, b"".join(cloud for _, cloud in looked))


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


def _pending(
    store: Store,
    version: int,
    objects: Sequence[ChangeObject],
    reviews: Sequence[tuple[Review, Mapping[TileIndex, Bool]]],
) -> Pending:
    """The changes, each with the verdict on its cells."""
    changes = to_geojson(
        objects, store.lattice, map_id=store.map_id, from_version=version, georeference=store.georeference
    )
    verdicts = [_verdict_on(one, reviews) for one in objects]
    return Pending(
        type="FeatureCollection",
        frame=changes.frame,
        map_id=changes.map_id,
        georeference=changes.georeference,
        from_version=version,
        to_version=None,
        features=[_on_desk(one, verdict=given) for one, given in zip(changes.features, verdicts, strict=True)],
    )


def _verdict_on(
    change: ChangeObject, reviews: Sequence[tuple[Review, Mapping[TileIndex, Bool]]]
) -> VerdictAnswer | None:
    """The verdict that stands on some cell of a change."""
    cells = _cells_of(change) if reviews else {}
    return next((review.given for review, theirs in reviews if _meet(cells, theirs)), None)


def _on_desk(feature: ChangeFeature, **more: Any) -> PendingFeature:
    facts = PendingFacts(**members_of(feature.properties), **more)
    return PendingFeature("Feature", feature.id, feature.geometry, facts)


def _drawn(made: Proposed) -> Drawn | None:
    return Drawn(made.hashes.points, made.hashes.ground) if made.points else None


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
    desk_now = desk(store, executor)
    features = {feature.id: msgspec.to_builtins(feature) for feature in desk_now.answer.pending.features}
    features |= {f"{_OF_REVIEW}{one.given.seq}": dict(one.feature) for one in desk_now.reviews}
    if change not in features:
        raise NotFound(f"no change {change[:80]!r} is pending any more: look again")
    feature = features[change] | {"properties": features[change]["properties"] | {"verdict": None}}
    cells = _cells_of(desk_now.objects[change]) if change in desk_now.objects else _cells_of_review(store, change)
    return decide(store, verdict, feature, cells, by=by, comment=comment, after=after)


def _cells_of_review(store: Store, change: str) -> Mapping[TileIndex, Bool]:
    """The cells of a change that was reviewed, by the id of its verdict."""
    return next(cells for one, cells in standing(store) if f"{_OF_REVIEW}{one.given.seq}" == change)


def _reviewed(review: Review) -> PendingFeature:
    """A held or rejected change, in the state of its review, with the verdict."""
    feature = msgspec.convert(review.feature, PendingFeature)
    facts = replace(feature.properties, verdict=review.given)
    return replace(feature, id=f"{_OF_REVIEW}{review.given.seq}", properties=facts)


def _tile(store: Store, version: int, index: TileIndex) -> Tile:
    with store.database.reading() as connection:
        return load_tile(connection, store.lattice.tile(index), tile_of(connection, version, index))


def _cells_of(change: ChangeObject) -> dict[TileIndex, Bool]:
    planes: dict[TileIndex, Bool] = {}
    rows, cols = change.where
    tiles = np.stack([rows // TILE_CELLS, cols // TILE_CELLS], axis=1)
    for index in np.unique(tiles, axis=0):
        on_tile = (tiles == index).all(axis=1)
        plane = np.zeros((TILE_CELLS, TILE_CELLS), dtype=np.bool_)
        plane[rows[on_tile] % TILE_CELLS, cols[on_tile] % TILE_CELLS] = True
        planes[int(index[0]), int(index[1])] = plane
    return planes


def _meet(ours: Mapping[TileIndex, Bool], theirs: Mapping[TileIndex, Bool]) -> bool:
    return any((ours[i] & theirs[i]).any() for i in ours.keys() & theirs.keys())


def _waiting_features(store: Store, version: int, fused: Sequence[Fused], budget: float) -> list[PendingFeature]:
    """Deletions from a version's tiles that only the ``budget`` prevents.

    "waits" is the reason, "false_deletion" the largest probability among its cells that something that stands would be
    deleted, "drive_by" the middle of its cells.
    """
    waits = {one.index: one.pending for one in fused if len(one.pending.cells)}
    tiles = [_tile(store, version, index) for index in waits]
    objects = change_objects([changed_cells(tile, _emptied(tile, waits[tile.index])) for tile in tiles])
    features = []
    for change, plain in zip(objects, to_geojson(objects, store.lattice, map_id=store.map_id).features, strict=True):
        rows, cols = change.where
        likeliest = _likeliest(change, waits)
        middle = [store.lattice.x0, store.lattice.y0] + CELL_SIZE * (np.array([cols.mean(), rows.mean()]) + 0.5)
        feature = _on_desk(
            plain,
            verdict=None,
            waits=f"deleting it takes something that stands with a probability of up to {likeliest:.2g}; "
            f"the policy allows {budget:g}",
            false_deletion=round(likeliest, 6),
            drive_by=[round(float(value), 2) for value in middle],
        )
        features.append(replace(feature, id=_WAITS + change.id))
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
        on_tile = (rows // TILE_CELLS == index[0]) & (cols // TILE_CELLS == index[1])
        cells = rows[on_tile] % TILE_CELLS * TILE_CELLS + cols[on_tile] % TILE_CELLS
        largest = max(largest, float(pending.probability[np.isin(pending.cells, cells)].max(initial=0.0)))
    return largest
