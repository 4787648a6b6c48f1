"""Verbs of the simulator and the evaluation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapvote.cli.options import Config

if TYPE_CHECKING:
    from rich.progress import TaskID


def register(app: typer.Typer) -> None:
    """Add demo, simulate and evaluate."""
    app.command()(demo)
    app.command()(simulate)
    app.command()(evaluate)


def simulate(
    scenario: Annotated[str, typer.Argument(help="paper, clear, street, junction, corner, or a .toml file")],
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


def evaluate(
    scenario: Annotated[str, typer.Argument(help="paper, clear, street, junction, corner, or a .toml file")],
    seed: Annotated[int, typer.Option(help="layout, clutter, traffic and noise")] = 1,
    case: Annotated[
        str, typer.Option(help='1..5, "1 column", columns, yardsticks, several by commas, or all')
    ] = "1,2,3,4,5,columns",
    poses: Annotated[str, typer.Option(help="ndt: the vehicles localise; truth: they are told where they are")] = "ndt",
    json: Annotated[Path | None, typer.Option(help="write all numbers to this file")] = None,
    cache: Annotated[Path | None, typer.Option(help="where drives, maps and ballots are kept")] = None,
    sensor: Annotated[str | None, typer.Option(help="vlp16, hdl32e or hdl64e instead of the scenario's")] = None,
    config: Config = None,
) -> None:
    """Simulate, map, vote, and score: Tables II to IV of the paper with its figures beside ours."""
    from rich.console import Console

    from mapvote.config import load_settings
    from mapvote.evaluation.evaluate import evaluate as run
    from mapvote.evaluation.experiments.cases import choose_cases
    from mapvote.evaluation.experiments.conditions import Conditions
    from mapvote.evaluation.experiments.scene import Scene, default_cache
    from mapvote.evaluation.reporting.tables import as_json, tables, write_text

    if poses not in ("ndt", "truth"):
        raise typer.BadParameter(f"{poses!r}: choose ndt or truth", param_hint="--poses")
    settings = load_settings(config)
    cases, with_yardsticks = choose_cases(settings, case)
    overrides = {"sensor": sensor} if sensor else {}
    scene = Scene(
        scenario, seed, settings, cache or default_cache(), overrides, Conditions(true_poses=poses == "truth")
    )
    with _stages() as told:
        result = run(scene, cases, with_yardsticks, told).result
    for table in tables(result):
        Console(width=140).print(table)
    if json is not None:
        write_text(as_json(result), json)
        typer.echo(f"{json}: all numbers")


@contextmanager
def _stages() -> Iterator[Callable[[str, int, int], None]]:
    """A progress bar for each stage as it begins; the first run also compiles, which the first bar says."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = TextColumn("{task.description:<24}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns) as bar:
        tasks: dict[str, TaskID] = {}

        def told(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total)
            bar.update(tasks[stage], completed=done, total=total)

        yield told


def demo(
    out: Annotated[Path, typer.Option(help="folder for maps, tables, pictures and report.html")] = Path("out"),
    quick: Annotated[
        bool, typer.Option("--quick", help="a street corner instead of a street: a minute at most")
    ] = False,
) -> None:
    """The whole story on a simulated street: build a map, let three vehicles vote, update it, tell how good it is."""
    from rich.console import Console

    from mapvote.evaluation.demo import CASE, commands
    from mapvote.evaluation.demo import demo as run

    console = Console(soft_wrap=True)
    console.print("The first run compiles its kernels, which takes some seconds in each stage.", style="dim")
    with _stages() as told:
        evaluation, story = run(out, quick, told)
    console.print("\n[bold]What changed[/]", highlight=False)
    for area, deleted, added in story.areas:
        console.print(
            f"  {area.name}: {area.objects} {area.kind}; {deleted} points deleted, {added} added", highlight=False
        )
    f1 = evaluation.result["cases"][CASE]["strict"]["macro_f1"]
    console.print(
        f"  in all {story.deleted} points deleted, {story.added} added; "
        f"{story.found} of {story.objects} changed objects found, {story.false_objects} false; F1 {f1:.3f}",
        highlight=False,
    )
    console.print("\n[bold]Where to look[/]")
    console.print(f"  {out / 'report.html'}: the story with pictures and tables", highlight=False)
    console.print(f"  {out / 'map_before.pcd'} and {out / 'map_after.pcd'}: the maps", highlight=False)
    console.print(f"  {out / 'tables.txt'}, results.json, results.csv, pictures/", highlight=False)
    console.print("\n[bold]What to try next[/]")
    console.print("".join(f"  {line}\n" for line in commands(evaluation, out).splitlines()), highlight=False)
