"""Buildings built and demolished on a real street: objects injected into the map of KITTI drive 0001 (docs/results.md).

    python benchmarks/injected.py [--data ../shared/data/kitti] [--out out/injected]

Three random draws of ten built and ten demolished objects; recall, objects half found, precision within 1.5 m: mean and
worst over the draws, case by case. Draws the first draw's decisions of columns.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from mapvote.config import Settings
from mapvote.core.columns import GROUND_MARGIN_M, reference_window
from mapvote.core.geometry import transform
from mapvote.core.types import I64, Bool, Reference
from mapvote.evaluation import figures, style
from mapvote.evaluation.cases import choose_cases
from mapvote.evaluation.injection import choose_objects, inject, score_injection
from mapvote.evaluation.real import RealRun, run_real, split
from mapvote.formats import open_drive
from mapvote.perception.visibility import see

CASES = "1,5,1 column,columns"
DRAWS, OBJECTS = 3, 10


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("../shared/data/kitti"))
    parser.add_argument("--out", type=Path, default=Path("out/injected"))
    arguments = parser.parse_args()
    folder, settings = arguments.data / "2011_09_26_0001", Settings()
    cases, _ = choose_cases(settings, CASES)
    plain = run_real(folder, cases, settings)
    reference = reference_window(plain.point_map, plain.grid)
    shown, passed = what_drives_show(folder, plain, reference)
    scores: dict[str, list[dict[str, float]]] = {case.name: [] for case in cases}
    for draw in range(DRAWS):
        objects = choose_objects(reference, shown, passed & ~plain.movers, OBJECTS, np.random.default_rng(draw))
        run = run_real(folder, cases, settings, edit=lambda m, objects=objects: inject(m, reference, objects))  # type: ignore[misc]
        for case in cases:
            scores[case.name].append(score_injection(run.states[case.name], objects, shown))
        if draw == 0:
            outlines = [(o.kind, corners(o.cells, run)) for o in objects]
            panels = [(name, run.states[name]) for name in ("1", "columns")]
            arguments.out.mkdir(parents=True, exist_ok=True)
            style.save(figures.cell_states(panels, run.grid, outlines=outlines), arguments.out / "injected.png")
    Console(width=150).print(summary(scores))


def what_drives_show(folder: Path, run: RealRun, reference: Reference) -> tuple[I64, Bool]:
    """(above-ground points of all vehicles per cell, cells that a ray passed), at the poses that the vehicles found."""
    grid = run.grid
    shown, passed = np.zeros(grid.shape, dtype=np.int64), np.zeros(grid.shape, dtype=np.bool_)
    _, voting = split(len(open_drive(folder)), 12)
    for scans, report in zip(voting, run.reports, strict=True):
        for i, scan in enumerate(open_drive(folder, scans=scans)):
            points, origin = transform(report.T_map_lidar[i], scan.points), report.T_map_lidar[i][:3, 3]
            rows, cols, inside = grid.indices_of(points)
            height = points[:, 2] - reference.ground_z[rows.clip(0, grid.rows - 1), cols.clip(0, grid.cols - 1)]
            above = inside & (height >= GROUND_MARGIN_M)
            np.add.at(shown, (rows[above], cols[above]), 1)
            passed |= see(points, origin, above, np.zeros(len(points), np.bool_), reference).passed != 0
    return shown, passed


def corners(cells: Bool, run: RealRun) -> np.ndarray:
    """The rectangle around an object's cells, map metres."""
    rows, cols = np.nonzero(cells)
    x, y = run.grid.centres()
    low, high = (x[cols.min()], y[rows.min()]), (x[cols.max()], y[rows.max()])
    return np.array([low, (high[0], low[1]), high, (low[0], high[1])])


def summary(scores: dict[str, list[dict[str, float]]]) -> Table:
    keys = [f"{kind}_{what}" for kind in ("built", "demolished") for what in ("recall", "half_found", "precision")]
    table = Table(
        "case", *(key.replace("_", " ") for key in keys), title="Injected objects: mean (worst) of three draws"
    )
    for name, draws in scores.items():
        table.add_row(name, *(f"{np.mean([d[k] for d in draws]):.3f} ({min(d[k] for d in draws):.3f})" for k in keys))
    objects = [draw["built_objects"] + draw["demolished_objects"] for draw in next(iter(scores.values()))]
    table.caption = f"objects a draw: {objects}"
    return table


if __name__ == "__main__":
    main()
