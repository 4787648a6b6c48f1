"""Drives to judge by: simulated streets, with all their truth, and KITTI's, with odometry for poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, Drive
from mapvote.formats import open_drive, read_map, read_T_map_lidar, write_map
from mapvote.slam.build import build_map
from mapvote_lab.evaluation.scoring.scene_truth import Truth, read_truth
from mapvote_lab.simulation import simulate


@dataclass(frozen=True)
class Street:
    """A map, a drive through it, and what is true."""

    name: str
    point_map: PointMap
    drive: Drive
    T_true: F64
    truth: Truth | None


def simulated(out: Path, scene: str) -> Street:
    """``SCENARIO:SEED[:SENSOR]``; a folder of drives in OUT is used again."""
    scenario, seed, *sensor = scene.split(":")
    folder = out / scene.replace(":", "_")
    if not folder.exists():
        simulate(scenario, folder, int(seed), overrides={"sensor": sensor[0]} if sensor else {})
    point_map = _map(out, folder.name, sorted(folder.glob("survey_*")), None)
    T_true = read_T_map_lidar(folder / "truth" / "v1" / "poses.txt", folder / "v1")
    return Street(scene, point_map, open_drive(folder / "v1"), T_true, read_truth(folder))


def recorded(out: Path, folder: Path) -> Street:
    """A KITTI drive: the map is made of every second scan."""
    point_map = _map(out, folder.name, [folder], "::2")
    T_true = read_T_map_lidar(folder / "poses.txt", folder)
    return Street(f"KITTI {folder.name[-4:]}", point_map, open_drive(folder), T_true, None)


def _map(out: Path, name: str, surveys: list[Path], scans: str | None) -> PointMap:
    path = out / f"map_{name}"
    if not path.exists():
        write_map(build_map([open_drive(survey, scans=scans) for survey in surveys])[0], path)
    return read_map(path)
