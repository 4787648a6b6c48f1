"""The verbs of mapping and driving: build."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapvote.cli.options import Config, Mount, Prior, Rate, Scans, SensorName, Topic

if TYPE_CHECKING:
    from mapvote.mapping import BuildReport


def register(app: typer.Typer) -> None:
    app.command()(build)


def build(
    drives: Annotated[list[Path], typer.Argument(help="one or more drives of the same place", metavar="DRIVE...")],
    out: Annotated[Path, typer.Option(help="the map to write; a folder that does not exist yet")],
    scans: Scans = None,
    prior: Prior = None,
    rate: Rate = None,
    sensor: SensorName = None,
    mount: Mount = None,
    topic: Topic = None,
    config: Config = None,
) -> None:
    """Build the first map from one or more drives by NDT SLAM: de-skewed, without moving objects, 0.3 m voxels.

    A precise prior (RTK) holds the map in its frame, a coarse one only starts the search, none is needed.
    """
    from rich.progress import Progress

    from mapvote.config import load_with_sources
    from mapvote.formats import open_drive, write_map
    from mapvote.mapping import build_map

    if out.exists():
        raise typer.BadParameter(f"{out} exists; name a new folder", param_hint="--out")
    settings, _ = load_with_sources(config)
    opened = [
        open_drive(path, scans=scans, prior=prior, rate_hz=rate, sensor=sensor, mount=mount, topic=topic)
        for path in drives
    ]
    with Progress(transient=True) as bar:
        task = bar.add_task("mapping", total=None)
        point_map, report = build_map(
            opened, settings, progress=lambda done, total: bar.update(task, completed=done, total=total)
        )
    write_map(point_map, out)
    _tell(report, out)


def _tell(report: BuildReport, out: Path) -> None:
    for track in report.tracks:
        line = (
            f"{track.vehicle}: {int(track.registered.sum())} of {len(track.registered)} scans, {track.length_m:.0f} m"
        )
        if track.drift is not None:
            d = track.drift
            line += f"; off its prior by {d.median_m:.3f} m (median), {d.max_m:.3f} m (most), {d.median_deg:.2f} deg"
        typer.echo(line)
    frame = "held in its frame by a precise prior" if report.held_by_prior else "not held by any precise prior"
    typer.echo(f"{out}: {report.points} points, {frame}")
