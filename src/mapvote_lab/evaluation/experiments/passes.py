"""What is compared, and the vehicles' passes that vote on it.

The paper's five cases (paper V), the same under other rules of sight, and surfaces are settings of one rule. One pass
over a drive serves them all: what a scan saw is worked out once, each voter counts by its rules. Voters that count
alike share their counters, and those of a method share the candidates for new points. Ballots are kept in the cache."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from mapvote.codec.ballot import Ballot, decode, encode, unpack_states, unpack_tally
from mapvote.config import CASES, FuseSettings, PaperSettings, Settings, VotingSettings
from mapvote.core.grid import Grid
from mapvote.core.point_map import PointMap
from mapvote.core.reference import LocalMap
from mapvote.core.types import F64, NO_VOTE, U8, Drive, MapvoteError, Scan
from mapvote.core.voting import decide
from mapvote.detection.new_points import NewPoints
from mapvote.detection.voter import Voter
from mapvote.formats import open_drive
from mapvote.formats.atomic import whole_folder
from mapvote.fusion.fuse import states_over
from mapvote.fusion.offline import update_map
from mapvote.localisation.localiser import GivenPoses, Localise, Localiser
from mapvote.localisation.ndt import PosePrior
from mapvote.perception.frontend import DriveReport, Frontend, Movers, Observation
from mapvote.perception.moving_objects import MovingFilter
from mapvote.vehicle import make_voter, write_ballot
from mapvote_lab.evaluation.experiments.conditions import Shaken, TrueMovers
from mapvote_lab.evaluation.experiments.paper_readings import Keeper
from mapvote_lab.evaluation.experiments.scene import BALLOTS_FROM, Progress, Scene, key_of, sources_digest
from mapvote_lab.evaluation.scoring.jury import CaseOutcome
from mapvote_lab.evaluation.scoring.truth import lay_on
from mapvote_lab.simulation.processes import processes

OCCLUSIONS: Mapping[str, Mapping[str, str]] = {
    "": {},
    " farthest_return": {"line_of_sight": "farthest"},
    " column": {"line_of_sight": "column"},
}
"""Readings of sight that stand beside the one that is set, by what they add to a case's name."""


AS_BEFORE = PaperSettings()
"""The paper as it has been read from the start."""


@dataclass(frozen=True, slots=True)
class Case:
    """One line of the tables: a vote and how it is fused."""

    name: str
    voting: VotingSettings
    min_votes: int
    paper: PaperSettings = AS_BEFORE
    """How the paper is read; only method "paper" uses it."""


def paper_cases(settings: Settings) -> dict[str, Case]:
    """Cases 1 to 5 as ``[paper]`` reads them, named "1".., and under the other rules of sight, named "1 column".. ."""
    cases = {}
    for added, differently in OCCLUSIONS.items():
        paper = settings.paper.model_copy(update=differently)
        for number, booleans in CASES.items():
            voting = settings.voting.model_copy(update={"method": "paper", **booleans})
            cases[number + added] = Case(number + added, voting, 1, paper)
    return cases


def own_cases(settings: Settings) -> dict[str, Case]:
    """The default method, "surfaces"."""
    voting = settings.voting.model_copy(update={"method": "surfaces"})
    return {"surfaces": Case("surfaces", voting, settings.fuse.min_votes)}


YARDSTICKS = ("nearest", "evidence")


def choose_cases(settings: Settings, wanted: str) -> tuple[list[Case], bool]:
    """Cases by comma-separated names (1 to 5, "1 column" and its like, surfaces, yardsticks, or "all"
    that there is), and whether the yardsticks are wanted.

    MapvoteError names one that there is not, or says that no vote is left.
    """
    every = {**paper_cases(settings), **own_cases(settings)}
    names = [*every, "yardsticks"] if wanted == "all" else [name.strip() for name in wanted.split(",")]
    for name in names:
        if name not in every and name not in ("yardsticks", *YARDSTICKS):
            raise MapvoteError(f"no case {name!r}: choose from all, yardsticks, {', '.join(every)}")
    chosen = [every[name] for name in names if name in every]
    if not chosen:
        raise MapvoteError("the yardsticks are measured beside a vote: name a case too, as in --case 1,yardsticks")
    return chosen, len(chosen) < len(names)


def fuse_case(
    point_map: PointMap, ballots: Sequence[Ballot], min_votes: int, fuse: FuseSettings, window: Grid
) -> CaseOutcome:
    """The server's side of one case (paper IV): decide every cell, edit the map."""
    start = time.perf_counter()
    settings = fuse.model_copy(update={"min_votes": min_votes})
    updated, decisions = update_map(point_map, ballots, settings)
    seconds = time.perf_counter() - start
    states, grid = states_over(point_map.lattice, decisions)
    own = [lay_on(*ballot_states(ballot, point_map), window) for ballot in ballots]
    return CaseOutcome(updated, lay_on(states, grid, window), own, decisions, seconds)


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


class SharedPass:
    """A vehicle with a voter for every case. ``localise`` and ``movers``: as a vehicle's own, or an experiment's."""

    def __init__(
        self,
        drive: Drive,
        point_map: PointMap,
        settings: Settings,
        cases: Sequence[Case],
        *,
        localise: Localise | None = None,
        movers: Movers | None = None,
    ) -> None:
        self.drive, self.point_map, self.settings = drive, point_map, settings
        self._frontend = Frontend(
            localise or Localiser(point_map, settings, drive.sensor),
            movers or MovingFilter(drive.sensor, settings.moving),
            LocalMap(point_map, settings.voting.window_m),
            sensor=drive.sensor,
        )
        self._voters: dict[tuple[VotingSettings, PaperSettings], Voter] = {}
        self._observing: list[tuple[str, Voter]] = []
        """The same voters, each with its method."""
        for case in cases:
            self._enrol(case)
        self._new_points = {
            method: NewPoints(point_map.lattice, beyond=method != "paper")
            for method in {method for method, _ in self._observing}
        }

    def _enrol(self, case: Case) -> None:
        key = _counts_as(case)
        if key in self._voters:
            return
        settings = self.settings.model_copy(update=dict(zip(("voting", "paper"), key, strict=True)))
        self._voters[key] = make_voter(settings, self.drive.sensor, self.point_map)
        self._observing.append((case.voting.method, self._voters[key]))

    @property
    def report(self) -> DriveReport:
        """How the drive goes."""
        return self._frontend.report

    def observe(self, scan: Scan, prior: PosePrior | None = None) -> list[Observation]:
        """One scan for every voter; returns the observations that voted now, for whoever else wants to see them."""
        return self._vote(self._frontend.observe(scan, prior))

    def finish(self) -> list[Observation]:
        """The drive has ended: the observations that still waited."""
        return self._vote(self._frontend.finish())

    def _vote(self, observations: list[Observation]) -> list[Observation]:
        for seen in observations:
            with self.report.timed("vote"):
                may_be_new = {method: np.zeros(seen.view.grid.shape, dtype=np.uint64) for method in self._new_points}
                for method, voter in self._observing:
                    may_be_new[method] |= voter.observe(seen)
                for method, words in may_be_new.items():
                    self._new_points[method].gather(seen, words)
        return observations

    def ballot(self, case: Case) -> Ballot:
        """What the vehicle says by one of its cases. MapvoteError if no scan has voted."""
        settings = self.settings.model_copy(update={"voting": case.voting, "paper": case.paper})
        return write_ballot(
            self.drive.vehicle, self.drive.drive_id, self.point_map, settings, self.report,
            self._voters[_counts_as(case)], self._new_points[case.voting.method],
        )  # fmt: skip


def _counts_as(case: Case) -> tuple[VotingSettings, PaperSettings]:
    """Voters that differ only in who decides (one stage or two) count alike."""
    return case.voting.model_copy(update={"two_stage": True}), case.paper


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
    scene: Scene, cases: Sequence[Case], workers: int, progress: Progress | None = None, who: str = "v",
    keep: bool = False,
) -> list[Pass]:  # fmt: skip
    """The passes of all drives called ``who``..., in order of their numbers; those that the cache lacks are driven.

    The first is driven in this process, the others in ``workers`` - 1 further ones. ``keep``: what each scan says is
    kept too (experiments/kept.py).
    """
    names = scene.drive_names(who)
    missing = [name for name in names if not pass_folder(scene, cases, name, keep).exists()]
    done = count(len(names) - len(missing))

    def tell() -> None:
        finished = next(done)
        if progress:
            progress("voting", finished, len(names))

    tell()
    shared = workers > 1 and len(missing) > 1
    with processes(workers - 1) if shared else nullcontext() as pool:
        elsewhere = [pool.submit(drive_once, scene, cases, name, keep) for name in missing[1:]] if pool else []
        for name in missing[:1] if pool else missing:
            drive_once(scene, cases, name, keep)
            tell()
        for finished in as_completed(elsewhere):
            finished.result()
            tell()
    return [_read_pass(pass_folder(scene, cases, name, keep), cases) for name in names]


def pass_folder(scene: Scene, cases: Sequence[Case], vehicle: str, keep: bool = False) -> Path:
    """Where a vehicle's ballots lie in the cache."""
    made_by = sources_digest(BALLOTS_FROM), scene.conditions, scene.map_name
    votes_by = ((c.name, c.voting.model_dump_json(), c.paper.model_dump_json()) for c in cases)
    key = key_of(*made_by, *votes_by)
    return scene.work / f"{'kept' if keep else 'votes'}-{key}" / vehicle


def drive_once(scene: Scene, cases: Sequence[Case], name: str, keep: bool = False) -> None:
    """One vehicle's drive with a voter for every case; ballots and poses into the cache, whole or not at all."""
    drive, point_map = scene.drive(name), scene.point_map
    vehicle = SharedPass(
        drive, point_map, scene.settings, cases,
        localise=_localise(scene, drive, point_map),
        movers=TrueMovers(scene.truth, open_drive(scene.folder / name)) if scene.conditions.true_moving else None,
    )  # fmt: skip
    keeper = _keeper(scene, drive, point_map) if keep else None
    for i, scan in enumerate(drive):
        observations = vehicle.observe(scan, PosePrior.of(drive, i))
        if keeper:
            keeper.watch(observations)
    observations = vehicle.finish()
    report, lost = vehicle.report, set(vehicle.report.lost)
    poses = np.full((len(drive), 4, 4), np.nan)
    for i, T_map_lidar in enumerate(report.T_map_lidar):
        if i not in lost:
            poses[i] = T_map_lidar
    with whole_folder(pass_folder(scene, cases, name, keep), sign="pass.json") as folder:
        if keeper:
            keeper.watch(observations)
            keeper.write(folder)
        for case in cases:
            (folder / f"{case.name}.ballot").write_bytes(encode(vehicle.ballot(case)))
        np.save(folder / "poses.npy", poses)
        stages = {stage: 1000.0 * float(np.median(seconds)) for stage, seconds in report.stage_s.items()}
        (folder / "pass.json").write_text(json.dumps(stages))


def _keeper(scene: Scene, drive: Drive, point_map: PointMap) -> Keeper:
    return Keeper(scene.truth.grid_on(point_map.lattice), drive.sensor, scene.settings.paper.n_min)


def _localise(scene: Scene, drive: Drive, point_map: PointMap) -> Localise:
    """By NDT, or by the truth; with noise if the scene's conditions say so."""
    conditions = scene.conditions
    if conditions.true_poses:
        assert drive.T_map_lidar_prior is not None
        localise: Localise = GivenPoses(drive.stamps_ns, drive.T_map_lidar_prior)
    else:
        localise = Localiser(point_map, scene.settings, drive.sensor)
    if conditions.noise_m or conditions.noise_deg:
        number = scene.drive_names("v").index(drive.path.name)
        localise = Shaken(localise, drive.stamps_ns, conditions, (scene.seed, number))
    return localise


def _read_pass(folder: Path, cases: Sequence[Case]) -> Pass:
    raw = {case.name: (folder / f"{case.name}.ballot").read_bytes() for case in cases}
    return Pass(
        vehicle=folder.name,
        ballots={case: decode(data) for case, data in raw.items()},
        sizes={case: len(data) for case, data in raw.items()},
        T_map_lidar=np.load(folder / "poses.npy"),
        stage_ms=json.loads((folder / "pass.json").read_text()),
    )
