"""Tables of a drive's bench, for the terminal and as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mapvote.evaluation.experiments.real.bench import Bench, unchanged_figures
from mapvote.evaluation.experiments.real.changes import precision_near, score
from mapvote.evaluation.experiments.real.street import largest_false_changes


@dataclass(frozen=True, slots=True)
class Sheet:
    """One table; the first column names the row."""

    title: str
    headings: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


def real_tables(bench: Bench, case: str) -> list[Sheet]:
    """The ground, the unchanged street and the largest of its false changes, and what was cast into the scans."""
    sheets = [_ground(bench), _unchanged(bench, case), _largest(bench, case), _changed(bench, case), _skipped(bench)]
    return [sheet for sheet in sheets if sheet.rows]


def as_markdown(sheets: list[Sheet], command: str) -> str:
    """A page of them, with the command that made it."""
    parts = [f"```\n{command}\n```"]
    for sheet in sheets:
        lines = [sheet.headings, tuple("---" for _ in sheet.headings), *sheet.rows]
        parts.append(f"**{sheet.title}**\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines))
    return "\n\n".join(parts) + "\n"


def _ground(bench: Bench) -> Sheet:
    g = bench.ground
    headings = ("sensor over ground, median", "worst off", "path off by > 0.3 m", "occupied under the driven line")
    row = f"{g.sensor_height_m:.3f} m", f"{g.worst_off_m:+.3f} m", f"{g.off_share:.1%}", f"{g.occupied_share:.1%}"
    return Sheet(f"{bench.name}, {bench.scans} scans: the ground", headings, [row])


def _unchanged(bench: Bench, case: str) -> Sheet:
    headings = (
        "run", "ballots", "cells determined", "% of them false", "movers included", "% of mapped cells false",
        "scans lost, %", "wrong by 0.5 m, %", "median error, m", "worst, m",
    )  # fmt: skip
    rows = []
    for name, run in bench.runs.items():
        f = unchanged_figures(run, case)
        if run.ballots == 0:
            rows.append((name, "0", *["-"] * 4, "100", *["-"] * 3))
            continue
        rows.append((
            name, str(run.ballots), f"{f['determined_cells']:.0f}", f"{100 * f['false_share']:.3f}",
            f"{100 * f['false_share_with_movers']:.3f}", f"{100 * f['false_share_of_mapped']:.3f}",
            f"{100 * f['lost_share']:.0f}", f"{100 * f['wrong_share']:.1f}", f"{f['median_error_m']:.3f}",
            f"{f['max_error_m']:.3f}",
        ))  # fmt: skip
    return Sheet(f"{bench.name}: nothing changed; cells that {case} decides as changed", headings, rows)


def _largest(bench: Bench, case: str) -> Sheet:
    rows = []
    if bench.runs:
        found = largest_false_changes(next(iter(bench.runs.values())), case, 5)
        rows = [(f.kind.replace("_", "-"), f"{f.x}, {f.y}", f"{f.m2}", "yes" if f.on_mover else "no") for f in found]
    headings = ("the largest of them in the first run", "x, y in the map, m", "m²", "where something moved")
    return Sheet(f"{bench.name}: the largest false changes", headings, rows)


def _changed(bench: Bench, case: str) -> Sheet:
    headings = ("thing", "asked", "found by half of its cells", "touched", "cell recall", "rays that met one in a scan")
    rows, said = [], []
    for name, (run, asked) in bench.changed.items():
        said.append(f"{precision_near(asked, run.states[case], run.street.grid):.2f} ({name})")
        for f in score(asked, run.states[case]):
            rows.append((f.kind, str(f.things), str(f.half), str(f.touched), f"{f.cell_recall:.2f}", f"{f.rays:.0f}"))
    title = f"{bench.name}: cast into the scans, {case}; precision within 1.5 m of them {', '.join(said)}"
    return Sheet(title, headings, rows)


def _skipped(bench: Bench) -> Sheet:
    return Sheet(f"{bench.name}: not run", ("run", "why"), [(name, why) for name, why in bench.skipped.items()])
