"""The verbs of mapping and driving: build, vote."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mapvote.cli.door import client_of, key_in, map_at, region_in, usable_drives
from mapvote.cli.options import Config, DrivePath, KeyFile, with_drive_options
from mapvote.cli.terminal import progress, waiting
from mapvote.core.types import MapvoteError

if TYPE_CHECKING:
    from mapvote.codec.ballot import Ballot
    from mapvote.config import Settings
    from mapvote.core.point_map import PointMap
    from mapvote.core.types import Drive
    from mapvote.perception.frontend import DriveReport
    from mapvote.slam.build import BuildReport


@with_drive_options
def build(
    drives: Annotated[list[Path], typer.Argument(metavar="DRIVE...", help="one or more drives of the same place")],
    out: Annotated[Path, typer.Option(metavar="MAP", help="the map to write; a folder that does not exist yet")],
    report_png: Annotated[
        Path | None,
        typer.Option("--report", metavar="PNG", help="write a picture of the drives' distance from their priors"),
    ] = None,
    config: Config = None,
    *,
    drive_options: dict[str, Any],
) -> None:
    """Build the first map from one or more drives by NDT SLAM: de-skewed, without moving objects, 0.3 m voxels.

    A precise prior (RTK) fixes the frame of the map. Coarse priors (GNSS) place the map as a whole. Without a prior the
    frame is that of the first scan.

        mapvote build MY_DRIVE --out my_map
    """
    from mapvote.config import load_settings
    from mapvote.formats import open_drive, write_map
    from mapvote.slam.build import build_map

    if out.exists():
        raise typer.BadParameter(f"{out} exists; name a new folder", param_hint="--out")
    settings = load_settings(config)
    opened = [open_drive(path, **drive_options) for path in drives]
    with usable_drives(opened) as looked_at, progress("mapping") as tell:
        point_map, report = build_map(looked_at, settings, progress=tell)
    with waiting(f"writing {out}"):
        write_map(point_map, out)
    _tell(report, out)
    if report_png is not None:
        from mapvote.plots import draw_survey

        draw_survey(opened, report, report_png)
        print(f"{report_png}: the drives' trajectories and their distance from the priors")


def _tell(report: BuildReport, out: Path) -> None:

    for track in report.tracks:
        line = (
            f"{track.vehicle}: {int(track.registered.sum())} of {len(track.registered)} scans, {track.length_m:.0f} m"
        )
        if track.drift is not None:
            d = track.drift
            line += f"; off its prior by {d.median_m:.3f} m (median), {d.max_m:.3f} m (most), {d.median_deg:.2f} deg"
        print(line)
        if track.wrong_attitude is not None:
            wrong = track.wrong_attitude
            print(f"warning: {track.vehicle}: {wrong.what}; built with {wrong.sigma_deg:g}: {wrong.mend}")
        for i in track.broken:
            print(
                f"warning: {track.vehicle}: the map is broken before scan {i}: nothing fitted, only priors tie it there"
            )
        print(f"{track.vehicle}: {track.heights}")
        if track.heights.complaint:
            print(f"warning: {track.vehicle}: {track.heights.complaint}")
    if report.two_levels is not None:
        x, y, apart = report.two_levels
        print(
            f"warning: two levels were driven above each other, {apart:.1f} m apart at ({x:.1f}, {y:.1f}). A cell has "
            "one ground: it keeps the road whose path is nearer, below both the lower one; who drives the other cannot "
            "vote there. (Less than a metre apart it is one road, mapped twice: the drives' heights do not agree.)"
        )
    print(f"{out}: {report.points} points")
    print(f"{out}: {_frame(report)}")


def _frame(report: BuildReport) -> str:
    """What the priors did to the map, in a sentence."""
    import numpy as np

    sigma_m = max(float(np.median(track.sigma_m)) for track in report.tracks)
    if np.isnan(sigma_m):
        return "no drive has a prior: the frame of the map is that of its first scan"
    if report.held_by_prior:
        start = "the precise priors hold the map in their frame"
    else:
        start = "the priors are coarse: the whole survey was shifted and turned about the vertical to fit them"
    bent = f"they then moved single scans by up to {report.bent_m:.2f} m"
    return f"{start}; {bent}; positions are good to {sigma_m:.2f} m (1 sigma)"


@with_drive_options
def vote(
    drive_path: DrivePath,
    where: Annotated[str, typer.Option("--map", metavar="MAP|URL", help="a map in any format, or the URL of a server")],
    out: Annotated[Path | None, typer.Option(metavar="BALLOT", help="write the ballot to this file")] = None,
    send: Annotated[
        str | None,
        typer.Option(
            metavar="URL", help="send the ballot to this server; if it does not answer, the next vote sends the ballot"
        ),
    ] = None,
    key_file: KeyFile = None,
    vehicle: Annotated[
        str | None, typer.Option(metavar="NAME", help="name of the vehicle; default: drive.toml, else the drive's name")
    ] = None,
    case: Annotated[
        str | None,
        typer.Option(metavar="CASE", help="surfaces, or case 1 to 5 of the paper; default: the settings"),
    ] = None,
    trust_prior: Annotated[
        bool, typer.Option("--trust-prior", help="use the prior as the pose; do not localise")
    ] = False,
    region: Annotated[
        str | None,
        typer.Option(
            metavar="X0,Y0,X1,Y1",
            help="download only this part of a server's map, in map metres; leave 100 m around the drive",
        ),
    ] = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="for a cloud: the sensor's poses in the cloud's frame, rows of 3 x 4 or TUM"),
    ] = None,
    config: Config = None,
    *,
    drive_options: dict[str, Any],
) -> None:
    """Vote with a recorded drive: localise, remove moving objects, compare with the map, and write one ballot.

    A point cloud in any frame can vote too: it is registered to the map first.

    mapvote vote ANOTHER_DRIVE --map my_map --vehicle car_1 --out car_1.ballot
    """
    from mapvote.cli.diff import ballot_of_cloud
    from mapvote.codec.ballot import encode
    from mapvote.config import choose_case, load_settings
    from mapvote.core.point_map import has_open_ground
    from mapvote.formats import is_cloud, open_drive
    from mapvote.formats.atomic import whole_file
    from mapvote.formats.geo.frame import frame_of

    if out is None and send is None:
        raise MapvoteError("vote: give --out BALLOT, --send URL, or both")
    key = key_in(key_file)
    settings = load_settings(config)
    if case is not None:
        settings = choose_case(settings, case)
    with ExitStack() as open_map:
        with waiting(f"reading {where}"):
            wanted = None if region is None else region_in(region)
            point_map = open_map.enter_context(map_at(where, key_file, region=wanted, or_kept=True))
        if not has_open_ground(point_map):
            print(
                "warning: the map has no ground: objects are found, but heights above the ground are "
                "guessed from the feet of walls, and on open ground nothing can be voted; build or import the map with "
                "its ground",
                file=sys.stderr,
            )
        if is_cloud(drive_path):
            ballot, report = ballot_of_cloud(drive_path, point_map, settings, vehicle, trajectory), None
        else:
            drive = open_drive(drive_path, vehicle=vehicle, frame=frame_of(point_map.georeference), **drive_options)
            ballot, report = _drive_once(drive, point_map, settings, trust_prior)
    data = encode(ballot)
    if out is not None:
        with whole_file(out) as partial:
            partial.write_bytes(data)
    _tell_votes(ballot, report, out, len(data))
    if send is not None:
        _send(send, key, data)


def _drive_once(
    drive: Drive, point_map: PointMap, settings: Settings, trust_prior: bool
) -> tuple[Ballot, DriveReport | None]:
    from mapvote.localisation.localiser import GivenPoses
    from mapvote.vehicle import vote_drive

    localise = None
    if trust_prior:
        if drive.T_map_lidar_prior is None:
            missing = "has no prior to trust; give one with --prior, or let it be localised"
            raise MapvoteError(f"{drive.path}: {missing}")
        localise = GivenPoses(drive.stamps_ns, drive.T_map_lidar_prior)
    with usable_drives([drive]) as (drive,), progress("voting") as tell:
        return vote_drive(drive, point_map, settings, localise=localise, progress=tell)


def _send(url: str, key: str | None, data: bytes) -> None:
    """Send what waits in the spool, then this ballot."""
    with client_of(url, key) as client:
        for name, result in client.flush().items():
            print(f"{name} from the spool: {result}")
        result = client.send(data)
    print(f"{url}: {result}" if result != "spooled" else f"{url} is away: the ballot waits, the next vote sends it")


def _tell_votes(ballot: Ballot, report: DriveReport | None, out: Path | None, size: int) -> None:
    if report is not None:
        print(
            f"{ballot.vehicle}: {ballot.scans_localised} of {ballot.scans} scans localised "
            f"(median sigma {ballot.median_sigma_m:.3f} m) over {ballot.length_m or 0.0:.0f} m, the others abstain"
        )
        stages = ", ".join(f"{stage} {1000.0 * sorted(s)[len(s) // 2]:.1f}" for stage, s in report.stage_s.items())
        print(f"milliseconds a scan (median): {stages}")
    print(f"{out or 'ballot'}: {len(ballot.tiles)} tiles, {size / 1000.0:.1f} kB")
