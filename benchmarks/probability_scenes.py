"""What the probabilities are fitted to: cells of simulated scenes, what vehicles knew of each, and what is true."""

from __future__ import annotations

import itertools
import pickle
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from msgspec import structs

from mapvote.codec.ballot import (
    Ballot,
    BallotTile,
    changed_cells_of,
    decode,
    encode,
    in_steps,
    pack_odds,
    unpack_states,
)
from mapvote.config import Settings
from mapvote.core.grid import CELLS, TILE_CELLS, TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, I8, I64, U8, Bool, CellState
from mapvote.core.voting import VOTE_UNIT
from mapvote.detection.surfaces import depths_m
from mapvote.fusion.fuse import Decision, update_map
from mapvote.fusion.loss_budget import alike_beside, standing_beside
from mapvote.vehicle import NOTHING, Vehicle, offered
from mapvote_lab.evaluation.experiments.conditions import Conditions
from mapvote_lab.evaluation.experiments.scene import BALLOTS_FROM, Scene, key_of, sources_digest
from mapvote_lab.evaluation.scores import UNSCORED, map_obstacles, same_rows
from mapvote_lab.evaluation.truths import Jury, Truth

Told = Mapping[TileIndex, tuple[F64, F64]]
"""By tile what was looked at in its changed cells (m, k), and how deep in them their surface lies (m,), metres."""


@dataclass(frozen=True, slots=True)
class Street:
    """A scene as its vehicles left it."""

    name: str
    point_map: PointMap
    truth: Truth
    drives: Sequence[tuple[Ballot, Told]]


@dataclass(frozen=True, slots=True)
class Cells:
    """Changed cells, (n,) each: those that one vehicle calls so, or those that several decided."""

    scene: I64
    states: U8
    looked: F64
    """(n, k); of decided cells (n, 0)."""
    depth_m: F64
    vehicles: I64
    """How many drove."""
    votes: I64
    against: I64
    beside: I64
    standing: I64
    """Cells around that are decided to stand."""
    odds: I8
    scored: Bool
    true: Bool
    """Whether it changed as it is called, by the strict truth."""
    harm: Bool
    """Whether a point of a standing surface went with it."""
    stale: I64
    """Points that went with it, of surfaces that are gone."""


class Telling(Vehicle):
    """A vehicle that also gives what its odds are made of."""

    def told(self) -> Told:
        points, found = self._new_points.by_tile(), {}
        for tile, votes in self._voter.each():
            assert votes.looked is not None
            new = np.where(votes.states == CellState.CHANGED_OCCUPIED, votes.new, NOTHING)
            kept = offered(self.point_map, tile, new, points(tile))[0]
            found[tile] = votes.looked, depths_m(votes.states, self.point_map.tiles.get(tile), kept)
        return found


def driven(name: str, cache: Path) -> Street:
    """A scene by its name, ``scenario:seed`` or ``scenario:seed:scans``, simulated, mapped and driven unless the cache
    holds it."""
    scenario, seed, *scans = name.split(":", 2)
    conditions = Conditions(scans=scans[0] if scans else None)
    scene = Scene(scenario, int(seed), Settings(), cache, conditions=conditions)
    scene.prepare()
    point_map, drives = scene.point_map, []
    for vehicle in scene.drive_names("v"):
        kept = scene.work / f"told-{key_of(sources_digest(BALLOTS_FROM))}-{vehicle}.pickle"
        if not kept.exists():
            kept.write_bytes(pickle.dumps(_drive(scene, vehicle, point_map)))
        ballot, told = pickle.loads(kept.read_bytes())
        drives.append((decode(ballot), told))
    return Street(name, point_map, scene.truth, drives)


def _drive(scene: Scene, name: str, point_map: PointMap) -> tuple[bytes, Told]:
    drive = scene.drive(name)
    vehicle = Telling(
        drive.vehicle, drive.sensor, point_map, scene.settings, drive_id=drive.drive_id,
        prior_sigma_m=drive.prior_sigma_m, prior_sigma_deg=drive.prior_sigma_deg,
    )  # fmt: skip
    for i, scan in enumerate(drive):
        vehicle.observe(scan, None if drive.T_map_lidar_prior is None else drive.T_map_lidar_prior[i])
    vehicle.finish()
    return encode(vehicle.ballot()), vehicle.told()


def called(street: Street, number: int) -> Cells:
    """Every cell that a vehicle calls changed, by what it knows itself."""
    jury, parts = Jury(street.point_map, street.truth), []
    for ballot, told in street.drives:
        for tile in ballot.tiles:
            assert tile.states is not None
            states = unpack_states(tile.states)
            cells, (looked, depth_m) = changed_cells_of(states), told[tile.tile]
            truth = _truth_of(jury, street.point_map, tile.tile)[cells]
            parts.append(_cells(number, states.reshape(-1)[cells], truth, looked=looked, depth_m=depth_m))
    return stacked(parts)


def decided(street: Street, number: int, curves: tuple[F64, F64], fewest: int) -> Iterator[Cells]:
    """Every cell that is decided as changed by all vehicles, and by any ``fewest`` of them or more.

    ``curves``: of built and demolished, what makes log-odds of what a vehicle knows (see :func:`sure`).
    """
    jury, settings = Jury(street.point_map, street.truth), Settings().fuse
    old, ballots = map_obstacles(street.point_map), [_with_odds(*drive, curves) for drive in street.drives]
    rows, cols = street.point_map.lattice.cells_of(old[:, :2])
    for many in range(fewest, len(ballots) + 1):
        for some in itertools.combinations(ballots, many):
            updated, decisions = update_map(street.point_map, some, settings)
            gone = ~same_rows(old, map_obstacles(updated))[0]
            for tile, decision in decisions.items():
                here = (rows // TILE_CELLS == tile[0]) & (cols // TILE_CELLS == tile[1]) & gone
                flat = rows % TILE_CELLS * TILE_CELLS + cols % TILE_CELLS
                lost = [
                    np.bincount(flat[here & kind], minlength=CELLS) for kind in (jury.points.valid, jury.points.stale)
                ]
                truth = _truth_of(jury, street.point_map, tile)
                yield of_decision(number, many, decision, truth, lost)


def of_decision(number: int, vehicles: int, decision: Decision, truth: U8, lost: Sequence[I64]) -> Cells:
    """The cells of a tile that are decided as changed. ``truth`` (65536,) of its cells, ``lost``: (65536,) valid and
    stale points that went with each."""
    cells = changed_cells_of(decision.states)
    states = decision.states.reshape(-1)[cells]
    told = decision.tally.reshape(CELLS, -1)[cells].astype(np.int64) // VOTE_UNIT
    votes = told[np.arange(len(cells)), states]
    return _cells(
        number, states, truth[cells],
        vehicles=np.full(len(cells), vehicles),
        votes=votes,
        against=told[:, : CellState.UNDETERMINED].sum(axis=1) - votes,
        beside=alike_beside(cells // TILE_CELLS, cells % TILE_CELLS, states.astype(np.int64)).astype(np.int64),
        standing=standing_beside(decision.states, cells),
        odds=decision.odds.at(cells),
        harm=lost[0][cells] > 0,
        stale=lost[1][cells],
    )  # fmt: skip


def _cells(number: int, states: U8, truth: U8, **known: np.ndarray) -> Cells:
    n = len(states)
    none = {f.name: np.zeros((n, 0) if f.name == "looked" else n, dtype=np.int64) for f in fields(Cells)}
    true = truth == np.where(states == CellState.CHANGED_OCCUPIED, 1, 2)
    return Cells(
        **none | {"scene": np.full(n, number), "states": states, "scored": truth != UNSCORED, "true": true} | known
    )


def _with_odds(ballot: Ballot, told: Told, curves: tuple[F64, F64]) -> Ballot:
    def said(tile: BallotTile) -> BallotTile:
        assert tile.states is not None
        states = unpack_states(tile.states)
        called_so = states.reshape(-1)[changed_cells_of(states)]
        return structs.replace(tile, odds=pack_odds(in_steps(sure(called_so, *told[tile.tile], curves))))

    return structs.replace(ballot, tiles=[said(tile) for tile in ballot.tiles])


def sure(states: U8, looked: F64, depth_m: F64, curves: tuple[F64, F64]) -> F64:
    """(n,) log-odds by curves (k + 2,), as detection/surfaces.py has them by its own."""
    told = np.column_stack([np.ones(len(states)), looked, depth_m])
    return np.where(states == CellState.CHANGED_OCCUPIED, told @ curves[0], told @ curves[1])


def _truth_of(jury: Jury, point_map: PointMap, tile: TileIndex) -> U8:
    """(65536,) the strict truth of a tile's cells; UNSCORED outside its window."""
    window = point_map.lattice.tile(tile)
    common, out = window.intersection(jury.window), np.full(window.shape, UNSCORED, dtype=np.uint8)
    if common.rows > 0 and common.cols > 0:
        out[common.slices_in(window)] = jury.truths["strict"][common.slices_in(jury.window)]
    return out.reshape(-1)


def stacked(parts: Sequence[Cells]) -> Cells:
    """All of them, in their order."""
    return Cells(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Cells)})


def taken(cells: Cells, keep: Bool) -> Cells:
    """Those where ``keep`` (n,) is set."""
    return Cells(**{f.name: getattr(cells, f.name)[keep] for f in fields(Cells)})
