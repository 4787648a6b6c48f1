"""Tables and pictures of a drive's bench."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from mapvote.core.reference import reference_window
from mapvote.core.types import F64, CellState
from mapvote.formats.atomic import write_whole
from mapvote.plots import STATE_COLOURS, Colour, save
from mapvote_lab.evaluation.real_bench import (
    Asked,
    Bench,
    ChangedRun,
    FoundThings,
    precision_near,
    score,
)
from mapvote_lab.evaluation.real_street import FalseChange, RealRun, is_changed, largest_false_changes
from mapvote_lab.evaluation.tables import Sheet


def real_tables(bench: Bench, case: str) -> list[Sheet]:
    """The ground, the unchanged street, its poses and largest false changes, and what was cast into the scans."""
    unchanged = _unchanged(bench, case), _poses(bench, case), _largest(bench, case)
    skipped = Sheet(f"{bench.name}: not run", ("run", "why"), list(bench.skipped.items()))
    sheets = [_ground(bench), *unchanged, _changed(bench, case), _in_rain(bench, case), skipped]
    return [sheet for sheet in sheets if sheet.rows]


def write_report(bench: Bench, case: str, sheets: list[Sheet], command: str, folder: Path) -> list[Path]:
    """tables.md, a page of the ``sheets`` with the ``command`` that made them, and pictures of the worst cells."""
    pictures = draw_worst(bench, case, folder)
    text = "\n".join([f"```\n{command}\n```\n", *(sheet.to_markdown() for sheet in sheets)])
    write_whole(folder / "tables.md", text)
    return [folder / "tables.md", *pictures]


def _ground(bench: Bench) -> Sheet:
    g = bench.ground
    headings = ("sensor over ground", "worst off", "off by > 0.3 m", "occupied under the path")
    row = f"{g.sensor_height_m:.3f} m", f"{g.worst_off_m:+.3f} m", f"{g.off_share:.1%}", f"{g.occupied_share:.1%}"
    return Sheet(f"{bench.name}, {bench.scans} scans: the ground", headings, [row])


def _unchanged(bench: Bench, case: str) -> Sheet:
    headings = "run", "cells determined", "false, %", "with movers, %", "of mapped, %"
    rows = []
    for name, run in bench.runs.items():
        f = run.figures(case)
        shares = (100 * f[key] for key in ("false_share", "false_share_with_movers", "false_share_of_mapped"))
        figures = f"{f['determined_cells']:.0f}", *(f"{share:.3f}" for share in shares)
        rows.append((name, *(figures if run.ballots else ["no ballot", *["-"] * 3])))
    return Sheet(f"{bench.name}: nothing changed; cells that {case} decides as changed", headings, rows)


def _poses(bench: Bench, case: str) -> Sheet:
    headings = "run", "ballots", "lost, %", "wrong, %", "median, m", "worst, m"
    rows = []
    for name, run in bench.runs.items():
        f = run.figures(case)
        errors = f"{100 * f['wrong_share']:.1f}", f"{f['median_error_m']:.3f}", f"{f['max_error_m']:.3f}"
        seen = run.ballots > 0
        rows.append(
            (name, str(run.ballots), f"{100 * f['lost_share'] if seen else 100:.0f}", *(errors if seen else "---"))
        )
    return Sheet(f"{bench.name}: poses: scans without a sure place, scans wrong by .5 m, and the rest", headings, rows)


def _largest(bench: Bench, case: str) -> Sheet:
    rows = []
    if bench.runs:
        changes = largest_false_changes(next(iter(bench.runs.values())), case, 5)
        rows = [(f.kind.replace("_", "-"), f"{f.x}, {f.y}", f"{f.m2}", "yes" if f.on_mover else "no") for f in changes]
    headings = ("in the first run", "x, y in the map, m", "m²", "where something moved")
    return Sheet(f"{bench.name}: the largest false changes", headings, rows)


def _changed(bench: Bench, case: str) -> Sheet:
    headings = ("thing", "asked", "half found", "touched", "cell recall", "rays a scan")
    rows = []
    said = []
    for name, (run, bodies) in bench.changed.items():
        said.append(f"{precision_near(bodies, run.states[case], run.street.grid):.2f} ({name})")
        for f in [] if name == ChangedRun.BUILT_IN_RAIN else _found(bench, case, name):
            rows.append((f.kind, str(f.things), str(f.half), str(f.touched), f"{f.cell_recall:.2f}", f"{f.rays:.0f}"))
    title = f"{bench.name}: cast into the scans, {case}; precision within 1.5 m of them {', '.join(said)}"
    return Sheet(title, headings, rows)


def _in_rain(bench: Bench, case: str) -> Sheet:
    """Beside the dry run, which was asked for the same cells; no rows where it did not rain."""
    headings = ("thing", "asked", "half found", "in rain", "cell recall", "in rain")
    pairs = zip(_found(bench, case, ChangedRun.BUILT), _found(bench, case, ChangedRun.BUILT_IN_RAIN), strict=False)
    rows = [
        (dry.kind, str(dry.things), str(dry.half), str(wet.half), f"{dry.cell_recall:.2f}", f"{wet.cell_recall:.2f}")
        for dry, wet in pairs
    ]
    return Sheet(f"{bench.name}: {ChangedRun.BUILT_IN_RAIN}, {case}, beside the dry run", headings, rows)


def _found(bench: Bench, case: str, name: str) -> list[FoundThings]:
    """Found things by kind; empty for a run that was not made."""
    if name not in bench.changed:
        return []
    run, bodies = bench.changed[name]
    return score(bodies, run.states[case])


Spot = tuple[float, float, str]
"""x, y (map metres) and title of a close-up."""


def draw_worst(bench: Bench, case: str, folder: Path) -> list[Path]:
    """Pictures into ``folder``: false changes of the run with most of them, and what was cast into the scans."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []

    def file_of(name: str) -> Path:
        return folder / f"{name.replace(' ', '_').replace(',', '').replace('%', 'percent')}.png"

    if bench.runs:
        worst = max(bench.runs, key=lambda name: bench.runs[name].changed_share(case, with_movers=False))
        for name in dict.fromkeys([next(iter(bench.runs)), worst]):
            run = bench.runs[name]
            written.append(file_of(f"false {name}"))
            draw_false_changes(run, case, largest_false_changes(run, case), written[-1])
    for name, (run, bodies) in bench.changed.items():
        written.append(file_of(name))
        draw_things(run, case, bodies, written[-1])
    return written


def draw_false_changes(run: RealRun, case: str, changes: Sequence[FalseChange], path: Path) -> None:
    """The whole street from above, and a close-up of each false change: map height grey, decided changes in colour."""
    picture = _street(run)
    for state in (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY):
        picture[run.states[case] == state] = to_rgb(STATE_COLOURS[state])
    spots = [(f.x, f.y, f"{f.m2:.1f} m²{', mover' if f.on_mover else ''}") for f in changes[:10]]
    _draw(run, picture, f"{case}: nothing changed; red = decided new, blue = decided gone", spots, path)


def draw_things(run: RealRun, case: str, bodies: Sequence[Asked], path: Path, most: int = 20) -> None:
    """The whole street, and close-ups of at most ``most`` things, the least found first: found, missed, false."""
    picture = _street(run)
    states = run.states[case]
    picture[is_changed(states)] = to_rgb(Colour.INK)
    share = []
    spots = []
    x, y = run.street.grid.centres()
    for a in bodies:
        picture[a.cells] = to_rgb(Colour.UNSURE)
        picture[a.cells & (states == a.state)] = to_rgb(
            Colour.NEW if a.state == CellState.CHANGED_OCCUPIED else Colour.GONE
        )
        if a.cells.any():
            rows, cols = np.nonzero(a.cells)
            share.append(float((states[a.cells] == a.state).mean()))
            spots.append((float(x[cols].mean()), float(y[rows].mean()), f"{a.kind}: {share[-1]:.0%}"))
    worst = [spots[k] for k in np.argsort(share, kind="stable")[:most]]
    title = f"{case}: red = new and found, blue = gone and found, yellow = missed, black = false"
    _draw(run, picture, title, worst, path)


def _street(run: RealRun) -> F64:
    """(rows, cols, 3): the height of the map's points in grey."""
    reference = reference_window(run.street.point_map, run.street.grid)
    height = np.where(np.isfinite(reference.top_z), reference.top_z - reference.ground_z, 0.0).clip(0.0, 6.0)
    picture: F64 = np.repeat((1.0 - 0.5 * height / 6.0)[..., None], 3, axis=-1)
    picture[(height > 0) & (height < 0.6)] = 0.9
    return picture


def _draw(run: RealRun, picture: F64, title: str, spots: Sequence[Spot], path: Path, half_m: float = 8.0) -> None:
    """The whole, and under it close-ups of twice ``half_m``, five to a row."""
    # The whole street above, a row for every five close-ups below.
    grid = run.street.grid
    extent = (grid.x0, grid.x0 + 0.3 * grid.cols, grid.y0, grid.y0 + 0.3 * grid.rows)
    rows = [[str(k + i) for i in range(5)] for k in range(0, len(spots), 5)]
    figure = Figure(figsize=(15, 9 + 2.8 * len(rows)), layout="constrained")
    heights = [9.0 / 2.8, *[1.0] * len(rows)]
    axes: Any = figure.subplot_mosaic([["all"] * 5, *rows], height_ratios=heights)
    axes["all"].imshow(picture, origin="lower", extent=extent)
    axes["all"].set_xlabel("east, m")
    axes["all"].set_ylabel("north, m")
    axes["all"].set_title(f"{run.street.recording.path.resolve().name}, {title}")
    # Each close-up has the number of its place in the whole.
    for k in range(5 * len(rows)):
        ax = axes[str(k)]
        if k >= len(spots):
            ax.axis("off")
            continue
        x, y, name = spots[k]
        axes["all"].annotate(str(k + 1), (x, y), fontsize=12, weight="bold")
        ax.imshow(picture, origin="lower", extent=extent, interpolation="nearest")
        ax.set_xlim(x - half_m, x + half_m)
        ax.set_ylim(y - half_m, y + half_m)
        ax.set_title(f"{k + 1}: {name}", fontsize=10)
    save(figure, path)
