"""How far poses and maps are off the truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapvote.core.types import F64
from mapvote_lab.evaluation.experiments.passes import Pass
from mapvote_lab.evaluation.experiments.scene import Scene
from mapvote_lab.evaluation.results import MapShift
from mapvote_lab.evaluation.scoring.truth import PoseErrors, error_summary, rigid_between


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
