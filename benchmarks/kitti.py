"""A real street that did not change: KITTI drives against the map of their own other blocks (docs/results.md).

    python benchmarks/kitti.py [--data ../shared/data/kitti] [--out out/kitti]

Prints localisation errors and false changes for the prior as given, disturbed by 0.5 m / 2 deg, and with nothing but
the first pose; for 64 beams and every other one of them. Then changes injected into the map of drive 0001, found or
not. Draws the ten largest false changes, and the injected objects of the first draw.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from mapvote.config import Settings
from mapvote.evaluation.experiments.cases import Case, choose_cases
from mapvote.evaluation.experiments.inject import Injection, score_injection
from mapvote.evaluation.experiments.real_drive import RealRun, as_given, disturbed, largest_false_changes, run_real
from mapvote.evaluation.reporting.real_figures import draw_false_changes, draw_injections
from mapvote.formats import read_T_map_lidar

DRAWS = (1, 2, 3)
CASES = "1,1 column,5,columns"
STREET, ROUNDABOUT = "2011_09_26_0001", "2011_09_26_0005"
RUNS: dict[str, tuple[str, dict[str, Any]]] = {
    "prior as given": (STREET, {"change_prior": as_given}),
    "prior disturbed 0.5 m / 2 deg": (STREET, {"change_prior": disturbed}),
    "first pose only": (STREET, {"first_pose_only": True}),
    "prior as given, 32 beams": (STREET, {"thin": True}),
    "prior disturbed, 32 beams": (STREET, {"change_prior": disturbed, "thin": True}),
    "0005, prior as given": (ROUNDABOUT, {"change_prior": as_given}),
    "0005, prior as given, 32 beams": (ROUNDABOUT, {"thin": True}),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("../shared/data/kitti"))
    parser.add_argument("--out", type=Path, default=Path("out/kitti"))
    parser.add_argument("--block", type=int, default=12, help="scans in a block (default 12)")
    arguments = parser.parse_args()
    settings, console = Settings(), Console(width=150)
    cases, _ = choose_cases(settings, CASES)
    runs = {
        name: run_real(arguments.data / drive, cases, settings, block=arguments.block, **options)
        for name, (drive, options) in RUNS.items()
    }
    console.print(localisation(runs))
    console.print(false_changes(runs, [case.name for case in cases]))
    arguments.out.mkdir(parents=True, exist_ok=True)
    drawn = injected(arguments.data / STREET, cases, settings, arguments.block)
    console.print(injections(drawn, cases))
    draw_injections(drawn[0][1], "columns", drawn[0][0], arguments.out / "injected_columns.png")
    run = runs["prior as given"]
    for case in ("1", "columns"):
        found = largest_false_changes(run, case)
        table = Table("class", "x, m", "y, m", "m2", "on a mover", title=f"Ten largest false changes, {case}")
        for item in found:
            mover = "yes" if item.on_mover else "no"
            table.add_row(item.kind, f"{item.x:.1f}", f"{item.y:.1f}", f"{item.m2:.2f}", mover)
        console.print(table)
        draw_false_changes(run, case, found, arguments.out / f"false_changes_{case}.png")


def injected(folder: Path, cases: list[Case], settings: Settings, block: int) -> list[tuple[Injection, RealRun]]:
    """Ten objects cut out of the map and ten phantoms put in, in each of three random draws."""
    path_xy = read_T_map_lidar(folder / "prior.txt", folder)[:, :2, 3]
    drawn = []
    for seed in DRAWS:
        injection = Injection(seed, path_xy)
        drawn.append((injection, run_real(folder, cases, settings, block=block, edit=injection)))
    return drawn


def injections(drawn: list[tuple[Injection, RealRun]], cases: list[Case]) -> Table:
    table = Table(
        "case", "kind", "cell recall", "objects half found", "recall of every cut cell", "precision within 1.5 m",
        title=f"Injected changes, draws {DRAWS}, pooled",
    )  # fmt: skip
    for case in cases:
        for kind in ("built", "demolished"):
            scores = [score_injection(injection, run.states[case.name], kind, run.reached) for injection, run in drawn]
            table.add_row(
                case.name, kind, _spread([s.cell_recall for s in scores]),
                f"{sum(s.found for s in scores)} of {sum(s.objects for s in scores)}",
                _spread([s.recall_of_all for s in scores]),
                _spread([s.precision_near for s in scores]),
            )  # fmt: skip
    return table


def _spread(values: list[float]) -> str:
    return f"{np.mean(values):.3f} ({min(values):.3f} to {max(values):.3f})"


def localisation(runs: dict[str, RealRun]) -> Table:
    table = Table(
        "run", "scans", "lost", "median, m", "99 %, m", "max, m", "median, deg", "prior's median, m",
        title="Localisation against poses.txt, the map's trajectory rigidly aligned to it",
    )  # fmt: skip
    for name, run in runs.items():
        table.add_row(
            name, str(run.scans), str(run.scans - len(run.error_m)), f"{np.median(run.error_m):.3f}",
            f"{np.percentile(run.error_m, 99):.3f}", f"{run.error_m.max():.3f}", f"{np.median(run.error_deg):.3f}",
            f"{np.median(run.prior_error_m):.3f}",
        )  # fmt: skip
    return table


def false_changes(runs: dict[str, RealRun], cases: list[str]) -> Table:
    table = Table("run", title="Determined cells decided as changed, % (movers apart / movers included)")
    for case in cases:
        table.add_column(case, justify="right")
    for name, run in runs.items():
        shares = [
            f"{100 * run.changed_share(c, with_movers=False):.3f} / {100 * run.changed_share(c, with_movers=True):.3f}"
            for c in cases
        ]
        table.add_row(name, *shares)
    return table


if __name__ == "__main__":
    main()
