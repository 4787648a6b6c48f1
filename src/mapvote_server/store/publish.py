"""New versions: the round that a publish would make now, and the publish.

A round follows from the newest version, the ballots, the reviews, the policy and one reading of the clock. It holds
until an event comes that can change it or, with a minimum age, until the next vote is old enough. It is decided once:
desk, dry run, picture, review and publish share one :class:`Round`. It is decided on a snapshot, before the transaction
that writes it. If several publish at once, exactly one wins; the others get Conflict.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field, replace
from itertools import islice
from threading import Lock
from typing import TypeVar
from weakref import WeakKeyDictionary

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError

from mapvote.codec.ballot import tile_key
from mapvote.codec.manifest import TileHashes
from mapvote.config import FuseSettings
from mapvote.core.answers import answer
from mapvote.core.grid import TileIndex
from mapvote.core.point_map import LazyTiles, PointMap, with_changed
from mapvote.core.tile import Tile
from mapvote.core.types import MapvoteError
from mapvote.fusion.decision_record import Record
from mapvote_server.errors import Conflict, Held
from mapvote_server.store import schema
from mapvote_server.store.database import address_of, insert_rows
from mapvote_server.store.doubts import Doubts, doubts_about
from mapvote_server.store.fusion_jobs import JOB_SIZES, Fused, Task, edited_tile, fuse_round, settled
from mapvote_server.store.hold import hold_reasons
from mapvote_server.store.integrity import quarantine, tiles_hurt_or_mended
from mapvote_server.store.policy import GatePolicy
from mapvote_server.store.queries import (
    Version,
    add_blobs,
    current_number,
    end_votes,
    log_event,
    newest_seq,
    set_tiles,
    tile_of,
    tiles_of,
    tiles_set_between,
    version_of,
)
from mapvote_server.store.retention import clear
from mapvote_server.store.store import PerStore, Store
from mapvote_server.store.votes import Electorate, electorate_now, next_ripe_ns, standing_tiles

_MOST_DETAIL = 400
"""Characters of an event."""
Part = TypeVar("Part")


@answer
@dataclass(frozen=True, slots=True)
class Published:
    """The result of a publish, or of a dry run."""

    version: int
    """the new version, or the current one if nothing was published"""
    published: bool
    tiles: list[str]
    """keys of the tiles that changed"""
    points_added: int
    points_deleted: int
    held: list[str]
    """why the policy would hold it back, or what the operator overrode"""
    doubts: list[str]
    """what an operator should know about the voters"""
    waits: str = ""
    """changes that lack only the quorum, if nothing was published"""


@dataclass(frozen=True, slots=True)
class Outcome(Published):
    """The result of a publish in this process."""

    fused: Sequence[Fused] = field(default=(), repr=False)


def preview(
    store: Store,
    settings: FuseSettings | None = None,
    *,
    parent: int | None = None,
    gate: Gate | None = None,
    executor: Executor | None = None,
) -> Outcome:
    """The result of :func:`publish` if it ran now. Nothing is written."""
    return _outcome(store, store.clock(), settings, parent, gate, executor)[1]


def publish(
    store: Store,
    settings: FuseSettings | None = None,
    *,
    by: str = "operator",
    reason: str = "",
    parent: int | None = None,
    override: bool = False,
    gate: Gate | None = None,
    executor: Executor | None = None,
) -> Outcome:
    """Fuse the standing ballots, and publish the next version if anything changed.

    The store's policy applies; ``settings`` replace its ``fuse`` in simulations of one round. ``parent``: publish only
    if this is still the newest version. ``override``: publish in spite of the reasons to hold the version. Raises Held
    with the reasons, Conflict if another version was published first, MapvoteError if the policy names a reference
    drive and there is no ``gate``.
    """
    now_ns = store.clock()
    fused_round, outcome = _outcome(store, now_ns, settings, parent, gate, executor)
    damaged = [damage for one in outcome.fused for damage in one.damaged]
    copies = {str(copy) for one in outcome.fused for copy in one.copies}
    if damaged or copies:
        with store.database.writing() as connection:
            quarantine(connection, damaged, now_ns, by)
            _log_copies(connection, copies, now_ns, by)
    policy = fused_round.electorate.policy
    if gate is None and policy.gate.drive:
        gate_drive = policy.gate.drive
        raise MapvoteError(f"the policy judges versions by {gate_drive}: publish by the server or mapvote publish")
    if not outcome.tiles:
        return outcome
    if outcome.held and not override:
        raise Held(outcome.held)
    full_reason = reason + (f" (in spite of: {'; '.join(outcome.held)})" if outcome.held else "")
    newest = fused_round.newest.number
    made_by = policy.model_dump(mode="json")
    version = Version(
        newest + 1, newest, "publish", None, now_ns, by, full_reason[:400], fused_round.electorate.mark, made_by
    )
    tiles = {f.index: f.hashes for f in outcome.fused if f.hashes is not None}
    write_version(store, version, tiles, (f.planes for f in outcome.fused), outcome.fused, doubts=outcome.doubts)
    _forget(store, fused_round)
    if policy.keep.automatic:
        clear(store, by=by, dry_run=False)
    return replace(outcome, version=version.number, published=True)


def _forget(store: Store, published: Round) -> None:
    """Let go of a round that was published: no later one follows from it, and a city's is large."""
    latest = _latest.of(store)
    with latest.deciding:
        latest.round = None if latest.round is published else latest.round
    with latest.judging:
        latest.judged = None


def _outcome(
    store: Store,
    now_ns: int,
    settings: FuseSettings | None,
    parent: int | None,
    gate: Gate | None,
    executor: Executor | None,
) -> tuple[Round, Outcome]:
    """The round, and what a publish of it would be."""
    fused_round = round_at(store, now_ns, settings, executor)
    newest = fused_round.newest.number
    changed = fused_round.changed
    if parent is not None and parent != newest:
        raise Conflict(f"the newest version is {newest}, not {parent}: look at it, then publish")
    outcome = Outcome(
        version=newest,
        published=False,
        tiles=[tile_key(fused.index) for fused in changed],
        points_added=sum(fused.added for fused in changed),
        points_deleted=sum(fused.deleted for fused in changed),
        held=list(reasons_to_hold(store, fused_round, gate)),
        doubts=list(doubts_of(store, fused_round).told(fused_round.electorate.settings)),
        fused=list(fused_round.decided.values()),
    )
    return fused_round, outcome


def _log_copies(connection: sa.Connection, copies: Iterable[str], now_ns: int, by: str) -> None:
    """Each is named once."""
    e = schema.events.c
    logged = set(connection.execute(sa.select(e.detail).where(e.kind == "copy")).scalars())
    for copy in sorted(set(copies) - logged):
        log_event(connection, now_ns, "copy", by, copy)


def write_version(
    store: Store,
    version: Version,
    tiles: Mapping[TileIndex, TileHashes],
    planes: Iterable[Mapping[str, bytes]],
    decided: Iterable[Fused] = (),
    unvoted: str | None = None,
    doubts: Sequence[str] = (),
) -> Version:
    """Publish a version that sets ``tiles``, one without points where it has none; Conflict if its parent is the newest
    no more.

    ``planes``: all that the store may not hold yet. ``decided``: tiles that do not change too. ``unvoted``: this
    vehicle's votes are gone. ``doubts``: what the log should tell about its voters.
    """
    late = Conflict(f"version {version.number} was published by somebody else meanwhile; look at it first")
    try:
        with store.database.writing() as connection:
            if current_number(connection) != version.parent:
                raise late
            if version.target is not None:
                version_of(connection, version.target)
            seq = log_event(connection, version.created_ns, version.kind, version.published_by, f"v{version.number}")
            if version.kind != "publish":
                version = replace(version, mark=seq)
            for doubt in doubts:
                message = f"v{version.number}: {doubt}"
                log_event(connection, version.created_ns, "doubt", version.published_by, message[:_MOST_DETAIL])
            connection.execute(schema.versions.insert().values(**asdict(version)))
            for part in _parts(planes):
                add_blobs(connection, {digest: data for one in part for digest, data in one.items()})
            set_tiles(connection, version.number, tiles)
            for fused in _parts(decided):
                rows = [_decision_row(version.number, one, record) for one in fused if (record := one.record)]
                if rows:
                    insert_rows(connection, schema.decisions, rows)
            if unvoted is not None:
                end_votes(connection, unvoted, seq)
    except IntegrityError as error:
        raise late from error
    return version


def _parts(items: Iterable[Part]) -> Iterator[list[Part]]:
    """The items, ``JobSizes.sites`` at a time."""
    rest = iter(items)
    while part := list(islice(rest, JOB_SIZES.sites)):
        yield part


def _decision_row(number: int, fused: Fused, record: Record) -> tuple[object, ...]:
    """In the order of the table's columns."""
    made = record.packed_states, record.packed_tally, fused.vehicles, fused.added, fused.deleted
    planes = record.packed_odds, record.packed_standings, record.packed_edits, record.packed_fell
    return number, *fused.index, *made, *planes


Gate = Callable[[GatePolicy, PointMap, PointMap], Sequence[str]]
"""Compares (old map, new map) as the policy asks. Returns the reasons to hold the new one; none lets it through."""
_WITHOUT_EFFECT = "held back", "copy", "doubt", "key issued"
"""Kinds of events that change no round."""


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class Round:
    """The decision of every tile, as of one event."""

    newest: Version
    electorate: Electorate
    until_ns: int | None
    """Time at which the next vote reaches the minimum age; None: there is no minimum, or all votes have reached it."""
    decided: Mapping[TileIndex, Fused]
    """Tiles that may differ from what they were when they were last fused: a publish decides these."""
    beside: Mapping[TileIndex, Fused]
    """All other tiles with votes, for what waits there; none unless they were asked for."""
    alone: Mapping[TileIndex, Fused]
    """Both as each tile is without its neighbours: of what falls, only what the tile decides alone. Tiles that others
    decide are missing: the next round fuses them again."""
    every: bool
    """Whether ``beside`` was asked for."""

    @property
    def changed(self) -> list[Fused]:
        """Tiles that a publish would change."""
        return [fused for fused in self.decided.values() if fused.hashes is not None]


_doubts: WeakKeyDictionary[Round, Doubts] = WeakKeyDictionary()


def doubts_of(store: Store, fused_round: Round) -> Doubts:
    """Warnings on the voters of a round; computed once."""
    if fused_round not in _doubts:
        every = [*fused_round.decided.values(), *fused_round.beside.values()]
        _doubts[fused_round] = doubts_about(
            store, fused_round.newest.number, fused_round.electorate, fused_round.changed, every
        )
    return _doubts[fused_round]


@dataclass(slots=True)
class _Latest:
    """The latest round of one store, and what its gate said."""

    deciding: Lock = field(default_factory=Lock)
    judging: Lock = field(default_factory=Lock)
    round: Round | None = None
    judged: tuple[Round, Sequence[str]] | None = None


_latest = PerStore(_Latest)


def round_at(
    store: Store,
    now_ns: int,
    settings: FuseSettings | None = None,
    executor: Executor | None = None,
    every: bool = False,
) -> Round:
    """The round as of ``now_ns``, by the store's clock. One thread decides it; other threads wait for the result.

    ``settings`` take the place of the policy's ``fuse``, in simulations; such a round is not kept. ``every``: fuse all
    tiles with votes, for what waits there.
    """
    if settings is not None:
        return _decide(store, now_ns, settings, executor, every, None)
    latest = _latest.of(store)
    with latest.deciding:
        last_round = latest.round
        if last_round is None or not _holds(store, last_round, now_ns) or (every and not last_round.every):
            last_round = latest.round = _decide(store, now_ns, None, executor, every, last_round)
        return last_round


def _decide(
    store: Store, now_ns: int, settings: FuseSettings | None, executor: Executor | None, every: bool, last: Round | None
) -> Round:
    """Fuse every tile that the ``last`` round does not answer."""
    with store.database.reading() as connection:
        newest = version_of(connection)
        mark = newest_seq(connection)
        electorate = electorate_now(connection, now_ns, mark, settings)
        dirty = _dirty(connection, newest, electorate)
        wanted = (
            sorted({*dirty, *standing_tiles(connection, mark)})
            if every and electorate.settings.false_deletions < 1.0
            else dirty
        )
        kept = _still_true(connection, last, newest, electorate)
        missing = [index for index in wanted if index not in kept]
        hashes = tiles_of(connection, newest.number, missing)
        until = next_ripe_ns(connection, electorate)
    made = newest.number + 1
    url = address_of(store.database.url)
    tasks = [Task(url, store.lattice.tile(i), made, hashes.get(i), electorate) for i in missing]
    alone = kept | {fused.index: fused for fused in fuse_round(tasks, store.database, executor)}

    def task_of(index: TileIndex) -> Task:
        with store.database.reading() as connection:
            return Task(url, store.lattice.tile(index), made, tile_of(connection, newest.number, index), electorate)

    done = settled(alone, task_of, store.database)
    decided = {index: done.tiles[index] for index in sorted({*dirty, *done.fell})}
    beside = {index: done.tiles[index] for index in wanted if index not in decided}
    return Round(newest, electorate, until, decided, beside, done.alone, every)


def _holds(store: Store, last_round: Round, now_ns: int) -> bool:
    """Whether no event that can change the round has come since, and no vote has reached the minimum age."""
    if last_round.until_ns is not None and now_ns >= last_round.until_ns:
        return False
    e = schema.events.c
    came = sa.select(e.seq).where(e.seq > last_round.electorate.mark, e.kind.not_in(_WITHOUT_EFFECT)).limit(1)
    with store.database.reading() as connection:
        return connection.execute(came).first() is None


def _dirty(connection: sa.Connection, newest: Version, electorate: Electorate) -> list[TileIndex]:
    """Tiles that may come to something else than when they were last fused.

    Where the newest version changed something, votes are spent that decided together with others. With another policy,
    or after a version that was not fused, every tile may differ; with a minimum age votes ripen without any event.
    """
    policy = electorate.policy
    fused = newest.kind == "publish" and newest.policy == policy.model_dump(mode="json")
    if not fused or policy.fuse.min_age_s > 0:
        return standing_tiles(connection, electorate.mark)
    edited = tiles_set_between(connection, newest.number - 1, newest.number)
    return sorted({*_touched(connection, electorate.mark, newest.mark), *edited})


def _touched(connection: sa.Connection, mark: int, since: int) -> set[TileIndex]:
    """Tiles on which votes, reviews or damage were added or removed after the event ``since``."""
    return {*standing_tiles(connection, mark, since), *tiles_hurt_or_mended(connection, since)}


def _still_true(
    connection: sa.Connection, last: Round | None, newest: Version, electorate: Electorate
) -> dict[TileIndex, Fused]:
    """The tiles of the last round on which nothing has changed since."""
    if last is None or last.newest.number != newest.number or last.electorate.policy != electorate.policy:
        return {}
    if electorate.policy.fuse.min_age_s > 0:
        return {}
    touched = _touched(connection, electorate.mark, last.electorate.mark)
    return {index: fused for index, fused in last.alone.items() if index not in touched}


def reasons_to_hold(store: Store, fused_round: Round, gate: Gate | None) -> list[str]:
    """The reasons of the policy, and of its gate, against the version that a round would make."""
    changed = fused_round.changed
    gate_policy = fused_round.electorate.policy.gate
    held = hold_reasons(changed, fused_round.electorate.settings)
    held += doubts_of(store, fused_round).holding(fused_round.electorate.settings)
    if gate is None or not gate_policy.drive or not changed:
        return held
    latest = _latest.of(store)
    with latest.judging:
        if latest.judged is None or latest.judged[0] is not fused_round:
            old = store.point_map(fused_round.newest.number)
            latest.judged = fused_round, gate(gate_policy, old, _after(store, old, changed))
        return [*held, *latest.judged[1]]


def _after(store: Store, old: PointMap, changed: Sequence[Fused]) -> PointMap:
    """The map as a publish would make it; its tiles are made when they are used."""
    of = {fused.index: fused for fused in changed}

    def edited(index: TileIndex) -> Tile:
        return edited_tile(of[index], old.tiles.get(index) or Tile.empty(store.lattice.tile(index)))

    points = {fused.index: fused.points + fused.added - fused.deleted for fused in changed}
    return replace(old, tiles=with_changed(old.tiles, LazyTiles(edited, points)))
