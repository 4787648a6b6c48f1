"""One pass over each drive, and a ballot for every case. Ballots are cached: a run that was cut short goes on."""

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
from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, Drive
from mapvote.formats import open_drive
from mapvote.formats.atomic import whole_folder
from mapvote.localisation.localiser import GivenPoses, Localise, Localiser
from mapvote.localisation.ndt import PosePrior
from mapvote_lab.evaluation.experiments.cases import Case
from mapvote_lab.evaluation.experiments.conditions import Shaken, TrueMovers
from mapvote_lab.evaluation.experiments.kept import Keeper
from mapvote_lab.evaluation.experiments.scene import BALLOTS_FROM, Progress, Scene, key_of, sources_digest
from mapvote_lab.evaluation.experiments.shared_pass import SharedPass
from mapvote_lab.simulation.processes import processes


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
