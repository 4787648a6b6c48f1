"""The vehicles' passes, whose ballots are kept in the cache.

One pass over a drive serves all cases: what a scan saw is worked out once, each voter counts by its rules. Voters that
count alike share their counters, and those of a method share the candidates for new points.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from concurrent.futures import as_completed
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import numpy as np

from mapvote.codec.ballot import Ballot, decode, encode
from mapvote.config import PaperSettings, Settings, VotingSettings
from mapvote.core.point_map import PointMap
from mapvote.core.reference import LocalMap
from mapvote.core.types import F64, Drive, Scan
from mapvote.detection.new_points import NewPoints
from mapvote.detection.voter import Voter
from mapvote.formats import open_drive
from mapvote.formats.atomic import whole_folder
from mapvote.localisation.localiser import GivenPoses, Localise, Localiser
from mapvote.localisation.ndt import PosePrior
from mapvote.perception.frontend import DriveReport, Frontend, Movers, Observation
from mapvote.perception.moving_objects import MovingFilter
from mapvote.vehicle import make_voter, write_ballot
from mapvote_lab.evaluation.experiments.cases import Case
from mapvote_lab.evaluation.experiments.conditions import Shaken, TrueMovers
from mapvote_lab.evaluation.experiments.paper_readings import Keeper
from mapvote_lab.evaluation.experiments.scene import BALLOTS_FROM, Progress, Scene, key_of, sources_digest
from mapvote_lab.simulation.processes import processes


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
    kept too.
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
