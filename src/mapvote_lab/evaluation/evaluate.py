"""``mapvote evaluate``: a scenario and a seed become Tables II-IV and what else there is to measure (paper V): how far
poses and maps are off the truth, and how well a vehicle localises where the world changed, in the old map, in the
updated one, and in one surveyed anew.

A round of votes through a real server: its own process on this machine, spoken to by HTTP alone (paper, Figure 1).
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import httpx2
import numpy as np

from mapvote.client import MapClient
from mapvote.codec.ballot import Ballot
from mapvote.core.geometry import exp
from mapvote.core.grid import Grid
from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, I64, Drive, MapvoteError, PosePrior
from mapvote.formats import read_map, write_map
from mapvote.formats.atomic import whole_folder
from mapvote.matching.ndt_map import MapWindow
from mapvote.matching.odometry import Tracker
from mapvote.survey.build import build_map
from mapvote_lab.evaluation.baselines import yardsticks
from mapvote_lab.evaluation.cases import Case, Progress, fuse_case, read_kept, swept, untold
from mapvote_lab.evaluation.scene import Pass, Scene, pass_folder, passes
from mapvote_lab.evaluation.scores import CaseResult, Cost, EvaluationResult, MapShift, PoseErrors, Scores, Timings
from mapvote_lab.evaluation.truths import CaseOutcome, Jury, Truth, error_summary, rigid_between
from mapvote_lab.simulation.routes import DRIVE_PLAN, ar1


def map_shift(scene: Scene) -> MapShift:
    """How far the first map lies from the truth: mean offset of the survey's poses, and the 95 % of their distances."""
    names = scene.drive_names("survey_")
    offset = np.concatenate([scene.survey_poses(n)[:, :3, 3] - scene.true_poses(n)[:, :3, 3] for n in names])
    x, y, z = offset.mean(axis=0).tolist()
    p95_m = float(np.percentile(np.linalg.norm(offset, axis=1), 95))
    return MapShift(float(np.linalg.norm(offset.mean(axis=0))), x, y, z, p95_m)


def T_map_world_of(scene: Scene) -> F64:
    """T_map_world: the truth's frame in the map's, by the survey's trajectory."""
    names = scene.drive_names("survey_")
    believed = np.concatenate([scene.survey_poses(n) for n in names])
    return rigid_between(believed, np.concatenate([scene.true_poses(n) for n in names]))


def localise_in(drive: Drive, scans: I64, point_map: PointMap, scene: Scene) -> F64:
    """(n, 4, 4) the pose of each of these scans by NDT in ``point_map`` from the drive's own prior, NaN where lost."""
    tracker = Tracker(MapWindow(point_map), scene.settings.ndt)
    out = np.full((len(scans), 4, 4), np.nan)
    for k, i in enumerate(scans):
        fix = tracker.localise(drive.read_scan(int(i)), PosePrior.of(drive, int(i)))
        if fix.trusted:
            out[k] = fix.registration.T_map_lidar
    return out


def survey_anew(scene: Scene, without: str, progress: Progress = untold) -> tuple[PointMap, F64]:
    """A map of today's street by our own SLAM from the drives of all vehicles but one, given a survey vehicle's RTK,
    and T_map_world: the truth's frame in its own."""
    folder = scene.work / f"surveyed-anew-without-{without}"
    names = [name for name in scene.drive_names("v") if name != without]
    if not folder.exists():
        drives = []
        sigma = np.array([DRIVE_PLAN.rtk_sigma_m] * 3 + [np.radians(DRIVE_PLAN.rtk_sigma_deg)] * 3)
        for name in names:  # the error is smooth, as the first survey's: white noise averages out
            drive = scene.drive(name)
            rng = np.random.default_rng([scene.seed, *name.encode()])
            errors = ar1(1e-9 * np.diff(drive.stamps_ns), sigma, rng)
            T = np.array([T @ exp(error) for T, error in zip(scene.true_poses(name), errors, strict=True)])
            drives.append(
                replace(
                    drive,
                    T_map_lidar_prior=T,
                    prior_sigma_m=DRIVE_PLAN.rtk_sigma_m,
                    prior_sigma_deg=DRIVE_PLAN.rtk_sigma_deg,
                )
            )
        point_map, report = build_map(drives, scene.settings, progress=partial(progress, "surveying anew"))
        with whole_folder(folder, sign="poses.npy") as made:
            write_map(point_map, made / "map")
            np.save(made / "poses.npy", np.concatenate([track.T_map_lidar for track in report.tracks]))
    truth = np.concatenate([scene.true_poses(name) for name in names])
    return read_map(folder / "map"), rigid_between(np.load(folder / "poses.npy"), truth)


def in_changed_areas(
    scene: Scene, truth: Truth, vehicle: str, maps: Mapping[str, tuple[PointMap, F64]], near_m: float = 30.0
) -> dict[str, PoseErrors]:
    """Errors of one vehicle's scans within ``near_m`` of changes, by map (each with its T_map_world); empty if it came
    near none."""
    corners = [np.zeros((0, 2)), *(np.asarray(o["footprint"]) for o in truth.objects)]
    away_m = scene.true_poses(vehicle)[:, None, :2, 3] - np.concatenate(corners)[None]
    drive = scene.drive(vehicle)
    scans = np.flatnonzero((np.linalg.norm(away_m, axis=2) <= near_m).any(axis=1))
    if not len(scans):
        return {}
    T_true = scene.true_poses(vehicle)[scans]
    return {
        name: error_summary(localise_in(drive, scans, point_map, scene), T_map_world @ T_true)
        for name, (point_map, T_map_world) in maps.items()
    }


@dataclass(frozen=True, slots=True)
class PublishedRound:
    """Results of a server's round."""

    updated: PointMap
    """The newest map, as a vehicle downloads it."""
    version: int
    held: str
    """Why the server held the version until the operator overrode it; "" if it did not."""


@contextmanager
def running_server(store: Path, first_map: Path, log: Path) -> Iterator[str]:
    """The URL of ``mapvote serve`` on a new ``store``, on any free port; stopped on leaving. Logs go to ``log``.

    MapvoteError with the server's last line if it does not come up.
    """
    command = [sys.executable, "-m", "mapvote", "serve", str(store), "--map", str(first_map)]
    command += ["--port", "0", "--open"]
    with log.open("w") as errors, subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True) as server:
        try:
            assert server.stdout is not None
            said = server.stdout.readline().split()
            if len(said) != 2 or said[0] != "serving":
                last = (log.read_text().splitlines() or ["it said nothing"])[-1]
                raise MapvoteError(f"the server did not start ({last}); is mapvote installed with its server extra?")
            yield said[1]
        finally:
            server.terminate()
            try:
                server.wait(20.0)
            except subprocess.TimeoutExpired:
                server.kill()


def vote_by_http(ballots: Sequence[Ballot], first_map: Path, folder: Path) -> PublishedRound:
    """Start a server, send every ballot as its vehicle would, publish, and download the newest map.

    ``folder`` keeps the store, the clients' homes and the server's log. MapvoteError if the server refuses a ballot.
    """
    folder.mkdir(parents=True, exist_ok=True)
    store = folder / "store.db"
    for old in folder.glob("store.db*"):
        old.unlink()
    with running_server(store, first_map, folder / "server.log") as url:
        for ballot in ballots:
            with MapClient(url, home=folder / ballot.vehicle) as client:
                if client.send(ballot) == "spooled":
                    raise MapvoteError(f"{url}: did not take {ballot.vehicle}'s ballot; see {folder / 'server.log'}")
        ask = {"reason": "a round of votes on this machine"}
        answer = httpx2.post(f"{url}/v1/publish", json=ask, timeout=120.0)
        held = ""
        if answer.status_code == 409:
            held = str(answer.json().get("detail", "for no reason given"))
            answer = httpx2.post(f"{url}/v1/publish", json={**ask, "override": True}, timeout=120.0)
        if answer.status_code != 200:
            raise MapvoteError(f"{url}: publishing failed ({answer.status_code}); see {folder / 'server.log'}")
        with MapClient(url, home=folder / "reader") as client:
            updated = client.fetch()
            return PublishedRound(updated, client.version or 0, held)


@dataclass(frozen=True)
class Evaluation:
    """The numbers, and what pictures need."""

    result: EvaluationResult
    scene: Scene
    truth: Truth
    window: Grid
    first_map: PointMap
    outcomes: Mapping[str, CaseOutcome]
    drives: Sequence[Pass]
    best: str
    """The case whose updated map is shown: the one that the settings vote by, else the first."""


def evaluate(
    scene: Scene,
    cases: Sequence[Case],
    with_yardsticks: bool = False,
    progress: Progress = untold,
    readings: str | None = None,
    helpers: Executor | None = None,
    voted: Callable[[Sequence[Pass]], object] | None = None,
) -> Evaluation:
    """Run what the cache lacks, decide and score every case. Two processes where there are two cores, or ``helpers``.
    ``voted(passes)`` is called before they are scored.

    ``readings``: the open sentence of the paper (a setting of ``[paper]``) whose other readings are scored too; "all":
    every sentence; None: no other reading.
    """
    started = time.perf_counter()
    scene.prepare(progress)
    prepared = time.perf_counter()
    workers = min(2, os.cpu_count() or 1)
    drives = passes(scene, cases, workers, progress, readings is not None, helpers)
    if voted:
        voted(drives)
    all_voted = time.perf_counter()
    truth = scene.truth
    first_map = scene.point_map
    jury = Jury(first_map, truth)
    best = next((c.name for c in cases if c.name == scene.settings.voting.method), cases[0].name)
    outcomes, entries = _scored(scene, cases, drives, jury, progress)
    T_map_world = T_map_world_of(scene)
    maps = {"old map": (first_map, T_map_world), f"updated map ({best})": (outcomes[best].updated, T_map_world)}
    scored = time.perf_counter()
    costs: dict[str, Cost] = {}
    if with_yardsticks:
        maps["map surveyed anew"] = survey_anew(scene, drives[0].vehicle, progress)
        measured, costs = yardsticks(scene, drives, workers, progress)
        entries |= {name: jury.of_states(*states) for name, states in measured.items()}
    result = EvaluationResult(
        scenario=scene.scenario,
        seed=scene.seed,
        poses=scene.poses,
        cells=int(truth.strict.size),
        coverage=entries[best].coverage,
        settings=scene.settings.model_dump(mode="json"),
        map_shift=map_shift(scene),
        localisation=_errors(scene, drives, T_map_world),
        changed_areas=in_changed_areas(scene, truth, drives[0].vehicle, maps),
        ceilings=jury.ceilings(),
        cases=entries,
        readings={} if readings is None else _readings(scene, cases, jury, readings, progress),
        timings=Timings(
            prepare_s=prepared - started,
            vote_s=all_voted - prepared,
            score_s=scored - all_voted,
            yardsticks_s=time.perf_counter() - scored,
            methods=costs,
            stages_ms={drive.vehicle: drive.stage_ms for drive in drives},
            fuse_s={name: outcome.seconds for name, outcome in outcomes.items()},
        ),
    )
    return Evaluation(result, scene, truth, jury.window, first_map, outcomes, drives, best)


def _errors(scene: Scene, drives: Sequence[Pass], T_map_world: F64) -> dict[str, PoseErrors]:
    """By vehicle."""
    return {d.vehicle: error_summary(d.T_map_lidar, T_map_world @ scene.true_poses(d.vehicle)) for d in drives}


def _readings(
    scene: Scene, cases: Sequence[Case], jury: Jury, only: str, progress: Progress
) -> dict[str, dict[str, dict[str, Scores]]]:
    """Scores by reading, case and truth, from what the scans of the vehicles' drives said."""
    kept = [read_kept(pass_folder(scene, cases, name, True)) for name in scene.drive_names("v")]
    # The truths that differ: the readings of the paper are scored by each.
    truths = {name: jury.truths[name] for name in ("strict", "provenance", "could be known")}
    return swept(kept, jury.first_map.counts > 0, scene.settings, truths, None if only == "all" else only, progress)


def _scored(
    scene: Scene, cases: Sequence[Case], drives: Sequence[Pass], jury: Jury, progress: Progress
) -> tuple[dict[str, CaseOutcome], dict[str, CaseResult]]:
    """By case: what the server makes of its ballots, and the scores."""
    first_map = scene.point_map
    outcomes = dict[str, CaseOutcome]()
    entries = dict[str, CaseResult]()
    for i, case in enumerate(cases):
        progress("scoring", i, len(cases))
        ballots = [drive.ballots[case.name] for drive in drives]
        outcomes[case.name] = fuse_case(first_map, ballots, case.min_votes, scene.settings.fuse, jury.window)
        votes = [sum(len(tile.states or tile.tally or b"") for tile in ballot.tiles) for ballot in ballots]
        entries[case.name] = jury.of_update(outcomes[case.name], [d.sizes[case.name] for d in drives], votes)
    progress("scoring", len(cases), len(cases))
    return outcomes, entries
