"""The paper's five cases, the other occlusion rules and our own method, from one pass over each drive (paper V).

All of them are settings of the one rule. A vehicle's pass gives one ballot a voter; the server's rule then decides,
and the decided cells are scored. Ballots are cached, so that a run that was cut short goes on where it stopped.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mapvote.codec.ballot import Ballot, decode, encode, unpack_states, unpack_tally
from mapvote.config import CASES, FuseSettings, Settings, VotingSettings
from mapvote.core.grid import Grid
from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, NO_VOTE, U8, Drive, MapvoteError
from mapvote.core.voting import decide
from mapvote.evaluation.experiments.conditions import TrueMovers, shaken
from mapvote.evaluation.experiments.scene import BALLOTS_FROM, Progress, Scene, key_of, sources_digest
from mapvote.evaluation.scoring.jury import Outcome
from mapvote.evaluation.scoring.truth import lay_on
from mapvote.formats import open_drive
from mapvote.formats.atomic import whole_folder
from mapvote.fusion.fuse import states_over
from mapvote.fusion.offline import update_map
from mapvote.localisation.tracker import GivenPoses, MapWindow, Tracker
from mapvote.simulation.processes import processes
from mapvote.vehicle import Localise, Vehicle

OCCLUSIONS = ("first_hit", "farthest_return", "column")


@dataclass(frozen=True, slots=True)
class Case:
    """One line of the tables: a vote and how it is fused."""

    name: str
    voting: VotingSettings
    min_votes: int


def paper_cases(settings: Settings) -> dict[str, Case]:
    """Cases 1 to 5 under ``first_hit``, named "1".., and under the other occlusion rules, named "1 column".. ."""
    cases = {}
    for occlusion in OCCLUSIONS:
        for number, booleans in CASES.items():
            name = number if occlusion == OCCLUSIONS[0] else f"{number} {occlusion}"
            voting = settings.voting.model_copy(update={"method": "paper", "occlusion": occlusion, **booleans})
            cases[name] = Case(name, voting, min_votes=1)
    return cases


def column_cases(settings: Settings) -> dict[str, Case]:
    """Our own method: as it is, decided by the server alone, and growing rule by rule (METHOD 4, the ablation)."""

    def columns(name: str, **changes: Any) -> Case:
        voting = settings.voting.model_copy(update={"method": "columns", **changes})
        return Case(name, voting, settings.fuse.min_votes)

    whole = columns("columns")
    cases = [whole, columns("columns one-stage", two_stage=False)]
    rules = whole.voting.rules
    cases += [columns(f"columns {rules[:n]}", rules=rules[:n]) for n in range(1, len(rules))]
    return {case.name: case for case in cases}


YARDSTICKS = ("nearest", "evidence")


def choose_cases(settings: Settings, wanted: str) -> tuple[list[Case], bool]:
    """Cases by comma-separated names (1 to 5, "1 column" and its like, columns, yardsticks, or "all" that there is),
    and whether the yardsticks are wanted. MapvoteError names one that there is not, or says that no vote is left.
    """
    every = {**paper_cases(settings), **column_cases(settings)}
    names = [*every, "yardsticks"] if wanted == "all" else [name.strip() for name in wanted.split(",")]
    for name in names:
        if name not in every and name not in ("yardsticks", *YARDSTICKS):
            raise MapvoteError(f"no case {name!r}: choose from all, yardsticks, {', '.join(every)}")
    chosen = [every[name] for name in names if name in every]
    if not chosen:
        raise MapvoteError("the yardsticks are measured beside a vote: name a case too, as in --case 1,yardsticks")
    return chosen, len(chosen) < len(names)


@dataclass(frozen=True, slots=True)
class Pass:
    """What one vehicle brought home."""

    vehicle: str
    ballots: dict[str, Ballot]
    """By case."""
    sizes: dict[str, int]
    """Bytes of each ballot as it is sent."""
    T_map_lidar: F64
    """(n, 4, 4) where the vehicle believed to be; NaN where it abstained."""
    stage_ms: dict[str, float]
    """Median milliseconds a scan by stage."""


def have_voted(scene: Scene, cases: Sequence[Case], who: str = "v") -> bool:
    """Whether the cache holds the first map and every ballot of the drives called ``who``...: no scan is needed."""
    if not (scene.work / "map").exists():
        return False
    return all(pass_folder(scene, cases, name).exists() for name in scene.drive_names(who))


def passes(
    scene: Scene, cases: Sequence[Case], workers: int, progress: Progress | None = None, who: str = "v"
) -> list[Pass]:
    """The passes of all drives called ``who``..., in order of their numbers; those that the cache lacks are driven,
    in parallel."""
    names = scene.drive_names(who)
    missing = [name for name in names if not pass_folder(scene, cases, name).exists()]
    done = len(names) - len(missing)
    if progress:
        progress("voting", done, len(names))
    if workers > 1 and len(missing) > 1:
        with processes(workers) as pool:
            for finished in as_completed([pool.submit(drive_once, scene, cases, name) for name in missing]):
                finished.result()
                done += 1
                if progress:
                    progress("voting", done, len(names))
    else:
        for name in missing:
            drive_once(scene, cases, name)
            done += 1
            if progress:
                progress("voting", done, len(names))
    return [_read_pass(scene, cases, name) for name in names]


def pass_folder(scene: Scene, cases: Sequence[Case], vehicle: str) -> Path:
    """Where a vehicle's ballots lie in the cache."""
    made_by = sources_digest(BALLOTS_FROM), scene.conditions, scene.map_name
    key = key_of(*made_by, *(f"{case.name} {case.voting.model_dump_json()}" for case in cases))
    return scene.work / f"votes-{key}" / vehicle


def drive_once(scene: Scene, cases: Sequence[Case], name: str) -> None:
    """One vehicle's drive with a voter for every case; ballots and poses into the cache, whole or not at all."""
    drive, point_map = scene.drive(name), scene.point_map
    vehicle = Vehicle(
        drive.vehicle, drive.sensor, point_map, scene.settings,
        drive_id=drive.drive_id, voters=[case.voting for case in cases],
        localise=_localise(scene, drive, point_map),
        movers=TrueMovers(scene.truth, open_drive(scene.folder / name)) if scene.conditions.true_moving else None,
        prior_sigma_m=drive.prior_sigma_m, prior_sigma_deg=drive.prior_sigma_deg,
    )  # fmt: skip
    for i, scan in enumerate(drive):
        vehicle.observe(scan, None if drive.T_map_lidar_prior is None else drive.T_map_lidar_prior[i])
    report, lost = vehicle.report, set(vehicle.report.lost)
    poses = np.full((len(drive), 4, 4), np.nan)
    for i, T_map_lidar in enumerate(report.T_map_lidar):
        if i not in lost:
            poses[i] = T_map_lidar
    with whole_folder(pass_folder(scene, cases, name), sign="pass.json") as folder:
        for case in cases:
            (folder / f"{case.name}.ballot").write_bytes(encode(vehicle.ballot(case.voting)))
        np.save(folder / "poses.npy", poses)
        stages = {stage: 1000.0 * float(np.median(seconds)) for stage, seconds in report.stage_s.items()}
        (folder / "pass.json").write_text(json.dumps(stages))


def _localise(scene: Scene, drive: Drive, point_map: PointMap) -> Localise:
    """By NDT, or by the truth; with noise if the scene's conditions say so."""
    conditions, ndt = scene.conditions, scene.settings.ndt
    if conditions.true_poses:
        assert drive.T_map_lidar_prior is not None
        localise: Localise = GivenPoses(drive.stamps_ns, drive.T_map_lidar_prior)
    else:
        localise = Tracker(MapWindow(point_map, ndt), ndt).localise
    if conditions.noise_m or conditions.noise_deg:
        number = scene.drive_names("v").index(drive.path.name)
        localise = shaken(localise, drive.stamps_ns, conditions, (scene.seed, number))
    return localise


def _read_pass(scene: Scene, cases: Sequence[Case], name: str) -> Pass:
    folder = pass_folder(scene, cases, name)
    raw = {case.name: (folder / f"{case.name}.ballot").read_bytes() for case in cases}
    return Pass(
        vehicle=name,
        ballots={case: decode(data) for case, data in raw.items()},
        sizes={case: len(data) for case, data in raw.items()},
        T_map_lidar=np.load(folder / "poses.npy"),
        stage_ms=json.loads((folder / "pass.json").read_text()),
    )


def fuse_case(
    point_map: PointMap, ballots: Sequence[Ballot], min_votes: int, fuse: FuseSettings, window: Grid
) -> Outcome:
    """The server's side of one case (paper IV): decide every cell, edit the map."""
    start = time.perf_counter()
    settings = fuse.model_copy(update={"min_votes": min_votes})
    updated, decisions = update_map(point_map, ballots, settings)
    seconds = time.perf_counter() - start
    states, grid = states_over(point_map.lattice, decisions)
    own = [lay_on(*ballot_states(ballot, point_map), window) for ballot in ballots]
    return Outcome(updated, lay_on(states, grid, window), own, decisions, seconds)


def ballot_states(ballot: Ballot, point_map: PointMap) -> tuple[U8, Grid]:
    """What the vehicle itself decided, (rows, cols) over the window of its tiles, two-stage or one-stage."""
    tiles = {tile.tile: tile for tile in ballot.tiles}
    grids = [point_map.lattice.tile(index) for index in tiles]
    window = grids[0]
    for grid in grids[1:]:
        window = window.union(grid)
    out = np.full(window.shape, NO_VOTE, dtype=np.uint8)
    for grid, states in zip(grids, _decided(tiles.values()), strict=True):
        out[grid.slices_in(window)] = states
    return out, window


def _decided(tiles: Any) -> Iterator[U8]:
    for tile in tiles:
        yield (
            unpack_states(tile.states) if tile.states is not None else decide(unpack_tally(tile.tally).astype(np.int32))
        )
