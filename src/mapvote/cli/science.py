"""Verbs of the simulator and the evaluation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add simulate."""
    app.command()(simulate)


def simulate(
    scenario: Annotated[str, typer.Argument(help="paper, street, junction, corner, or a .toml file")],
    out: Annotated[Path, typer.Argument(help="folder to write; it must not exist")],
    seed: Annotated[int, typer.Option(help="layout, clutter, traffic and noise")] = 1,
) -> None:
    """Simulate a street before and after: survey drives, voting vehicles' drives, and the truth apart from them."""
    from rich.progress import Progress

    from mapvote.simulation import simulate as run

    with Progress(transient=True) as bar:
        task = bar.add_task(f"simulating {scenario}", total=None)
        run(scenario, out, seed, progress=lambda done, total: bar.update(task, completed=done, total=total))
    typer.echo(
        f"{out}: drives {', '.join(sorted(p.name for p in out.iterdir() if p.name != 'truth'))}; truth in truth/"
    )
