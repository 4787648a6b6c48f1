"""Tables of a drive's bench."""

from __future__ import annotations

from rich.table import Table

from mapvote.evaluation.experiments.real.bench import Bench, unchanged_figures
from mapvote.evaluation.experiments.real.changes import precision_near, score


def real_tables(bench: Bench, case: str) -> list[Table]:
    """The ground, the unchanged street, and what was cast into the scans."""
    return [_ground(bench), _unchanged(bench, case), _changed(bench, case)]


def _ground(bench: Bench) -> Table:
    g = bench.ground
    table = Table("sensor over ground, median", "worst off", "path off by > 0.3 m", "occupied under the driven line")
    table.title = f"{bench.name}: the ground"
    table.add_row(
        f"{g.sensor_height_m:.3f} m", f"{g.worst_off_m:+.3f} m", f"{g.off_share:.1%}", f"{g.occupied_share:.1%}"
    )
    return table


def _unchanged(bench: Bench, case: str) -> Table:
    table = Table(title=f"{bench.name}: nothing changed, {case}; cells decided as changed, %")
    table.add_column("run")
    for heading in (
        "of determined cells", "movers included", "of mapped cells", "scans lost, %", "wrong by 0.5 m, %",
        "median error, m", "worst, m",
    ):  # fmt: skip
        table.add_column(heading, justify="right")
    for name, run in bench.runs.items():
        f = unchanged_figures(run, case)
        table.add_row(
            name, f"{100 * f['false_share']:.3f}", f"{100 * f['false_share_with_movers']:.3f}",
            f"{100 * f['false_share_of_mapped']:.3f}", f"{100 * f['lost_share']:.0f}", f"{100 * f['wrong_share']:.1f}",
            f"{f['median_error_m']:.3f}", f"{f['max_error_m']:.3f}",
        )  # fmt: skip
    for name, why in bench.skipped.items():
        table.add_row(name, f"skipped: {why}")
    return table


def _changed(bench: Bench, case: str) -> Table:
    table = Table(title=f"{bench.name}: cast into the scans, {case}")
    table.add_column("thing")
    for heading in ("met by rays", "found by half of its cells", "touched", "cell recall", "precision within 1.5 m"):
        table.add_column(heading, justify="right")
    for run, asked in bench.changed.values():
        near = precision_near(asked, run.states[case], run.street.grid)
        for f in score(asked, run.states[case]):
            table.add_row(f.kind, str(f.things), str(f.half), str(f.touched), f"{f.cell_recall:.2f}", f"{near:.2f}")
        table.add_section()
    return table
