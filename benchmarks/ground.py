"""The ground of maps made from simulated surveys, against the terrain that the simulator knows.

    python benchmarks/ground.py --priors 101 [--kitti ../shared/data/kitti]     # 20 surveys under priors of all kinds

The LiDAR has the scenario's flaws: reflections below the road, mixed pixels, surfaces that return nothing. A cell is
right between the lowest and the highest terrain in it. Under priors that are metres off, a map is compared where it
lies by its own path: each cell is moved as the nearest pose is moved to its true place.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from mapvote.core.geometry import from_xyz_rpy, inverses
from mapvote.core.grid import CELL_SIZE
from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, Bool, Drive, MapvoteError
from mapvote.doctor.diagnosis import examine_drive
from mapvote.formats import open_drive, read_T_map_lidar
from mapvote.slam.build import BuildReport, build_map
from mapvote_lab.simulation import simulate
from mapvote_lab.simulation.drives import _stage
from mapvote_lab.simulation.scenario import Scenario, load_scenario
from mapvote_lab.simulation.truth import T_map_street

NEAR_M = 10.0
COLUMNS = (
    "survey", "sensor's height off, m", "path off, m", "occupied under the path", "ground: median off, m", "99 %, m",
    "lowest, m", "highest, m", "cells off by > .15 m", "bent, m", "doctor",
)  # fmt: skip


@dataclass(frozen=True)
class Survey:
    """A simulated survey and what its priors are like."""

    scenario: str
    length_m: float
    sigma_m: float
    errors: str
    """smooth: alike for 10 s; jumping: another offset every 5 s; tilted: smooth, and pitch and roll off throughout."""
    drives: int

    def __str__(self) -> str:
        return f"{self.scenario} {self.length_m:.0f} m, {self.drives} x, {self.errors}, {self.sigma_m} m"


SURVEYS = (
    Survey("street", 250, 0.02, "smooth", 1), Survey("street", 400, 0.3, "jumping", 1),
    Survey("street", 600, 1.0, "smooth", 1), Survey("street", 300, 3.0, "tilted", 2),
    Survey("street", 150, 1.0, "tilted", 1), Survey("slanted", 250, 0.02, "tilted", 1),
    Survey("slanted", 350, 0.3, "smooth", 2), Survey("slanted", 500, 1.0, "jumping", 1),
    Survey("slanted", 200, 3.0, "smooth", 1), Survey("slanted", 250, 1.0, "tilted", 2),
    Survey("corner", 100, 0.02, "jumping", 2), Survey("corner", 100, 0.3, "tilted", 1),
    Survey("corner", 150, 1.0, "smooth", 2), Survey("corner", 100, 3.0, "jumping", 1),
    Survey("corner", 120, 1.0, "tilted", 1), Survey("terrace", 180, 0.02, "smooth", 2),
    Survey("terrace", 250, 0.3, "tilted", 1), Survey("terrace", 300, 1.0, "jumping", 2),
    Survey("terrace", 180, 3.0, "smooth", 1), Survey("terrace", 400, 1.0, "smooth", 1),
)  # fmt: skip
"""Every scenario, sigma and kind of error, 100 to 600 m, one drive and two."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--priors", type=int, metavar="SEED", default=101, help="20 surveys; seeds from here on")
    parser.add_argument("--kitti", type=Path, help="real drives too: only path and ground against each other")
    arguments = parser.parse_args()
    print("| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS))
    with tempfile.TemporaryDirectory() as folder:
        for k, survey in enumerate(SURVEYS):
            row = simulated(survey, arguments.priors + k, Path(folder) / str(k))
            print("| " + " | ".join([str(survey), *row]) + " |", flush=True)
    for path in sorted(arguments.kitti.glob("*")) if arguments.kitti else ():
        print("| " + " | ".join([path.name, *real(path)]) + " |", flush=True)


def simulated(survey: Survey, seed: int, folder: Path) -> list[str]:
    """The columns of one survey."""
    overrides: dict[str, object] = {"vehicles": 1, "length_m": survey.length_m, "changes": []}
    overrides |= {"clutter": {"gantry_m": []}, "surveys": ["east inner", "west inner"][: survey.drives]}
    simulate(survey.scenario, folder, seed, overrides=overrides)
    drives = [open_drive(path) for path in sorted(folder.glob("survey_*"))]
    true = [read_T_map_lidar(folder / "truth" / d.path.name / "poses.txt", d.path) for d in drives]
    drives = [off(d, T, survey, 10 * seed + k) for k, (d, T) in enumerate(zip(drives, true, strict=True))]
    said = ", ".join(doctors_word(drive) for drive in drives)
    try:
        point_map, report = build_map(drives)
    except MapvoteError as error:
        return [f"refused: {error}", *[""] * 8, said]
    spec = load_scenario(survey.scenario, overrides)
    height = max(abs(track.heights.median_m - spec.mount_height_m) for track in report.tracks)
    near, under = beyond_terrain(point_map, report, true, spec, seed)
    return [
        f"{height:.3f}", worst_of(report), f"{under.mean():.2%}", f"{np.median(np.abs(near)):.3f}",
        f"{np.percentile(np.abs(near), 99):.3f}", f"{near.min():+.2f}", f"{near.max():+.2f}",
        f"{(np.abs(near) > 0.15).mean():.3%}", f"{report.bent_m:.2f}", said,
    ]  # fmt: skip


def real(path: Path) -> list[str]:
    """The columns of a real drive, of which nobody knows the terrain."""
    drive = open_drive(path)
    _, report = build_map([drive])
    height = f"{report.tracks[0].heights.median_m:.3f} high"
    return [height, worst_of(report), *[""] * 6, f"{report.bent_m:.2f}", doctors_word(drive)]


def worst_of(report: BuildReport) -> str:
    return f"{max(abs(track.heights.worst_off_m) for track in report.tracks):.3f}"


def doctors_word(drive: Drive) -> str:
    """The gravest thing that the doctor measures."""
    found = [f.severity for f in examine_drive(drive)[0]]
    return next((grave for grave in ("error", "warning") if grave in found), "sound")


def off(drive: Drive, true: F64, survey: Survey, seed: int) -> Drive:
    """The drive with priors around its ``true`` poses (n, 4, 4) that err as the ``survey`` says."""
    rng, n = np.random.default_rng([seed, 77]), len(true)
    seconds = 1e-9 * (drive.stamps_ns - drive.stamps_ns[0])
    sigma = np.array([survey.sigma_m] * 3 + [np.radians(0.1)] * 3)
    if survey.errors == "jumping":
        piece = (seconds / 5.0).astype(np.int64)
        error = (rng.normal(size=(piece[-1] + 1, 6)) * sigma)[piece]
    else:
        memory = np.exp(-np.diff(seconds, prepend=-1.0) / 10.0)
        error = rng.normal(size=(n, 6)) * sigma
        for i in range(1, n):
            error[i] = memory[i] * error[i - 1] + np.sqrt(1.0 - memory[i] ** 2) * error[i]
    if survey.errors == "tilted":
        error[:, 3:5] += np.radians(rng.uniform(0.5, 1.0, 2) * rng.choice([-1.0, 1.0], 2))
    prior = np.array([T @ from_xyz_rpy(0, 0, 0, *e[3:]) for T, e in zip(true, error, strict=True)])
    prior[:, :3, 3] = true[:, :3, 3] + error[:, :3]
    return replace(drive, T_map_lidar_prior=prior, prior_sigma_m=survey.sigma_m, prior_sigma_deg=1.0)


def beyond_terrain(
    point_map: PointMap, report: BuildReport, true: list[F64], spec: Scenario, seed: int
) -> tuple[F64, Bool]:
    """((n,) how far the ground near the path lies above (+) or below (-) its cell's terrain, occupied under it)."""
    tree, grounds, under = cKDTree(np.concatenate(point_map.driven)[:, :2]), [], []
    for tile in point_map.tiles.values():
        x, y = np.meshgrid(*tile.window.centres())
        away = tree.query(np.column_stack([x.ravel(), y.ravel()]))[0].reshape(x.shape)
        here = (away < NEAR_M) & np.isfinite(tile.ground_z)
        grounds.append(np.column_stack([x[here], y[here], tile.ground_z[here].astype(np.float64)]))
        under.append((tile.obstacle_words != 0)[away < CELL_SIZE / 2])
    ground = np.concatenate(grounds)
    found = np.concatenate([track.T_map_lidar for track in report.tracks])
    moved = np.concatenate(true) @ inverses(found)
    street = np.linalg.inv(T_map_street(spec)) @ moved[cKDTree(found[:, :2, 3]).query(ground[:, :2])[1]]
    x, y, z = (street[:, :3, :3] @ ground[:, :, None])[:, :, 0].T + street[:, :3, 3].T
    terrain, half = _stage(spec, seed).world.terrain, CELL_SIZE / 2
    heights = np.stack([terrain.height(x + a, y + b) for a in (-half, 0, half) for b in (-half, 0, half)])
    low, high = heights.min(axis=0), heights.max(axis=0)
    error = np.where(z > high, z - high, np.minimum(z - low, 0.0))
    return error[(x > 0.0) & (x < spec.length_m)], np.concatenate(under)


if __name__ == "__main__":
    main()
