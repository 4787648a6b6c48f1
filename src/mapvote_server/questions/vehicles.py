"""Vehicles: where they have been, where one should drive next, and whether one contradicts the others significantly
more often than they contradict each other.

A vote is compared only where other vehicles agree both before it and after it, as a cell that differs before and after
a drive may have changed. Objects (8-connected cells) are counted, not cells, as neighbouring cells fail together. The
test is exact for few data, and "undecidable" is one of its results.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from itertools import chain, islice
from typing import Any, Literal

import numpy as np
import scipy
import sqlalchemy as sa

from mapvote.codec.ballot import unpack_path
from mapvote.codec.tile_planes import unpack_ground_plane
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Lattice, TileIndex
from mapvote.core.times import utc
from mapvote.core.types import F32, I64
from mapvote.shapes.geojson import Bounds, Geometry, PlacedFeature, Places, meet, places
from mapvote_server.questions.contradictions import CONTRADICTIONS, Compared, Objects, compare, over_borders
from mapvote_server.questions.explain import votes_on
from mapvote_server.questions.kept import KeptTiles
from mapvote_server.store import schema
from mapvote_server.store.policy import policy_in
from mapvote_server.store.queries import load_blob, tiles_of, version_of
from mapvote_server.store.store import PerStore, Store
from mapvote_server.store.votes import FOREVER, Electorate

Stance = Literal["contradicts", "consistent", "undecidable"]
Claim = Literal["occupied", "empty"]


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
    """Contradictions among them."""
    others_cells: int
    others_objects: int
    p_value: float
    """Chance of as many objects or more if its rate were ``tolerated`` times that of the others; not yet adjusted."""
    threshold: float
    """Upper limit of ``p_value``: the significance divided by the number of vehicles tested (Bonferroni)."""
    evidence: tuple[Contradiction, ...]
    """The largest contradictions, largest first (``Contradictions.told``)."""


def vehicle_standings(store: Store) -> list[VehicleStanding]:
    """Each vehicle compared with the others, over every vote inside the window, in order of name.

    The state of the world (occupied or empty now) is compared, so votes on an older base count too.
    """
    kept = _compared.of(store)
    with kept.tiles.lock:
        with store.database.reading() as connection:
            electorate = Electorate(FOREVER, policy_in(connection), FOREVER)

            def look(index: TileIndex) -> Sequence[Compared] | None:
                return compare(index, votes_on(connection, store.lattice, index, electorate.policy)) or None

            kept.tiles.refresh(connection, electorate, store.clock(), look)
        if kept.standings is None:
            kept.standings = standings_of(kept.entries(), store.lattice)
        return kept.standings


class _AllCompared:
    """The comparisons on all tiles of one store, and their sums: only tiles with contradictions are gone through."""

    def __init__(self) -> None:
        self.tiles: KeptTiles[Sequence[Compared]] = KeptTiles(self._come, self._go)
        self._sums: dict[str, Compared] = {}
        self._tiles: Counter[str] = Counter()
        self._opposed: dict[int, Sequence[Compared]] = {}
        """Contradictions of each tile, without what the sums have."""
        self.standings: list[VehicleStanding] | None = None
        """Standings that follow from all tiles; None: not asked since one came or went."""

    def entries(self) -> list[Compared]:
        """The comparisons that represent all: one a vehicle with its sums, and those with contradictions."""
        return [*self._sums.values(), *chain.from_iterable(self._opposed.values())]

    def _come(self, compared: Sequence[Compared]) -> None:
        self.standings = None
        for entry in compared:
            self._tiles[entry.vehicle] += 1
            self._add(entry, 1)
        opposed = [replace(entry, cells=0, inside=0) for entry in compared if entry.contradicts]
        if opposed:
            self._opposed[id(compared)] = opposed

    def _go(self, compared: Sequence[Compared]) -> None:
        self.standings = None
        for entry in compared:
            self._tiles[entry.vehicle] -= 1
            self._add(entry, -1)
            if not self._tiles[entry.vehicle]:
                del self._tiles[entry.vehicle], self._sums[entry.vehicle]
        self._opposed.pop(id(compared), None)

    def _add(self, entry: Compared, times: int) -> None:
        before = self._sums.get(entry.vehicle, Compared(entry.vehicle, 0))
        sums = before.cells + times * entry.cells, before.inside + times * entry.inside
        self._sums[entry.vehicle] = Compared(entry.vehicle, *sums)


_compared = PerStore(_AllCompared)


def standings_of(
    compared: Iterable[Compared],
    lattice: Lattice,
    *,
    tolerated: float = 2.0,
    significance: float = 0.01,
) -> list[VehicleStanding]:
    """The standing of every vehicle over all tiles, in order of name.

    Under the hypothesis that a vehicle contradicts at ``tolerated`` times the others' rate per compared cell, its share
    of all objects is binomial (the exact comparison of two Poisson rates, Przyborowski and Wilenski 1940). It
    "contradicts" if the chance of what was seen is below ``significance`` shared out among the vehicles tested;
    it is "undecidable" if nothing could be compared, if it contradicts where no other vehicle could be compared, or if
    its rate is above the tolerated one but the data are too few for significance. Objects of fewer than
    ``Contradictions.least_cells`` cells are noise and not counted.
    """
    by_vehicle: dict[str, list[Compared]] = {}
    for entry in compared:
        by_vehicle.setdefault(entry.vehicle, []).append(entry)
    names = sorted(by_vehicle)
    cells = {name: sum(entry.cells for entry in by_vehicle[name]) for name in names}
    spread = {name: over_borders([entry.border for entry in by_vehicle[name]]) for name in names}
    objects = {name: len(spread[name]) + sum(entry.inside for entry in by_vehicle[name]) for name in names}
    all_cells = sum(cells.values())
    all_objects = sum(objects.values())
    threshold = significance / max(1, sum(n > 0 for n in cells.values()))
    out = []
    for name in names:
        own_cells = cells[name]
        own_objects = objects[name]
        others = all_cells - own_cells
        others_found = all_objects - own_objects
        p_value = _tail(own_objects, others_found, tolerated * own_cells, others)
        verdict: Stance = "undecidable"
        if own_cells and p_value < threshold:
            verdict = "contradicts"
        elif own_cells and (others or not own_objects) and own_objects * others <= tolerated * own_cells * others_found:
            verdict = "consistent"
        evidence = _evidence([spread[name], *(entry.largest for entry in by_vehicle[name])], lattice)
        out.append(
            VehicleStanding(name, verdict, own_cells, own_objects, others, others_found, p_value, threshold, evidence)
        )
    return out


def _tail(own: int, others: int, my_exposure: float, others_exposure: float) -> float:
    """P(X >= mine), X binomial of mine + others objects, each mine by my share of the exposure."""
    if own == 0 or others_exposure == 0:
        return 1.0
    share = my_exposure / (my_exposure + others_exposure)
    return float(scipy.special.betainc(own, others + 1, share))


def _evidence(compared: Sequence[Objects], lattice: Lattice) -> tuple[Contradiction, ...]:
    """The largest of the objects."""
    largest = Objects.all_of(compared).largest(CONTRADICTIONS.told)
    x, y = (np.round(metres, 2).tolist() for metres in largest.places_m(lattice))
    claims: list[Claim] = ["occupied" if says else "empty" for says in largest.occupied.tolist()]
    return tuple(map(Contradiction, x, y, largest.cells.tolist(), claims))


def contradictions(standings: Sequence[VehicleStanding]) -> Places:
    """Where vehicles contradict the others, as GeoJSON points in map metres."""
    return places(
        [
            PlacedFeature(
                "Feature",
                Geometry("Point", [e.x, e.y]),
                {"vehicle": s.vehicle, "verdict": s.verdict, "says": e.says, "cells": e.cells},
            )
            for s in standings
            for e in s.evidence
        ]
    )


def standing_rows(standings: Sequence[VehicleStanding]) -> list[dict[str, Any]]:
    """A row per vehicle, without the places."""
    return [{f.name: getattr(s, f.name) for f in fields(s) if f.name != "evidence"} for s in standings]


MOST_PATHS = 500
"""The last drives."""


def paths(
    store: Store, vehicle: str | None = None, box: Bounds | None = None, *, first: int = 0, most: int = MOST_PATHS
) -> Places:
    """GeoJSON lines [x, y, z] in map metres of standing ballots that carry a path, the newest drive first; of one
    ``vehicle`` only, if named, and only those that meet the ``box``: ``most`` of them after the ``first``. Where the
    map has no ground height, the last one along the path is used."""
    b = schema.ballots.c
    p = schema.paths.c
    query = sa.select(b.vehicle, b.drive, b.start_ns, b.end_ns, b.version, p.path)
    query = query.join(schema.ballots, b.seq == p.ballot).where(b.gone_seq.is_(None))
    if vehicle is not None:
        query = query.where(b.vehicle == vehicle)
    with store.database.reading() as connection:
        ordered = query.order_by(b.end_ns.desc(), b.seq.desc()).execution_options(yield_per=MOST_PATHS)
        every = ((row, unpack_path(row.path)) for row in connection.execute(ordered))
        met = ((row, path) for row, path in every if box is None or meet(box, _bounds(path, store.lattice)))
        drives = list(islice(met, first, first + most))
        rows = [row for row, _ in drives]
        driven = [path for _, path in drives]
        touched = {(int(r), int(c)) for path in driven for r, c in np.unique(path // TILE_CELLS, axis=0)}
        mapped = tiles_of(connection, version_of(connection).number, sorted(touched)) if touched else {}

        @cache
        def ground(index: TileIndex) -> F32:
            plane = mapped[index].ground if index in mapped else None
            return _NO_GROUND if plane is None else unpack_ground_plane(load_blob(connection, plane), plane)

        lines = [_line(store, path, ground) for path in driven]
    return places(
        [
            PlacedFeature(
                "Feature",
                Geometry("LineString", line),
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


_NO_GROUND = np.full((TILE_CELLS, TILE_CELLS), np.nan, dtype=np.float32)


def _bounds(path: I64, lattice: Lattice) -> Bounds:
    row0, col0 = path.min(axis=0).tolist()
    row1, col1 = (path.max(axis=0) + 1).tolist()
    low = lattice.x0 + CELL_SIZE * col0, lattice.y0 + CELL_SIZE * row0
    return *low, lattice.x0 + CELL_SIZE * col1, lattice.y0 + CELL_SIZE * row1


def _line(store: Store, path: I64, ground: Callable[[TileIndex], F32]) -> list[list[float]]:
    rows, cols = path.T
    tiles, which = np.unique(path // TILE_CELLS, axis=0, return_inverse=True)
    z = np.empty(len(path))
    for k, (row, col) in enumerate(tiles.tolist()):
        here = which.reshape(-1) == k
        z[here] = ground((row, col))[rows[here] % TILE_CELLS, cols[here] % TILE_CELLS]
    last_finite = np.maximum.accumulate(np.where(np.isfinite(z), np.arange(len(z)), -1))
    first = z[np.isfinite(z)][0] if np.isfinite(z).any() else 0.0
    height = np.where(last_finite >= 0, z[last_finite], first)
    x = store.lattice.x0 + (cols + 0.5) * CELL_SIZE
    y = store.lattice.y0 + (rows + 0.5) * CELL_SIZE
    line: list[list[float]] = np.round(np.column_stack([x, y, height]), 2).tolist()
    return line
