"""The offline server: ballots in files, the updated map in a folder (paper IV)."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapvote.cli.looks import sound_map
from mapvote.cli.options import MAP, Config, FalseDeletions, MapPath, MinVotes
from mapvote.cli.terminal import print_table, waiting

if TYPE_CHECKING:
    from mapvote.core.grid import Lattice, TileIndex
    from mapvote.core.types import U8
    from mapvote.fusion.fuse import Decision

_MOST_WAYPOINTS = 10


def register(app: typer.Typer) -> None:
    """Add the verb to ``app``."""
    app.command(rich_help_panel=MAP)(update)


def update(
    map_path: MapPath,
    ballot_files: Annotated[list[Path], typer.Argument(metavar="BALLOT...", help="ballots of one round")],
    out: Annotated[Path | None, typer.Option(metavar="MAP", help="the updated map to write, a folder")] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="decide and report, but write no map")] = False,
    cells: Annotated[Path | None, typer.Option(metavar="NPZ", help="also write the decided states of cells")] = None,
    min_votes: MinVotes = None,
    false_deletions: FalseDeletions = None,
    config: Config = None,
) -> None:
    """Fuse ballots offline and edit the map: add, delete, keep.

    A change needs a majority of the vehicles that determined the cell, and at least --min-votes of them. The default is
    that of the settings, or 1 for ballots of the paper's rule. With --false-deletions P a cell keeps its points, and is
    listed, while the probability that emptying it deletes something that stands is above P.

        mapvote update my_map car_1.ballot car_2.ballot --out my_map_updated
    """
    from mapvote.codec.ballot import decode
    from mapvote.config import load_with_sources
    from mapvote.core.types import MapvoteError
    from mapvote.formats import write_map
    from mapvote.fusion.fuse import states_over
    from mapvote.fusion.offline import update_map

    if out is None and not dry_run:
        raise MapvoteError("update: give --out MAP, or --dry-run to only report")
    ballots = []
    for file in ballot_files:
        try:
            ballots.append(decode(file.read_bytes()))
        except OSError as error:
            raise MapvoteError(f"{file}: cannot be read ({error.strerror})") from error
        except MapvoteError as error:
            raise MapvoteError(f"{file}: {error}") from error
    if false_deletions is not None and not 0.0 < false_deletions <= 1.0:
        raise MapvoteError(f"--false-deletions {false_deletions:g}: give a probability above 0, such as 0.01; 1: none")
    loaded, sources = load_with_sources(config)
    settings = loaded.fuse
    paper = bool(ballots) and ballots[0].method == "paper" and "fuse.min_votes" not in sources
    settings = settings.model_copy(
        update={
            "min_votes": min_votes or (1 if paper else settings.min_votes),
            "false_deletions": settings.false_deletions if false_deletions is None else false_deletions,
        }
    )
    with waiting(f"reading {map_path}"):
        before = sound_map(map_path)
    with waiting("deciding"):
        after, decisions = update_map(before, ballots, settings)
    if cells is not None:
        states, grid = states_over(before.lattice, decisions)
        _write_cells(cells, states, grid.x0, grid.y0)
    if out is not None and not dry_run:
        with waiting(f"writing {out}"):
            write_map(after, out)
    _report(decisions, len({ballot.vehicle for ballot in ballots}), settings.min_votes)
    _report_pending(decisions, before.lattice, settings.false_deletions)
    print(f"updated map: {out}" if out is not None and not dry_run else "dry run: no map written")


def _write_cells(path: Path, states: U8, x0: float, y0: float) -> None:
    """Decided states over the window of all ballots, written whole or not at all."""
    import numpy as np

    from mapvote.core.grid import CELL_SIZE
    from mapvote.formats.atomic import whole_file

    with whole_file(path) as part, part.open("wb") as file:
        np.savez_compressed(file, states=states, x0=x0, y0=y0, cell_size=CELL_SIZE)


def _copies(decisions: dict[TileIndex, Decision]) -> Counter[tuple[str, str]]:
    """On how many tiles a vehicle's drive is a copy of another's, by the two."""
    return Counter((copy.vehicle, copy.heard_vehicle) for d in decisions.values() for copy in d.copies)


def _report(decisions: dict[TileIndex, Decision], vehicles: int, min_votes: int) -> None:
    from mapvote.core.types import CellState

    rows = []
    for index, d in decisions.items():
        occupied = int((d.states == CellState.CHANGED_OCCUPIED).sum())
        empty = int((d.states == CellState.CHANGED_EMPTY).sum())
        if occupied or empty:
            rows.append((f"{index[0]},{index[1]}", *map(str, (d.vehicles, occupied, empty, d.added, d.deleted))))
    if rows:
        headings = "vehicles", "changed-occupied cells", "changed-empty cells", "points added", "points deleted"
        print_table(("tile", *headings), rows)
    added, deleted = sum(d.added for d in decisions.values()), sum(d.deleted for d in decisions.values())
    print(f"{vehicles} vehicles, {len(decisions)} tiles: {added} points added, {deleted} deleted")
    for (vehicle, heard), tiles in sorted(_copies(decisions).items()):
        where = f"{tiles} tile{'s' if tiles > 1 else ''}"
        print(f"{vehicle} sent a copy of {heard}'s ballot, on {where}: the two count as one vehicle there")
    if vehicles < min_votes:
        print(f"A change needs {min_votes} vehicles and {vehicles} voted, so nothing can change: --min-votes 1")


def _report_pending(decisions: dict[TileIndex, Decision], lattice: Lattice, budget: float) -> None:
    """Deletions that wait, the largest first, and where somebody should drive by."""
    from mapvote.fusion.loss_budget import waypoints

    waiting = waypoints({index: d.pending for index, d in decisions.items()}, lattice)
    if not waiting:
        return
    cells = sum(point.cells for point in waiting)
    keep = "1 cell keeps its" if cells == 1 else f"{cells} cells keep their"
    print(f"{keep} points: that something there still stands is likelier than {budget:g}. Drive by:")
    rows = [(f"{p.x:.1f}, {p.y:.1f}", str(p.cells), f"{p.probability:.2g}") for p in waiting[:_MOST_WAYPOINTS]]
    print_table(("x, y (map metres)", "cells", "likeliest"), rows)
    if len(waiting) > _MOST_WAYPOINTS:
        print(f"and {len(waiting) - _MOST_WAYPOINTS} smaller ones")
