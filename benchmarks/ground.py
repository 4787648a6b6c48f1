"""The ground of a map made from simulated surveys, against the terrain that the simulator knows.

    python benchmarks/ground.py corner:1 junction:1 street:2

The LiDAR has the scenario's flaws: reflections below the road, mixed pixels, surfaces that return nothing. A cell is
right between the lowest and the highest terrain in it.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree

from mapvote.core.grid import CELL_SIZE, Grid
from mapvote.core.reference import reference_window
from mapvote.core.types import F64
from mapvote.formats import open_drive
from mapvote.slam.build import build_map
from mapvote_lab.simulation import simulate
from mapvote_lab.simulation.drives import _stage
from mapvote_lab.simulation.scenario import load_scenario

NEAR_M = 10.0
ONE_VEHICLE = {"vehicles": 1}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("streets", nargs="+", metavar="SCENARIO:SEED")
    table = Table(
        "street", "sensor's height off, m", "worst, m", "occupied under the path", "near it: median, m", "99 %, m",
        "lowest, m", "highest, m", "off by > 0.2 m", title=f"Ground against terrain; near: within {NEAR_M:.0f} m",
    )  # fmt: skip
    for street in parser.parse_args().streets:
        scenario, seed = street.split(":")
        with tempfile.TemporaryDirectory() as folder:
            table.add_row(street, *measure(scenario, int(seed), Path(folder) / "street"))
    Console(width=150).print(table)


def measure(scenario: str, seed: int, folder: Path) -> list[str]:
    """The columns of one street."""
    simulate(scenario, folder, seed, overrides=ONE_VEHICLE)
    spec = load_scenario(scenario, ONE_VEHICLE)
    point_map, report = build_map([open_drive(path) for path in sorted(folder.glob("survey_*"))])
    height = [abs(track.heights.median_m - spec.mount_height_m) for track in report.tracks]
    worst = [abs(track.heights.worst_off_m) for track in report.tracks]
    path = np.concatenate(point_map.driven)
    low, high = path.min(axis=0) - NEAR_M, path.max(axis=0) + NEAR_M
    rows, cols = point_map.lattice.cells_of(np.stack([low, high]))
    grid = Grid(point_map.lattice, int(rows[0]), int(cols[0]), int(np.ptp(rows)) + 1, int(np.ptp(cols)) + 1)
    reference = reference_window(point_map, grid)
    x, y = np.meshgrid(*grid.centres())
    away = cKDTree(path[:, :2]).query(np.column_stack([x.ravel(), y.ravel()]))[0].reshape(x.shape)
    error = beyond_terrain(reference.ground_z.astype(np.float64), x, y, scenario, seed)
    near = error[(away < NEAR_M) & np.isfinite(error)]
    under = reference.occupied[away < CELL_SIZE / 2] != 0
    return [
        f"{max(height):.3f}", f"{max(worst):.3f}", f"{under.mean():.2%}", f"{np.median(np.abs(near)):.3f}",
        f"{np.percentile(np.abs(near), 99):.3f}", f"{near.min():+.2f}", f"{near.max():+.2f}",
        f"{(np.abs(near) > 0.2).mean():.3%}",
    ]  # fmt: skip


def beyond_terrain(ground: F64, x: F64, y: F64, scenario: str, seed: int) -> F64:
    """(rows, cols) how far the ground lies above (+) or below (-) all terrain in the cells at ``x``, ``y``."""
    terrain = _stage(load_scenario(scenario, ONE_VEHICLE), seed).world.terrain
    half = CELL_SIZE / 2
    heights = np.stack([terrain.height(x + a, y + b) for a in (-half, 0, half) for b in (-half, 0, half)])
    low, high = heights.min(axis=0), heights.max(axis=0)
    return np.where(ground > high, ground - high, np.minimum(ground - low, 0.0))


if __name__ == "__main__":
    main()
