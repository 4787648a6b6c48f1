"""How far poses and maps are off the truth, and how well a vehicle localises where the world changed: in the old map,
in the updated one, and in one surveyed anew.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from mapvote.core.geometry import exp
from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, I64, Drive, PosePrior
from mapvote.formats import read_map, write_map
from mapvote.formats.atomic import whole_folder
from mapvote.localisation.ndt_map import MapWindow
from mapvote.localisation.odometry import Tracker
from mapvote.slam.build import build_map
from mapvote_lab.evaluation.cases import Progress, untold
from mapvote_lab.evaluation.results import MapShift, PoseErrors
from mapvote_lab.evaluation.scene import Pass, Scene
from mapvote_lab.evaluation.truths import Truth, error_summary, rigid_between
from mapvote_lab.simulation.routes import ar1


def map_shift(scene: Scene) -> MapShift:
    """How far the first map lies from the truth: mean offset of the survey's poses, and the 95 % of their distances."""
    names = scene.drive_names("survey_")
    offset = np.concatenate([scene.survey_poses(n)[:, :3, 3] - scene.true_poses(n)[:, :3, 3] for n in names])
    mean = offset.mean(axis=0)
    return MapShift(
        float(np.linalg.norm(mean)),
        float(mean[0]),
        float(mean[1]),
        float(mean[2]),
        float(np.percentile(np.linalg.norm(offset, axis=1), 95)),
    )


def T_map_world_of(scene: Scene) -> F64:
    """T_map_world: the truth's frame in the map's, by the survey's trajectory."""
    names = scene.drive_names("survey_")
    believed = np.concatenate([scene.survey_poses(n) for n in names])
    return rigid_between(believed, np.concatenate([scene.true_poses(n) for n in names]))


def localisation(scene: Scene, drives: Sequence[Pass]) -> dict[str, PoseErrors]:
    """Each vehicle's pose errors in the map's frame."""
    T_map_world = T_map_world_of(scene)
    return {d.vehicle: error_summary(d.T_map_lidar, T_map_world @ scene.true_poses(d.vehicle)) for d in drives}


NEAR_M = 30.0
"""Scans this close to a changed object count."""
_RTK_M, _RTK_DEG = 0.02, 0.05


def scans_near_changes(scene: Scene, truth: Truth, drive: str) -> I64:
    """Indices of a drive's scans taken within NEAR_M of a changed object's footprint."""
    position = scene.true_poses(drive)[:, :2, 3]
    corners = np.concatenate([np.asarray(o["footprint"]) for o in truth.objects]) if truth.objects else np.zeros((0, 2))
    distance = np.linalg.norm(position[:, None] - corners[None], axis=2)
    return np.flatnonzero((distance <= NEAR_M).any(axis=1))


def localise_in(drive: Drive, scans: I64, point_map: PointMap, scene: Scene) -> F64:
    """(n, 4, 4) the pose of each of these scans by NDT in ``point_map`` from the drive's own prior, NaN where lost."""
    tracker = Tracker(MapWindow(point_map), scene.settings.ndt)
    out = np.full((len(scans), 4, 4), np.nan)
    for k, i in enumerate(scans):
        prior = None
        if drive.T_map_lidar_prior is not None:
            sigma_rad = float(np.radians(drive.prior_sigma_deg))
            prior = PosePrior(drive.T_map_lidar_prior[i], drive.prior_sigma_m, sigma_rad)
        fix = tracker.localise(drive.read_scan(int(i)), prior)
        if fix.trusted:
            out[k] = fix.registration.T_map_lidar
    return out


def survey_anew(scene: Scene, without: str, progress: Progress = untold) -> tuple[PointMap, F64]:
    """A map of today's street by our own SLAM from the drives of all vehicles but one, given a survey vehicle's RTK,
    and T_map_world: the truth's frame in its own."""
    folder = scene.work / f"surveyed-anew-without-{without}"
    names = [name for name in scene.drive_names("v") if name != without]
    if not folder.exists():
        drives, told = [_with_rtk(scene, name) for name in names], partial(progress, "surveying anew")
        point_map, report = build_map(drives, scene.settings, progress=told)
        with whole_folder(folder, sign="poses.npy") as made:
            write_map(point_map, made / "map")
            np.save(made / "poses.npy", np.concatenate([track.T_map_lidar for track in report.tracks]))
    truth = np.concatenate([scene.true_poses(name) for name in names])
    return read_map(folder / "map"), rigid_between(np.load(folder / "poses.npy"), truth)


def _with_rtk(scene: Scene, name: str) -> Drive:
    """The drive with a survey vehicle's prior. Its error is smooth, as the first survey's: white noise averages out."""
    rng = np.random.default_rng([scene.seed, *name.encode()])
    drive, sigma = scene.drive(name), np.array([_RTK_M] * 3 + [np.radians(_RTK_DEG)] * 3)
    errors = ar1(1e-9 * np.diff(drive.stamps_ns), sigma, rng)
    T = np.array([T @ exp(error) for T, error in zip(scene.true_poses(name), errors, strict=True)])
    return replace(drive, T_map_lidar_prior=T, prior_sigma_m=_RTK_M, prior_sigma_deg=_RTK_DEG)


def in_changed_areas(
    scene: Scene, truth: Truth, vehicle: str, maps: Mapping[str, tuple[PointMap, F64]]
) -> dict[str, PoseErrors]:
    """Errors of one vehicle's scans near changes, by map (each with its T_map_world); empty if it came near none."""
    drive, scans = scene.drive(vehicle), scans_near_changes(scene, truth, vehicle)
    if not len(scans):
        return {}
    T_true = scene.true_poses(vehicle)[scans]
    return {
        name: error_summary(localise_in(drive, scans, point_map, scene), T_map_world @ T_true)
        for name, (point_map, T_map_world) in maps.items()
    }
