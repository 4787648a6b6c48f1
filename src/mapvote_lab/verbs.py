"""The verbs demo, simulate and evaluate. The entry point group ``mapvote.verbs`` adds them to the command line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from mapvote.cli.options import Config, Panel, Scenario, Seed
from mapvote.cli.terminal import progress, stages

if TYPE_CHECKING:
    from msgspec import Struct

    from mapvote.config import Settings
    from mapvote_lab.evaluation.tables import Sheet


LabSensor = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="vlp16, hdl32e, hdl64e, beams128, rosette70 or mems120; default: the scenario's"),
]


def register(app: typer.Typer) -> None:
    """Add demo, simulate and evaluate."""
    app.command(rich_help_panel=Panel.EVALUATE)(demo)
    app.command(rich_help_panel=Panel.EVALUATE)(simulate)
    app.command(rich_help_panel=Panel.EVALUATE)(evaluate)


def _need_lab(verb: str) -> None:
    """MapvoteError naming the extra if a package of the laboratory is missing."""
    from mapvote.core.extras import require

    for package in ("embreex", "matplotlib"):
        require(package, "lab", f"mapvote {verb}")


def simulate(
    scenario: Scenario,
    out: Annotated[Path, typer.Argument(metavar="FOLDER", help="what to write; it must not exist yet")],
    seed: Seed = 1,
    sensor: LabSensor = None,
) -> None:
    """Simulate a street before and after: survey drives, voting vehicles' drives, and the truth apart from them.

    mapvote simulate corner my_street --seed 2 --sensor rosette70
    """
    _need_lab("simulate")
    from mapvote_lab.simulation import simulate as run

    with progress(f"simulating {scenario}") as tell:
        run(scenario, out, seed, progress=tell, overrides={"sensor": sensor} if sensor else None)
    print(f"{out}: drives {', '.join(sorted(p.name for p in out.iterdir() if p.name != 'truth'))}; truth in truth/")


def evaluate(
    scenario: Scenario,
    drive: Annotated[
        Path | None,
        typer.Argument(
            metavar="DRIVE", help="after real: a recorded drive; after court: its folder", show_default=False
        ),
    ] = None,
    seed: Seed = 1,
    case: Annotated[
        str | None,
        typer.Option(
            metavar="CASES",
            help='1..5, "1 column", surfaces, yardsticks, by commas, or all [default: 1,2,3,4,5,surfaces]; '
            "real: one of them [default: by the settings]",
        ),
    ] = None,
    poses: Annotated[str, typer.Option(metavar="ndt|truth", help="poses by localisation, or the true ones")] = "ndt",
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="also write all numbers to this file")] = None,
    cache: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="where drives, maps and ballots are kept")
    ] = None,
    sensor: LabSensor = None,
    cars: Annotated[
        int | None, typer.Option(metavar="N", min=0, help="cars that park during one vehicle's pass only, for each")
    ] = None,
    reading: Annotated[
        str | None,
        typer.Option(metavar="KEY=VALUE,..", help="readings of the paper's open sentences: keys of [paper]"),
    ] = None,
    readings: Annotated[bool, typer.Option("--readings", help="every reading of the paper by case")] = False,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="real: where tables and pictures of the worst cells go"),
    ] = None,
    figures: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="also draw the paper's figures here: PNG, SVG and PDF")
    ] = None,
    scans: Annotated[
        str | None, typer.Option(metavar="SLICES", help="real: which scans of the drive: 0:300, say")
    ] = None,
    config: Config = None,
) -> None:
    """Simulate, map, vote, and score: Tables II to IV of the paper with its figures beside ours.

    Real data is "real", a recorded drive, or "court", a place at two times (docs/diff.md).

    mapvote evaluate corner --seed 2 --case 1,5,surfaces

    mapvote evaluate as_published --case 1,2,3,4,5 --readings

    mapvote evaluate real my_drive --out report

    mapvote evaluate court FOLDER
    """
    _need_lab("evaluate")
    from mapvote.config import load_settings

    if scenario in ("real", "court"):
        if drive is None:
            raise typer.BadParameter(f"name what to evaluate: mapvote evaluate {scenario} FOLDER", param_hint="DRIVE")
        if figures is not None:
            raise typer.BadParameter("--out draws the pictures of recorded scans", param_hint="--figures")
        if scenario == "real":
            _evaluate_real(drive, case, scans, seed, json, out, load_settings(config))
        else:
            _evaluate_court(drive, case, json, load_settings(config))
        return
    if drive is not None:
        raise typer.BadParameter(f"{drive}: only real and court take a folder", param_hint="DRIVE")
    if poses not in ("ndt", "truth"):
        raise typer.BadParameter(f"{poses!r}: choose ndt or truth", param_hint="--poses")
    from mapvote.config import cache_folder, load_with_sources
    from mapvote_lab.evaluation.cases import PUBLISHED, as_paper, choose_cases
    from mapvote_lab.evaluation.evaluate import evaluate as run
    from mapvote_lab.evaluation.scene import Scene
    from mapvote_lab.evaluation.tables import tables

    settings, sources = load_with_sources(config)
    settings = as_paper(settings, scenario, sources, reading)
    cases, with_yardsticks = choose_cases(settings, case)
    overrides: dict[str, str | int] = {"sensor": sensor} if sensor else {}
    if cars is not None:
        overrides["temporary_cars"] = cars
    sentences = "all" if readings else "occluded" if scenario == PUBLISHED else None
    scene = Scene(scenario, seed, settings, cache or cache_folder(), overrides, poses)
    with stages() as report:
        evaluation = run(scene, cases, with_yardsticks, report, sentences)
    _show(list(tables(evaluation.result)), evaluation.result, json)
    if figures is not None:
        from mapvote.plots import Format
        from mapvote_lab.evaluation.gallery import gallery

        with progress("drawing"):
            drawn = gallery(evaluation, evaluation.best, figures, get_args(Format))
        print(f"{figures}: {len(drawn)} figures, each as PNG, SVG and PDF")


def _show(sheets: Sequence[Sheet], result: Struct | Mapping[str, Any], json: Path | None) -> None:
    """Tables on the terminal; all numbers into the file ``json``, if one is wanted."""
    from rich.console import Console

    from mapvote.formats.atomic import write_whole
    from mapvote_lab.evaluation.scores import to_json

    for sheet in sheets:
        Console(width=140).print(sheet.to_rich())
    if json is not None:
        write_whole(json, to_json(result))
        print(f"{json}: all numbers")


def _evaluate_court(folder: Path, case: str | None, json: Path | None, settings: Settings) -> None:
    """The court's three sessions, as cast scans by ``case`` and as clouds."""
    from mapvote_lab.evaluation.cases import choose_cases
    from mapvote_lab.evaluation.court import Court, court_table, evaluate_court

    cases, _ = choose_cases(settings, case)
    with stages() as report:
        scores = evaluate_court(Court.read(folder), settings, cases, report)
    _show([court_table(scores)], {"scores": scores}, json)


def _evaluate_real(
    drive: Path,
    case: str | None,
    scans: str | None,
    seed: int,
    json: Path | None,
    out: Path | None,
    settings: Settings,
) -> None:
    """The bench of a recorded drive; its own blocks are map and vehicles, nothing is simulated but the changes.
    ``case``: one of them; None: by the settings."""
    from mapvote_lab.evaluation.cases import choose_cases
    from mapvote_lab.evaluation.real_bench import bench
    from mapvote_lab.evaluation.real_report import real_tables, write_report

    method = settings.voting.method
    cases, _ = choose_cases(settings, case or ("5" if method == "paper" else method))
    if len(cases) > 1:
        raise typer.BadParameter(f"{case}: a recorded drive is evaluated for one case at a time", param_hint="--case")
    with stages() as report:
        result = bench(drive, settings, cases, report, scans=scans, seed=seed)
    sheets = real_tables(result, cases[0].name)
    _show(sheets, result.figures(cases[0].name), json)
    if out is not None:
        chosen = "".join(f" --{name} {value}" for name, value in (("case", case), ("scans", scans)) if value)
        command = f"mapvote evaluate real {drive}{chosen} --seed {seed} --out {out}"
        for file in write_report(result, cases[0].name, sheets, command, out):
            print(f"{file}")


def demo(
    drive: Annotated[
        Path | None,
        typer.Argument(metavar="DRIVE", help="a recorded drive; else a street is simulated", show_default=False),
    ] = None,
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="where maps, tables, pictures and report.html go")] = Path(
        "out"
    ),
    full: Annotated[bool, typer.Option("--full", help="simulate 250 m of street: takes some minutes")] = False,
    keep: Annotated[bool, typer.Option("--keep", help="keep the simulated drives, the ballots and the store")] = False,
) -> None:
    """Build a map, let three vehicles vote, update the map, and report how good the update is.

    mapvote demo

    mapvote demo MY_DRIVE --out report
    """
    _need_lab("demo")
    from rich.console import Console
    from rich.markup import escape

    console = Console(soft_wrap=True, highlight=False)

    def show(picture: Path) -> None:
        console.print(f"first picture: {escape(str(picture))}")

    if drive is not None:
        if full or keep:
            raise typer.BadParameter("a recorded drive is not simulated: leave out --full and --keep")
        from mapvote_lab.evaluation.demo import demo_drive

        with stages() as report:
            lines = demo_drive(drive, out, report, show)
        for line in lines:
            print(line)
        return
    from mapvote_lab.processes import load_in, processes

    with processes(2) as helpers:
        load_in(helpers, 2, "mapvote_lab.simulation")  # while this process loads all the rest
        from mapvote_lab.evaluation.demo import CASE, commands, drives_sentence
        from mapvote_lab.evaluation.demo import demo as run

        with stages() as report:
            evaluation, story = run(out, helpers, full=full, keep=keep, progress=report, show=show)
    console.print("\n[bold]What changed[/]")
    for area, deleted, added in story.areas:
        console.print(f"  {area.name}: {area.objects} {area.kind}; {deleted} points deleted, {added} added")
    f1 = evaluation.result.cases[CASE].strict.macro_f1
    console.print(
        f"  in all {story.deleted} points deleted, {story.added} added; "
        f"{story.found} changed objects found, {len(story.objects.false_m2)} false; F1 {f1:.3f}"
    )
    console.print("\n[bold]Where to look[/]")
    place = escape(str(out))
    console.print(f"  {place}/report.html: the story with pictures and tables")
    console.print(f"  {place}/map_before.pcd and {place}/map_after.pcd: the maps")
    console.print(f"  {place}/tables.txt, results.json, pictures/")
    console.print(f"  {escape(drives_sentence(story, evaluation.scene.folder))}")
    console.print("\n[bold]Next steps[/]")
    text = commands(evaluation, out, story.kept)
    console.print(escape("".join(f"  {line}\n" for line in text.splitlines())))
