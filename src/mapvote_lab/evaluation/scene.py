"""One simulated scene and its products, kept on disk: drives, first map, ballots.

Everything is cached by what it depends on: scenario, seed, settings and the program's own sources, so that a run
that was cut short goes on where it stopped and a changed program never meets an old result.

One pass over a drive serves all cases: what a scan saw is worked out once, each voter counts by its rules. Voters that
count alike share their counters, and those of a method share the candidates for new points.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, as_completed
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

import mapvote
import mapvote_lab
from mapvote.codec.ballot import Ballot, decode, encode
from mapvote.config import Settings
from mapvote.core.columns import GROUND_MARGIN_M
from mapvote.core.point_map import PointMap
from mapvote.core.process_memory import give_back_free_pages
from mapvote.core.reference import LocalMap
from mapvote.core.rule import rule_named
from mapvote.core.types import F64, Drive, PosePrior, Scan
from mapvote.core.voxels import voxel_downsample
from mapvote.formats import open_drive, read_map, write_map
from mapvote.formats.atomic import whole_file, whole_folder
from mapvote.matching.localiser import GivenPoses, Localise, Localiser
from mapvote.perception.frontend import DriveReport, Frontend, Observation
from mapvote.perception.moving_objects import MovingFilter
from mapvote.rules.voter import NewPoints, Voter, make_voter
from mapvote.survey.build import build_map
from mapvote.vehicle import write_ballot
from mapvote_lab.evaluation.cases import Case, CountedBy, KeptDrive, Progress, counting_rule, untold
from mapvote_lab.evaluation.truths import Truth, read_truth
from mapvote_lab.processes import Run, processes
from mapvote_lab.simulation import simulate
from mapvote_lab.simulation.drives import Begun
from mapvote_lab.simulation.scenario import load_scenario

_MAP_FROM = ("core", "codec", "formats", "matching", "perception", "rules", "survey")
BALLOTS_FROM = (
    *_MAP_FROM, "vehicle.py", "evaluation/scene.py",
    "evaluation/cases.py",
)  # fmt: skip


@cache
def sources_digest(parts: tuple[str, ...]) -> str:
    """SHA-256 over the program text of some modules and packages of mapvote and of its laboratory."""
    roots = Path(mapvote.__file__).parent, Path(mapvote_lab.__file__).parent
    digest = hashlib.sha256()
    for part in parts:
        root = next((root for root in roots if (root / part).exists()), None)
        if root is None:
            raise FileNotFoundError(f"no such part of mapvote: {part}")
        for file in [root / part] if part.endswith(".py") else sorted((root / part).rglob("*.py")):
            digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def key_of(*parts: object) -> str:
    """12 hex digits naming everything that a cached result depends on."""
    return hashlib.sha256(json.dumps([str(w) for w in parts]).encode()).hexdigest()[:12]


@dataclass(frozen=True)
class Scene:
    """A scenario and a seed, simulated into a folder of the cache when first asked for."""

    scenario: str
    seed: int
    settings: Settings
    cache: Path
    overrides: Mapping[str, Any] = field(default_factory=dict)
    poses: str = "ndt"
    """"truth": surveys and vehicles know where they are."""

    @property
    def folder(self) -> Path:
        """Drives and truth."""
        text = load_scenario(self.scenario, self.overrides).model_dump_json()
        name = f"{Path(self.scenario).stem}-{self.seed}"
        thinning = inspect.getsource(voxel_downsample)
        # Drives and truth depend on few sources: most work on the program leaves gigabytes of drives valid.
        sources = ("simulation", "core/geometry.py", "core/grid.py", "core/sensors.py", "formats/drives/scan_folder.py")
        return self.cache / f"{name}-{key_of(text, sources_digest(sources), GROUND_MARGIN_M, thinning)}"

    @property
    def work(self) -> Path:
        """Results of the drives with these settings."""
        s = self.settings
        settings = [part.model_dump_json() for part in (s.ndt, s.moving, s.mapping)]
        key = key_of(sources_digest(_MAP_FROM), *settings, self.poses)
        return self.folder.with_name(f"{self.folder.name}-made") / key

    def simulate(self, progress: Progress = untold, run: Run | None = None, begun: Begun | None = None) -> None:
        """Simulate the drives, unless the cache holds them. ``run``: by these processes. ``begun``: see there."""
        if self.folder.exists():
            if begun:
                begun(self.folder, self.drive_names("survey_")[0], self.drive_names("v")[0])
        else:
            made = self.folder.with_name(f".{self.folder.name}.{os.getpid()}")
            report = partial(progress, "simulating")
            simulate(self.scenario, made, self.seed, progress=report, overrides=self.overrides, run=run, begun=begun)
            os.replace(made, self.folder) if not self.folder.exists() else shutil.rmtree(made)

    def prepare(self, progress: Progress = untold) -> None:
        """Simulate the drives and build the first map, unless the cache holds them."""
        self.simulate(progress)
        if not (self.work / "map").exists():
            surveys = [self.drive(name) for name in self.drive_names("survey_")]
            point_map, report = build_map(surveys, self.settings, progress=partial(progress, "mapping"))
            for track in report.tracks:
                with whole_file(self.work / f"{track.vehicle}.npy") as written, written.open("wb") as file:
                    np.save(file, track.T_map_lidar)
            write_map(point_map, self.work / "map")
            give_back_free_pages()

    def drive_names(self, prefix: str) -> list[str]:
        """Drives of the surveys ("survey_") or of the voting vehicles ("v"), in order of their numbers."""
        names = [p.name for p in self.folder.iterdir() if p.name.startswith(prefix) and p.is_dir()]
        return sorted(names, key=lambda name: (len(name), name))

    def drive(self, name: str) -> Drive:
        """A drive with its own prior, or with its true poses for a prior."""
        if self.poses == "ndt":
            return open_drive(self.folder / name)
        drive = open_drive(self.folder / name, prior=str(self.folder / "truth" / name / "poses.txt"))
        return replace(drive, prior_sigma_m=0.001, prior_sigma_deg=0.001)

    def true_poses(self, name: str) -> F64:
        """(n, 4, 4) where the drive's scans were really taken."""
        return self.truth.poses(name)

    @property
    def truth(self) -> Truth:
        """See :mod:`mapvote_lab.evaluation.truths`."""
        return read_truth(self.folder)

    @property
    def point_map(self) -> PointMap:
        """The map that is voted on."""
        return read_map(self.work / "map")

    def survey_poses(self, name: str) -> F64:
        """(n, 4, 4) where the SLAM believes the survey vehicle was."""
        return np.asarray(np.load(self.work / f"{name}.npy"), dtype=np.float64)


class SharedPass:
    """A vehicle with a voter for every case. ``localise``: as a vehicle's own, or an experiment's."""

    def __init__(
        self,
        drive: Drive,
        point_map: PointMap,
        settings: Settings,
        cases: Sequence[Case],
        *,
        localise: Localise | None = None,
    ) -> None:
        self.drive = drive
        self.point_map = point_map
        self.settings = settings
        self._frontend = Frontend(
            localise or Localiser(point_map, settings, drive.sensor),
            MovingFilter(drive.sensor, settings.moving),
            LocalMap(point_map, settings.voting.window_m),
            sensor=drive.sensor,
        )
        self._voters: dict[CountedBy, Voter] = {}
        for counted_by in dict.fromkeys(map(counting_rule, cases)):
            own = settings.model_copy(update=dict(zip(("voting", "paper"), counted_by, strict=True)))
            rule = rule_named(own.voting.method)
            self._voters[counted_by] = make_voter(rule, own, drive.sensor, point_map)
        methods = {voting.method for voting, _ in self._voters}
        self._new_points = {m: NewPoints(point_map.lattice, beyond=rule_named(m).takes_points_beyond) for m in methods}

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
                for (voting, _), voter in self._voters.items():
                    may_be_new[voting.method] |= voter.observe(seen)
                for method, words in may_be_new.items():
                    self._new_points[method].gather(seen, words)
        return observations

    def ballot(self, case: Case) -> Ballot:
        """The vehicle's ballot by one of its cases. MapvoteError if no scan has voted."""
        settings = self.settings.model_copy(update={"voting": case.voting, "paper": case.paper})
        return write_ballot(
            self.drive.vehicle, self.drive.drive_id, self.point_map, settings, self.report,
            self._voters[counting_rule(case)].each(), self._new_points[case.voting.method],
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Pass:
    """Result of one vehicle's drive."""

    vehicle: str
    ballots: dict[str, Ballot]
    """By case."""
    sizes: dict[str, int]
    """Bytes of each ballot as it is sent."""
    T_map_lidar: F64
    """(n, 4, 4) where the vehicle believed to be; NaN where it abstained."""
    stage_ms: dict[str, float]
    """Median milliseconds a scan by stage."""


def passes(
    scene: Scene,
    cases: Sequence[Case],
    workers: int,
    progress: Progress = untold,
    keep: bool = False,
    helpers: Executor | None = None,
) -> list[Pass]:
    """The passes of all voting vehicles, in order of their numbers; those that the cache lacks are driven.

    The first is driven in this process, the others by ``helpers``, or else in ``workers`` - 1 further processes.
    ``keep``: what each scan says is kept too.
    """
    names = scene.drive_names("v")
    missing = [name for name in names if not pass_folder(scene, cases, name, keep).exists()]
    done = count(len(names) - len(missing))

    def tell() -> None:
        progress("voting", next(done), len(names))

    tell()
    shared = workers > 1 and len(missing) > 1 and not helpers
    with processes(workers - 1) if shared else nullcontext(helpers) as pool:
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
    votes_by = ((c.name, c.voting.model_dump_json(), c.paper.model_dump_json()) for c in cases)
    key = key_of(sources_digest(BALLOTS_FROM), *votes_by)
    return scene.work / f"{'kept' if keep else 'votes'}-{key}" / vehicle


def drive_once(scene: Scene, cases: Sequence[Case], name: str, keep: bool = False) -> None:
    """One vehicle's drive with a voter for every case; ballots and poses into the cache, whole or not at all."""
    drive = scene.drive(name)
    point_map = scene.point_map
    localise = None
    if scene.poses == "truth":
        assert drive.T_map_lidar_prior is not None
        localise = GivenPoses(drive.stamps_ns, drive.T_map_lidar_prior)
    vehicle = SharedPass(drive, point_map, scene.settings, cases, localise=localise)
    window = scene.truth.grid_on(point_map.lattice)
    keeper = KeptDrive(window, drive.sensor, scene.settings.paper.n_min) if keep else None
    for i, scan in enumerate(drive):
        observations = vehicle.observe(scan, PosePrior.of(drive, i))
        if keeper:
            keeper.watch(observations)
    observations = vehicle.finish()
    report = vehicle.report
    poses = np.full((len(drive), 4, 4), np.nan)
    localised = np.setdiff1d(np.arange(len(drive)), report.lost)
    poses[localised] = np.array(report.T_map_lidar)[localised]
    with whole_folder(pass_folder(scene, cases, name, keep), sign="pass.json") as folder:
        if keeper:
            keeper.watch(observations)
            keeper.write(folder)
        for case in cases:
            (folder / f"{case.name}.ballot").write_bytes(encode(vehicle.ballot(case)))
        np.save(folder / "poses.npy", poses)
        stages = {stage: 1000.0 * float(np.median(seconds)) for stage, seconds in report.stage_s.items()}
        (folder / "pass.json").write_text(json.dumps(stages))


def _read_pass(folder: Path, cases: Sequence[Case]) -> Pass:
    raw = {case.name: (folder / f"{case.name}.ballot").read_bytes() for case in cases}
    return Pass(
        vehicle=folder.name,
        ballots={case: decode(data) for case, data in raw.items()},
        sizes={case: len(data) for case, data in raw.items()},
        T_map_lidar=np.load(folder / "poses.npy"),
        stage_ms=json.loads((folder / "pass.json").read_text()),
    )
