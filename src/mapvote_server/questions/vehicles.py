"""Vehicles: where they have been, where one should drive next, and whether one contradicts the others significantly
more often than they contradict each other.

A vote is compared only where other vehicles agree both before it and after it, as a cell that differs before and after
a drive may have changed. Objects (8-connected cells) are counted, not cells, as neighbouring cells fail together. The
test is exact for few data, and "undecidable" is one of its results.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from threading import Lock
from typing import Any, Literal
from weakref import WeakKeyDictionary

import numpy as np
import scipy
import sqlalchemy as sa

from mapvote.codec.ballot import unpack_path
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Lattice, TileIndex
from mapvote.core.types import F32, I64, U8, CellState
from mapvote.fusion.tile_vote import TileVote
from mapvote.shapes.geojson import collection, utc
from mapvote.shapes.outlines import pieces
from mapvote_server.answers import answer
from mapvote_server.questions.explain import said_by, seen, votes_on
from mapvote_server.questions.kept import KeptTiles
from mapvote_server.store import schema
from mapvote_server.store.policy import policy_in
from mapvote_server.store.queries import load_tile, tiles_of, version_of
from mapvote_server.store.store import Store
from mapvote_server.store.votes import FOREVER, Electorate

Stance = Literal["contradicts", "consistent", "undecidable"]
Claim = Literal["occupied", "empty"]
_SILENT, _OCCUPIED, _EMPTY = range(3)
_CLAIMS = np.full(256, _SILENT, dtype=np.uint8)
"""By state: what it says of the cell now."""
_CLAIMS[[CellState.UNCHANGED_OCCUPIED, CellState.CHANGED_OCCUPIED]] = _OCCUPIED
_CLAIMS[[CellState.UNCHANGED_EMPTY, CellState.CHANGED_EMPTY]] = _EMPTY


@dataclass(frozen=True, slots=True)
class Compared:
    """One vehicle against the others on one tile."""

    vehicle: str
    cells: int
    """Cells where the others agree before and after it, and it votes too."""
    rows: I64
    """(n,) the cells among them where it votes the opposite, on the lattice of the map, by row, then column."""
    cols: I64
    occupied: U8
    """(n,) 1 where the vehicle votes occupied, 0 where it votes empty."""


@dataclass(frozen=True, slots=True)
class Contradiction:
    """One object that the vehicle sees differently from all others."""

    x: float
    """Middle of its cells, map metres."""
    y: float
    cells: int
    says: Claim


@dataclass(frozen=True, slots=True)
class VehicleStanding:
    """A vehicle's verdict, with all figures that it follows from."""

    vehicle: str
    verdict: Stance
    cells: int
    """Cells compared."""
    objects: int
    """Contradictions of at least ``min_cells`` cells among them."""
    others_cells: int
    others_objects: int
    p_value: float
    """Chance of as many objects or more if its rate were ``tolerated`` times that of the others; not yet adjusted."""
    threshold: float
    """Upper limit of ``p_value``: the significance divided by the number of vehicles tested (Bonferroni)."""
    evidence: tuple[Contradiction, ...]
    """Largest first."""


def compare(index: TileIndex, votes: Iterable[TileVote]) -> list[Compared]:
    """Each vehicle's vote on a tile, all its drives as one, against the others'; one entry each, in order of name.

    In a cell the others agree if more of them vote one way (occupied or empty now) than the other, and at least one
    of these passed before the vehicle and one after it. Undetermined cells and cells without a vote are left out.
    """
    ordered = sorted(votes, key=lambda vote: (vote.end_ns, vote.vehicle))
    if not ordered:
        return []
    claims = np.stack([_CLAIMS[said_by(vote).reshape(-1)] for vote in ordered])
    occupied, empty = claims == _OCCUPIED, claims == _EMPTY
    all_occupied, all_empty = (claim.sum(axis=0, dtype=np.int16) for claim in (occupied, empty))
    before_occupied, before_empty = np.zeros_like(all_occupied), np.zeros_like(all_empty)
    out = []
    for i, vote in enumerate(ordered):
        others_occupied, others_empty = all_occupied - occupied[i], all_empty - empty[i]
        # A side that has the majority, and a vote both before this one and after it.
        agree_occupied = (others_occupied > others_empty) & (before_occupied > 0) & (others_occupied > before_occupied)
        agree_empty = (others_empty > others_occupied) & (before_empty > 0) & (others_empty > before_empty)
        before_occupied += occupied[i]
        before_empty += empty[i]
        opposed = np.flatnonzero((agree_occupied & empty[i]) | (agree_empty & occupied[i]))
        compared = int(((agree_occupied | agree_empty) & (claims[i] != _SILENT)).sum())
        out.append(
            Compared(
                vehicle=vote.vehicle,
                cells=compared,
                rows=index[0] * TILE_CELLS + opposed // TILE_CELLS,
                cols=index[1] * TILE_CELLS + opposed % TILE_CELLS,
                occupied=occupied[i][opposed].astype(np.uint8),
            )
        )
    return sorted(out, key=lambda entry: entry.vehicle)


def vehicle_standings(store: Store) -> list[VehicleStanding]:
    """Each vehicle compared with the others, over every vote inside the window, in order of name.

    The state of the world (occupied or empty now) is compared, so votes on an older base count too.
    """
    with _lock:
        kept = _compared.setdefault(store, _AllCompared())
    with kept.tiles.lock:
        with store.database.reading() as connection:
            asked = Electorate(FOREVER, policy_in(connection), FOREVER)

            def look(index: TileIndex) -> Sequence[Compared] | None:
                return compare(index, votes_on(connection, store.lattice, index, asked.policy)) or None

            kept.tiles.refresh(connection, asked, store.clock(), look)
        if kept.standings is None:
            kept.standings = standings_of(kept.entries(), store.lattice)
        return kept.standings


class _AllCompared:
    """The comparisons on all tiles of one store, and their sums: only tiles with contradictions are gone through."""

    def __init__(self) -> None:
        self.tiles: KeptTiles[Sequence[Compared]] = KeptTiles(self._come, self._go)
        self._cells: Counter[str] = Counter()
        self._tiles: Counter[str] = Counter()
        self._opposed: dict[int, Sequence[Compared]] = {}
        self.standings: list[VehicleStanding] | None = None
        """What follows from all tiles; None: not asked since one came or went."""

    def entries(self) -> list[Compared]:
        """The comparisons that represent all: one a vehicle with its cells, and those with contradictions."""
        none, no_claim = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.uint8)
        sums = [Compared(name, self._cells[name], none, none, no_claim) for name in self._tiles]
        return sums + [replace(entry, cells=0) for entries in self._opposed.values() for entry in entries]

    def _come(self, compared: Sequence[Compared]) -> None:
        self.standings = None
        for entry in compared:
            self._cells[entry.vehicle] += entry.cells
            self._tiles[entry.vehicle] += 1
        opposed = [entry for entry in compared if len(entry.rows)]
        if opposed:
            self._opposed[id(compared)] = opposed

    def _go(self, compared: Sequence[Compared]) -> None:
        self.standings = None
        for entry in compared:
            self._cells[entry.vehicle] -= entry.cells
            self._tiles[entry.vehicle] -= 1
            if not self._tiles[entry.vehicle]:
                del self._tiles[entry.vehicle], self._cells[entry.vehicle]
        self._opposed.pop(id(compared), None)


_compared: WeakKeyDictionary[Store, _AllCompared] = WeakKeyDictionary()
_lock = Lock()


def standings_of(
    compared: Iterable[Compared],
    lattice: Lattice,
    *,
    tolerated: float = 2.0,
    significance: float = 0.01,
    min_cells: int = 4,
) -> list[VehicleStanding]:
    """The standing of every vehicle over all tiles, in order of name.

    Under the hypothesis that a vehicle contradicts at ``tolerated`` times the others' rate per compared cell, its share
    of all objects is binomial (the exact comparison of two Poisson rates, Przyborowski and Wilenski 1940). It
    "contradicts" if the chance of what was seen is below ``significance`` shared out among the vehicles tested;
    it is "undecidable" if nothing could be compared, or if its rate is above the tolerated one but the data are too
    few for significance. Objects of fewer than ``min_cells`` cells are noise and not counted.
    """
    by_vehicle: dict[str, list[Compared]] = {}
    for entry in compared:
        by_vehicle.setdefault(entry.vehicle, []).append(entry)
    names = sorted(by_vehicle)
    cells = {name: sum(entry.cells for entry in by_vehicle[name]) for name in names}
    evidence = {name: _objects(by_vehicle[name], lattice, min_cells) for name in names}
    all_cells, all_objects = sum(cells.values()), sum(len(found) for found in evidence.values())
    threshold = significance / max(1, sum(n > 0 for n in cells.values()))
    out = []
    for name in names:
        mine, found = cells[name], len(evidence[name])
        others, others_found = all_cells - mine, all_objects - found
        p_value = _tail(found, others_found, tolerated * mine, others)
        verdict: Stance = "undecidable"
        if mine and p_value < threshold:
            verdict = "contradicts"
        elif mine and found * others <= tolerated * mine * others_found:
            verdict = "consistent"
        out.append(
            VehicleStanding(name, verdict, mine, found, others, others_found, p_value, threshold, evidence[name])
        )
    return out


def _tail(mine: int, others: int, my_exposure: float, others_exposure: float) -> float:
    """P(X >= mine), X binomial of mine + others objects, each mine by my share of the exposure."""
    if mine == 0 or others_exposure == 0:
        return 1.0
    share = my_exposure / (my_exposure + others_exposure)
    return float(scipy.special.betainc(mine, others + 1, share))


def _objects(entries: Sequence[Compared], lattice: Lattice, min_cells: int) -> tuple[Contradiction, ...]:
    """The 8-connected contradictions of one vehicle, over all tiles, largest first."""
    rows, cols = np.concatenate([e.rows for e in entries]), np.concatenate([e.cols for e in entries])
    says = np.concatenate([e.occupied for e in entries])
    order = np.lexsort((cols, rows))
    rows, cols, says = rows[order], cols[order], says[order]
    if not len(rows):
        return ()
    label = pieces(rows, cols, says.astype(np.int64)).objects
    size = np.bincount(label)
    x = lattice.x0 + CELL_SIZE * (np.bincount(label, weights=cols) / size + 0.5)
    y = lattice.y0 + CELL_SIZE * (np.bincount(label, weights=rows) / size + 0.5)
    first = np.unique(label, return_index=True)[1]
    ranked = [int(i) for i in np.argsort(-size, kind="stable") if size[i] >= min_cells]
    return tuple(
        Contradiction(
            round(float(x[i]), 2), round(float(y[i]), 2), int(size[i]), "occupied" if says[first[i]] else "empty"
        )
        for i in ranked
    )


def contradictions(standings: Sequence[VehicleStanding]) -> dict[str, Any]:
    """Where vehicles contradict the others, as GeoJSON points in map metres."""
    return collection(
        [
            (
                {"type": "Point", "coordinates": [e.x, e.y]},
                {"vehicle": s.vehicle, "verdict": s.verdict, "says": e.says, "cells": e.cells},
            )
            for s in standings
            for e in s.evidence
        ]
    )


def standing_rows(standings: Sequence[VehicleStanding]) -> list[dict[str, Any]]:
    """A row per vehicle, without the places."""
    return [{f.name: getattr(s, f.name) for f in fields(s) if f.name != "evidence"} for s in standings]


@answer
@dataclass(frozen=True, slots=True)
class CoveredTile:
    """Row and column of a tile, how many vehicles saw it, and when the last did."""

    row: int
    col: int
    vehicles: int
    last_seen: str | None


def tiles_seen(store: Store, known: bool) -> list[CoveredTile]:
    """Per tile of the map or of a standing ballot: number of vehicles, end of the last drive past it as far as may be
    ``known``, see :func:`mapvote_server.questions.explain.seen`."""
    b, t = schema.ballots, schema.ballot_tiles
    last = sa.select(t.c.row, t.c.col, sa.func.max(b.c.end_ns), sa.func.count(sa.distinct(b.c.vehicle)))
    last = last.join(b, b.c.seq == t.c.ballot).where(b.c.gone_seq.is_(None)).group_by(t.c.row, t.c.col)
    with store.database.reading() as connection:
        tiles: dict[TileIndex, tuple[int | None, int]] = dict.fromkeys(
            tiles_of(connection, version_of(connection).number), (None, 0)
        )
        tiles |= {(row[0], row[1]): (row[2], row[3]) for row in connection.execute(last)}
    return [
        CoveredTile(row=index[0], col=index[1], vehicles=vehicles, last_seen=utc(seen(last_ns, known)))
        for index, (last_ns, vehicles) in sorted(tiles.items())
    ]


MOST_PATHS = 500
"""The last drives."""


def paths(store: Store, vehicle: str | None = None) -> dict[str, Any]:
    """GeoJSON lines [x, y, z] in map metres of standing ballots that carry a path, the newest drive first; of one
    ``vehicle`` only, if named. Where the map has no ground height, the last one along the path is used."""
    b, p = schema.ballots.c, schema.paths.c
    query = sa.select(b.vehicle, b.drive, b.start_ns, b.end_ns, b.version, p.path)
    query = query.join(schema.ballots, b.seq == p.ballot).where(b.gone_seq.is_(None))
    if vehicle is not None:
        query = query.where(b.vehicle == vehicle)
    with store.database.reading() as connection:
        rows = connection.execute(query.order_by(b.end_ns.desc()).limit(MOST_PATHS)).all()
        driven = [unpack_path(row.path) for row in rows]
        touched = {(int(r), int(c)) for path in driven for r, c in np.unique(path // TILE_CELLS, axis=0)}
        known = tiles_of(connection, version_of(connection).number, sorted(touched)) if touched else {}

        @cache
        def ground(index: TileIndex) -> F32:
            return load_tile(connection, store.lattice.tile(index), known.get(index)).ground_z

        lines = [_line(store, path, ground) for path in driven]
    return collection(
        [
            (
                {"type": "LineString", "coordinates": line},
                {
                    "vehicle": row.vehicle,
                    "drive": row.drive,
                    "start": utc(row.start_ns),
                    "end": utc(row.end_ns),
                    "version": row.version,
                    "length_m": round(float(np.hypot(*np.diff(np.array(line)[:, :2], axis=0).T).sum()), 1),
                },
            )
            for row, line in zip(rows, lines, strict=True)
        ]
    )


def _line(store: Store, path: I64, ground: Any) -> list[list[float]]:
    rows, cols = path.T
    z = np.array(
        [ground((int(r) // TILE_CELLS, int(c) // TILE_CELLS))[r % TILE_CELLS, c % TILE_CELLS] for r, c in path]
    )
    known = np.maximum.accumulate(np.where(np.isfinite(z), np.arange(len(z)), -1))
    first = z[np.isfinite(z)][0] if np.isfinite(z).any() else 0.0
    height = np.where(known >= 0, z[known], first)
    x, y = store.lattice.x0 + (cols + 0.5) * CELL_SIZE, store.lattice.y0 + (rows + 0.5) * CELL_SIZE
    line: list[list[float]] = np.round(np.column_stack([x, y, height]), 2).tolist()
    return line
