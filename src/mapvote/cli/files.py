"""The verbs for files: info, export, import, doctor, config."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapvote.cli.options import Config, Mount, Prior, Rate, Scans, SensorName, Topic

if TYPE_CHECKING:
    from mapvote.formats.doctor import Finding


def register(app: typer.Typer) -> None:
    app.command()(info)
    app.command()(doctor)
    app.command("import")(import_map)
    app.command()(export)
    app.command()(config)


def info(
    path: Annotated[Path, typer.Argument(help="a map, a drive or a ballot, in any format")],
    rate: Rate = None,
    topic: Topic = None,
) -> None:
    """Say what is in this file or folder."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from mapvote.formats.describe import describe

    title, rows = describe(path, rate_hz=rate, topic=topic)
    table = Table(show_header=False)
    table.add_column(style="cyan", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in rows:
        table.add_row(escape(name), escape(value))
    console = Console(highlight=False)
    console.print(f"[bold]{escape(str(path))}: {title}[/]", soft_wrap=True)
    console.print(table)


def doctor(
    drive: Annotated[Path, typer.Argument(help="a drive, in any format", metavar="DRIVE")],
    map_path: Annotated[Path | None, typer.Option("--map", help="also say whether the drive lies on this map")] = None,
    scans: Scans = None,
    prior: Prior = None,
    rate: Rate = None,
    sensor: SensorName = None,
    mount: Mount = None,
    topic: Topic = None,
) -> None:
    """Say what is wrong with a drive and how to mend it. Exit code 1 if it cannot be used as it is."""
    from rich.console import Console

    from mapvote.formats import read_map
    from mapvote.formats.doctor import examine
    from mapvote.formats.drives.options import DriveOptions

    options = DriveOptions(scans, prior, rate, sensor, None, mount, topic)
    findings = examine(drive, options, None if map_path is None else read_map(map_path))
    console = Console(soft_wrap=True, highlight=False)
    for finding in findings:
        for line in _lines(finding):
            console.print(line)
    errors = sum(f.severity == "error" for f in findings)
    warnings = sum(f.severity == "warning" for f in findings)
    console.print(f"{drive}: {errors} errors, {warnings} warnings" if errors or warnings else f"{drive}: sound")
    if errors:
        raise typer.Exit(1)


def _lines(finding: Finding) -> list[str]:
    from rich.markup import escape

    colour = {"error": "bold red", "warning": "yellow", "note": "dim"}[finding.severity]
    what = f"[{colour}]{finding.severity}[/] {escape(finding.what)}"
    return [what, f"      [green]mend[/] {escape(finding.mend)}"] if finding.mend else [what]


def import_map(
    source: Annotated[Path, typer.Argument(help="PCD, LAS, LAZ or PLY file, or Autoware folder", metavar="FILE")],
    out: Annotated[Path, typer.Option(help="the mapvote map folder to write")],
) -> None:
    """Make a mapvote map of somebody's point cloud: cut into tiles, ground measured. Says what it drops."""
    from mapvote.formats import read_cloud, write_map
    from mapvote.formats.maps.cloud import to_map

    cloud = read_cloud(source)
    point_map = to_map(str(source), cloud)
    write_map(point_map, out)
    kept = sum(len(t.points) for t in point_map.tiles.values())
    typer.echo(f"{out}: {kept} points in {len(point_map.tiles)} tiles, map {point_map.map_id}")
    if cloud.dropped:
        typer.echo(f"dropped: {', '.join(cloud.dropped)} (a mapvote map keeps positions only)")
    typer.echo("known-free columns: none yet; the fleet's drives will teach them")


def export(
    map_path: Annotated[Path, typer.Argument(help="a map in any format", metavar="MAP")],
    out: Annotated[Path, typer.Argument(help=".pcd, .las, .laz, .ply, or a folder for Autoware tiles")],
    offset: Annotated[str, typer.Option(help="X,Y,Z in metres to subtract from every point")] = "0,0,0",
) -> None:
    """Write a map's points in another format. Says what it drops."""
    from mapvote.core.types import MapvoteError
    from mapvote.formats import export_map, read_map

    try:
        x, y, z = (float(v) for v in offset.split(","))
    except ValueError as error:
        raise MapvoteError(f"--offset {offset!r}: give three numbers, for example 367000,3951000,0") from error
    point_map = read_map(map_path)
    kind = export_map(point_map, out, (x, y, z))
    points = sum(len(t.points) for t in point_map.tiles.values())
    typer.echo(f"{out}: {points} points as {kind}")
    dropped = ["ground heights (measured again on import)"]
    if any(t.free is not None for t in point_map.tiles.values()):
        dropped.append("known-free columns")
    typer.echo(f"dropped: {', '.join(dropped)}")


def config(
    config: Config = None,
    toml: bool = typer.Option(False, "--toml", help="Print as TOML, to start a settings file from"),
) -> None:
    """Show every setting with its value, where the value comes from, and what it means.

    Settings come from their defaults, then from the TOML file, then from the environment (MAPVOTE_VOTING__N_MIN=4).
    """
    import tomli_w
    from rich.console import Console
    from rich.table import Table

    from mapvote.config import Settings, load_with_sources

    settings, sources = load_with_sources(config)
    if toml:
        typer.echo(tomli_w.dumps(settings.model_dump(exclude_none=True)), nl=False)
        return
    table = Table(title="Settings", title_justify="left", header_style="bold")
    for heading in ("setting", "value", "source", "meaning"):
        table.add_column(heading, overflow="fold")
    for section in Settings.model_fields:
        values = getattr(settings, section)
        for key, field in type(values).model_fields.items():
            source = sources.get(f"{section}.{key}", "default")
            style = "" if source == "default" else "bold green"
            table.add_row(f"{section}.{key}", str(getattr(values, key)), source, field.description or "", style=style)
        table.add_section()
    console = Console()
    console.print(table)
    console.print(f"Digest {settings.digest()[:16]}: ballots of one round must agree on it.", highlight=False)
