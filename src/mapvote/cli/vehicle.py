"""The verbs of mapping and driving: build, vote."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapvote.cli.options import Config, Mount, Prior, Rate, Scans, SensorName, Topic, Vehicle

if TYPE_CHECKING:
    from mapvote.client import MapClient
    from mapvote.codec.ballot import Ballot
    from mapvote.core.point_map import PointMap
    from mapvote.slam.build import BuildReport
    from mapvote.vehicle import DriveReport


def register(app: typer.Typer) -> None:
    app.command()(build)
    app.command()(vote)


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
    from mapvote.slam.build import build_map

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


def vote(
    drive_path: Annotated[Path, typer.Argument(help="one drive of a place that the map shows", metavar="DRIVE")],
    where: Annotated[str, typer.Option("--map", help="map folder, PCD file, Autoware folder, or a server's URL")],
    out: Annotated[Path | None, typer.Option(help="the ballot to write")] = None,
    send: Annotated[str | None, typer.Option(metavar="URL", help="send it there; kept for later if away")] = None,
    key: Annotated[str | None, typer.Option(envvar="MAPVOTE_KEY", help="the vehicle's key at that server")] = None,
    vehicle: Vehicle = None,
    case: Annotated[
        str | None, typer.Option(help="columns, or the paper's case 1 to 5; default: the settings' [voting]")
    ] = None,
    trust_prior: Annotated[bool, typer.Option(help="take the prior for the pose, do not localise")] = False,
    scans: Scans = None,
    prior: Prior = None,
    rate: Rate = None,
    sensor: SensorName = None,
    mount: Mount = None,
    topic: Topic = None,
    config: Config = None,
) -> None:
    """Drive once: localise, remove moving objects, compare with the map, and write one ballot."""
    from rich.progress import Progress

    from mapvote.codec.ballot import encode
    from mapvote.config import choose_case, load_with_sources
    from mapvote.core.types import MapvoteError
    from mapvote.formats import open_drive, read_map
    from mapvote.formats.atomic import whole_file
    from mapvote.localisation.tracker import GivenPoses
    from mapvote.vehicle import vote_drive

    if out is None and send is None:
        raise MapvoteError("vote: say where the ballot goes: --out FILE, --send URL, or both")
    settings, _ = load_with_sources(config)
    if case is not None:
        settings = choose_case(settings, case)
    drive = open_drive(
        drive_path, scans=scans, prior=prior, rate_hz=rate, sensor=sensor, vehicle=vehicle, mount=mount, topic=topic
    )
    localise = None
    if trust_prior:
        if drive.T_map_lidar_prior is None:
            raise MapvoteError(f"{drive_path}: has no prior to trust; give one with --prior, or let it be localised")
        localise = GivenPoses(drive.stamps_ns, drive.T_map_lidar_prior)
    point_map = _fetch(where, key) if "://" in where else read_map(where)
    with Progress(transient=True) as bar:
        task = bar.add_task("voting", total=len(drive))
        ballot, report = vote_drive(
            drive, point_map, settings, localise=localise, progress=lambda done, _: bar.update(task, completed=done)
        )
    data = encode(ballot)
    if out is not None:
        with whole_file(out) as partial:
            partial.write_bytes(data)
    _tell_votes(ballot, report, out, len(data))
    if send is not None:
        _send(send, key, data)


def _client(url: str, key: str | None) -> MapClient:
    from mapvote.client import MapClient

    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return MapClient(url, key=key, home=cache / "mapvote")


def _fetch(url: str, key: str | None) -> PointMap:
    with _client(url, key) as client:
        return client.fetch()


def _send(url: str, key: str | None, data: bytes) -> None:
    """Send what waits in the spool, then this ballot."""
    with _client(url, key) as client:
        for name, result in client.flush().items():
            typer.echo(f"{name} from the spool: {result}")
        result = client.send(data)
    typer.echo(
        f"{url}: {result}" if result != "spooled" else f"{url} is away: the ballot waits, the next vote sends it"
    )


def _tell_votes(ballot: Ballot, report: DriveReport, out: Path | None, size: int) -> None:
    typer.echo(
        f"{ballot.vehicle}: {ballot.scans_localised} of {ballot.scans} scans localised "
        f"(median sigma {ballot.median_sigma_m:.3f} m), the others abstain"
    )
    stages = ", ".join(f"{stage} {1000.0 * sorted(s)[len(s) // 2]:.1f}" for stage, s in report.stage_s.items())
    typer.echo(f"milliseconds a scan (median): {stages}")
    typer.echo(f"{out or 'ballot'}: {len(ballot.tiles)} tiles, {size / 1000.0:.1f} kB")
