"""Tables of a drive's bench, for the terminal and as Markdown."""

from __future__ import annotations

from mapvote_lab.evaluation.experiments.real.bench import BUILT, BUILT_IN_RAIN, Bench, unchanged_figures
from mapvote_lab.evaluation.experiments.real.changes import FoundThings, precision_near, score
from mapvote_lab.evaluation.experiments.real.street import largest_false_changes
from mapvote_lab.evaluation.reporting.sheets import Sheet


def real_tables(bench: Bench, case: str) -> list[Sheet]:
    """The ground, the unchanged street, its poses and largest false changes, and what was cast into the scans."""
    unchanged = _unchanged(bench, case), _poses(bench, case), _largest(bench, case)
    sheets = [_ground(bench), *unchanged, _changed(bench, case), _in_rain(bench, case), _skipped(bench)]
    return [sheet for sheet in sheets if sheet.rows]


def as_markdown(sheets: list[Sheet], command: str) -> str:
    """A page of them, with the command that made it."""
    return "\n".join([f"```\n{command}\n```\n", *(sheet.to_markdown() for sheet in sheets)])


def _ground(bench: Bench) -> Sheet:
    g = bench.ground
    headings = ("sensor over ground", "worst off", "off by > 0.3 m", "occupied under the path")
    row = f"{g.sensor_height_m:.3f} m", f"{g.worst_off_m:+.3f} m", f"{g.off_share:.1%}", f"{g.occupied_share:.1%}"
    return Sheet(f"{bench.name}, {bench.scans} scans: the ground", headings, [row])


def _unchanged(bench: Bench, case: str) -> Sheet:
    headings = "run", "cells determined", "false, %", "with movers, %", "of mapped, %"
    rows = []
    for name, run in bench.runs.items():
        f = unchanged_figures(run, case)
        shares = (100 * f[key] for key in ("false_share", "false_share_with_movers", "false_share_of_mapped"))
        figures = f"{f['determined_cells']:.0f}", *(f"{share:.3f}" for share in shares)
        rows.append((name, *(figures if run.ballots else ["no ballot", *["-"] * 3])))
    return Sheet(f"{bench.name}: nothing changed; cells that {case} decides as changed", headings, rows)


def _poses(bench: Bench, case: str) -> Sheet:
    headings = "run", "ballots", "lost, %", "wrong, %", "median, m", "worst, m"
    rows = []
    for name, run in bench.runs.items():
        f = unchanged_figures(run, case)
        errors = f"{100 * f['wrong_share']:.1f}", f"{f['median_error_m']:.3f}", f"{f['max_error_m']:.3f}"
        seen = run.ballots > 0
        rows.append(
            (name, str(run.ballots), f"{100 * f['lost_share'] if seen else 100:.0f}", *(errors if seen else "---"))
        )
    return Sheet(
        f"{bench.name}: poses; scans that nobody could trust, those wrong by .5 m, and the rest", headings, rows
    )


def _largest(bench: Bench, case: str) -> Sheet:
    rows = []
    if bench.runs:
        found = largest_false_changes(next(iter(bench.runs.values())), case, 5)
        rows = [(f.kind.replace("_", "-"), f"{f.x}, {f.y}", f"{f.m2}", "yes" if f.on_mover else "no") for f in found]
    headings = ("in the first run", "x, y in the map, m", "m²", "where something moved")
    return Sheet(f"{bench.name}: the largest false changes", headings, rows)


def _changed(bench: Bench, case: str) -> Sheet:
    headings = ("thing", "asked", "half found", "touched", "cell recall", "rays a scan")
    rows, said = [], []
    for name in bench.changed:
        said.append(f"{_precision(bench, case, name):.2f} ({name})")
        for f in [] if name == BUILT_IN_RAIN else _found(bench, case, name):
            rows.append((f.kind, str(f.things), str(f.half), str(f.touched), f"{f.cell_recall:.2f}", f"{f.rays:.0f}"))
    title = f"{bench.name}: cast into the scans, {case}; precision within 1.5 m of them {', '.join(said)}"
    return Sheet(title, headings, rows)


def _in_rain(bench: Bench, case: str) -> Sheet:
    """Beside the dry run, which was asked for the same cells; no rows where it did not rain."""
    headings = ("thing", "asked", "half found", "in rain", "cell recall", "in rain")
    pairs = zip(_found(bench, case, BUILT), _found(bench, case, BUILT_IN_RAIN), strict=False)
    rows = [
        (dry.kind, str(dry.things), str(dry.half), str(wet.half), f"{dry.cell_recall:.2f}", f"{wet.cell_recall:.2f}")
        for dry, wet in pairs
    ]
    return Sheet(f"{bench.name}: {BUILT_IN_RAIN}, {case}, beside the dry run", headings, rows)


def _found(bench: Bench, case: str, name: str) -> list[FoundThings]:
    """By kind; nothing of a run that was not made."""
    if name not in bench.changed:
        return []
    run, asked = bench.changed[name]
    return score(asked, run.states[case])


def _precision(bench: Bench, case: str, name: str) -> float:
    run, asked = bench.changed[name]
    return precision_near(asked, run.states[case], run.street.grid)


def _skipped(bench: Bench) -> Sheet:
    return Sheet(f"{bench.name}: not run", ("run", "why"), [(name, why) for name, why in bench.skipped.items()])
