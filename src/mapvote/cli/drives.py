"""The verbs of recorded drives and of whole clouds: build, vote, diff, merge."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from mapvote.cli.door import (
    check_ending,
    client_of,
    key_in,
    map_at,
    named_after,
    region_in,
    require_localised,
    require_straight,
    usable_drives,
)
from mapvote.cli.options import Config, KeyFile, Unchecked, with_drive_options
from mapvote.cli.terminal import print_table, progress, waiting
from mapvote.core.types import MapvoteError

if TYPE_CHECKING:
    from mapvote.codec.ballot import Ballot
    from mapvote.compare.cloud_changes import CloudChange
    from mapvote.config import Settings
    from mapvote.core.point_map import PointMap
    from mapvote.core.types import Drive
    from mapvote.perception.frontend import DriveReport
    from mapvote.survey.build import BuildReport


@with_drive_options
def build(
    drives: Annotated[list[Path], typer.Argument(metavar="DRIVE...", help="one or more drives of the same place")],
    out: Annotated[Path, typer.Option(metavar="MAP", help="the map to write; a folder that does not exist yet")],
    report_png: Annotated[
        Path | None,
        typer.Option("--report", metavar="PNG", help="write a picture of the drives' distance from their priors"),
    ] = None,
    unchecked: Unchecked = False,
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
    from mapvote.doctor.localised import LocalisedDrive
    from mapvote.formats import open_drive, write_map
    from mapvote.survey.build import build_map

    check_ending(report_png, "--report", ".png", ".svg", ".pdf")
    if out.exists():
        raise typer.BadParameter(f"{out} exists; name a new folder", param_hint="--out")
    settings = load_settings(config)
    opened = [open_drive(path, **drive_options) for path in drives]
    with usable_drives(opened, unchecked=unchecked) as looked_at, progress("mapping") as tell:
        point_map, report = build_map(looked_at, settings, progress=tell)
    for track in report.tracks:
        require_localised(
            LocalisedDrive.of(track.drive, track.T_map_lidar, track.registered), track.drive, None, unchecked
        )
    with waiting(f"writing {out}"):
        write_map(named_after(out, point_map), out)
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
            f"warning: two roads lie above each other, {apart:.1f} m apart at ({x:.1f}, {y:.1f}). Each cell stores one "
            "ground level. Vehicles on the other level cannot vote there. If this is one road, less than a metre "
            "apart, the drives disagree about its height."
        )
    print(f"{out}: {report.points} points")
    print(f"{out}: {_frame(report)}")


def _frame(report: BuildReport) -> str:
    """One sentence on the effect of the priors on the map."""
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
    drive_path: Annotated[Path, typer.Argument(metavar="DRIVE", help="a recorded drive, in any format")],
    map_source: Annotated[
        str, typer.Option("--map", metavar="MAP|URL", help="a map in any format, or the URL of a server")
    ],
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
    poses: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="also write the poses of the scans, for evo: FILE.tum or FILE.kitti"),
    ] = None,
    cuts: Annotated[
        bool, typer.Option("--cuts", help="close ballots as `mapvote drive` does; --out is a folder for them")
    ] = False,
    every_m: Annotated[
        float, typer.Option(min=1.0, metavar="METRES", help="with --cuts: longest stretch of road in one ballot")
    ] = 2000.0,
    name: Annotated[
        str | None, typer.Option(metavar="NAME", help="name of the drive; default: drive.toml, else the drive's name")
    ] = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="for a cloud: the sensor's poses in the cloud's frame, rows of 3 x 4 or TUM"),
    ] = None,
    unchecked: Unchecked = False,
    config: Config = None,
    *,
    drive_options: dict[str, Any],
) -> None:
    """Vote with a recorded drive: localise, remove moving objects, compare with the map, and write one ballot.

    A point cloud in any frame can vote too: it is registered to the map first.

    mapvote vote ANOTHER_DRIVE --map my_map --vehicle car_1 --out car_1.ballot
    """
    from mapvote.codec.ballot import encode
    from mapvote.config import choose_case, load_settings
    from mapvote.core.point_map import has_open_ground
    from mapvote.formats import is_cloud, open_drive_on
    from mapvote.formats.atomic import write_whole
    from mapvote.formats.drives.pose_files import ENDINGS, write_trajectory

    check_ending(poses, "--poses", *ENDINGS)
    if poses is not None and is_cloud(drive_path):
        raise MapvoteError("vote: a cloud has no scans, so it has no poses to write; leave out --poses")
    if out is None and send is None:
        raise MapvoteError("vote: give --out BALLOT, --send URL, or both")
    key = key_in(key_file)
    settings = load_settings(config)
    if case is not None:
        settings = choose_case(settings, case)
    with ExitStack() as open_map:
        with waiting(f"reading {map_source}"):
            wanted = None if region is None else region_in(region)
            point_map = open_map.enter_context(map_at(map_source, key_file, region=wanted, or_kept=True))
        if not has_open_ground(point_map):
            print(
                "warning: the map has no ground: objects are found, but heights above the ground are "
                "guessed from the feet of walls, and on open ground nothing can be voted; build or import the map with "
                "its ground",
                file=sys.stderr,
            )
        if is_cloud(drive_path):
            ballot = _ballot_of_cloud(drive_path, point_map, settings, vehicle, trajectory)
            report = None
        else:
            drive = open_drive_on(point_map, drive_path, vehicle=vehicle, as_live=True, **drive_options)
            if name is not None:
                drive = replace(drive, drive_id=name)
            if cuts and (poses is not None or trust_prior):
                raise MapvoteError("vote: --cuts goes with neither --poses nor --trust-prior")
            if cuts:
                _vote_in_cuts(drive, point_map, settings, every_m, _Outlets(out, send, key, unchecked))
                return
            ballot, report = _drive_once(drive, point_map, settings, trust_prior, unchecked)
    data = encode(ballot)
    if out is not None:
        write_whole(out, data)
    _tell_votes(ballot, report, out, len(data))
    if poses is not None and report is not None:
        written = write_trajectory(poses, report.stamps_ns, report.T_map_lidar, frozenset(report.lost))
        print(f"{poses}: {written} poses")
    if send is not None:
        _send(send, key, data)


def _drive_once(
    drive: Drive, point_map: PointMap, settings: Settings, trust_prior: bool, unchecked: bool
) -> tuple[Ballot, DriveReport | None]:
    from mapvote.doctor.localised import LocalisedDrive
    from mapvote.matching.localiser import GivenPoses
    from mapvote.vehicle import vote_drive

    localise = None
    if trust_prior:
        if drive.T_map_lidar_prior is None:
            missing = "has no prior to trust; give one with --prior, or let it be localised"
            raise MapvoteError(f"{drive.path}: {missing}")
        localise = GivenPoses(drive.stamps_ns, drive.T_map_lidar_prior)
    with usable_drives([drive], unchecked=unchecked) as (drive,), progress("voting") as tell:
        ballot, report = vote_drive(drive, point_map, settings, localise=localise, progress=tell)
    if not trust_prior:
        require_localised(LocalisedDrive.of_vote(drive, report), drive, point_map, unchecked)
    require_straight(drive, report, point_map, unchecked=unchecked)
    return ballot, report


class _Outlets(NamedTuple):
    """Where ballots go."""

    folder: Path | None
    url: str | None
    key: str | None
    unchecked: bool
    """Whether errors of the drive are warnings."""


def _vote_in_cuts(drive: Drive, point_map: PointMap, settings: Settings, every_m: float, outlets: _Outlets) -> None:
    """The ballots that a live drive by the same scans would close, each written or sent as soon as it is known that
    the drive can be used."""
    from mapvote.codec.ballot import encode
    from mapvote.doctor.localised import LocalisedDrive, written_if_localised
    from mapvote.formats.atomic import write_whole
    from mapvote.formats.drives.upright import upright
    from mapvote.vehicle import Cuts, vehicle_on, vote_in_stretches

    with usable_drives([drive], unchecked=outlets.unchecked) as (looked,), progress("voting") as tell:
        turned, _ = upright(looked)
        vehicle = vehicle_on(turned, point_map, settings)
        closed = list(vote_in_stretches(turned, vehicle, Cuts(length_m=every_m), tell))
    for stretch in closed:
        drive_id = stretch.drive_id
        localised = LocalisedDrive.of_report(stretch.report, prior_in_map=stretch.prior_in_map)
        checked = written_if_localised(stretch.written, localised, stretch.point_map)
        try:
            ballot = stretch.written() if outlets.unchecked else checked()
        except MapvoteError as error:
            print(f"{drive_id}: no ballot ({error})")
            continue
        data = encode(ballot)
        print(f"{drive_id}: {ballot.scans_localised} of {ballot.scans} scans voted")
        if outlets.folder is not None:
            write_whole(outlets.folder / f"{drive.vehicle}~{drive_id}.ballot", data)
        if outlets.url is not None:
            _send(outlets.url, outlets.key, data)


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


def _ballot_of_cloud(
    path: Path, point_map: PointMap, settings: Settings, vehicle: str | None, trajectory: Path | None
) -> Ballot:
    """The ballot of a session's cloud; prints its registration and where it does not vote. It ended when the file
    was last changed."""
    from mapvote.compare.session_votes import vote_of_session
    from mapvote.formats import read_map
    from mapvote.formats.drives.trajectory import read_poses

    with waiting(f"reading {path}"):
        cloud = read_map(path)
        driven = None if trajectory is None else read_poses(trajectory)[:, :3, 3]
    name = path.stem or path.name
    with waiting("registering and voting"):
        said = vote_of_session(
            vehicle or name, name, point_map, cloud, settings, end_ns=path.stat().st_mtime_ns, trajectory=driven
        )
    for line in said.registered.told():
        print(line)
    if said.registered.bent:
        print("bent parts do not vote")
    if not said.by_trajectory:
        print("no trajectory: gone and new by the ground that the cloud shows, and no free space is learned")
    _print_sums(said.changes)
    return said.ballot


def diff(
    path_a: Annotated[
        Path, typer.Argument(metavar="A", help="the older map or cloud, in any format; results are in its frame")
    ],
    path_b: Annotated[Path, typer.Argument(metavar="B", help="the newer one, in any format and frame")],
    min_area: Annotated[float, typer.Option(min=0.0, metavar="M2", help="leave out smaller objects")] = 0.5,
    unbend: Annotated[
        bool, typer.Option("--unbend", help="correct bent parts of B piece by piece, if that makes them fit")
    ] = False,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="also write the footprints as GeoJSON")] = None,
    csv: Annotated[Path | None, typer.Option(metavar="FILE", help="also write the table as CSV")] = None,
    page: Annotated[
        Path | None,
        typer.Option("--html", metavar="FILE", help="also write one page with both clouds around the largest"),
    ] = None,
    show_not_seen: Annotated[
        bool, typer.Option("--not-seen", help="also list objects of one cloud where the other has no ground")
    ] = False,
) -> None:
    """List the differences of two clouds or maps of one place. B is registered to A without a prior, at any heading.

    mapvote diff old_map.las session.pcd --html diff.html
    """
    import json

    check_ending(out, "--out", ".geojson", ".json")
    check_ending(csv, "--csv", ".csv")
    check_ending(page, "--html", ".html", ".htm")
    from mapvote.compare.cloud_changes import (
        compare_cells,
        difference_geojson,
        difference_page,
        difference_rows,
        differences,
    )
    from mapvote.compare.register import brought_into
    from mapvote.formats import read_map
    from mapvote.formats.atomic import write_whole
    from mapvote.shapes.geojson import as_csv

    with waiting(f"reading {path_a} and {path_b}"):
        map_a = read_map(path_a)
        map_b = read_map(path_b)
    with waiting("registering B to A"):
        map_b, registered = brought_into(map_a, map_b, unbend=unbend)
    with waiting("comparing"):
        compared = compare_cells(map_a, map_b, registered)
        changes = differences(compared, min_area)
    lines = registered.told()
    by_free = bool(compared.a.free.any() or compared.b.free.any())
    lines.append(
        "gone and new are decided by free space and by ground that the other one shows"
        if by_free
        else "neither has free space: gone and new are decided by geometry alone (the other has ground there, and "
        "nothing that stands within two cells)"
    )
    for line in lines:
        print(line)
    listed = [one for one in changes if show_not_seen or one.kind != "not seen"]
    rows = difference_rows(listed)
    shown = ("id", "kind", "x", "y", "area_m2", "height_m", "points", "confidence")
    print_table(shown, [tuple(str(row[name]) for name in shown) for row in rows])
    _print_sums(changes)
    left_out = float(compared.left_out.sum()) * 0.09
    if left_out:
        print(f"left out in bent parts: {left_out:.1f} m2 of cells")
    written = []
    if out is not None:
        collection = difference_geojson(changes, map_a.lattice, map_a.georeference, lines)
        written.append((out, json.dumps(collection, indent=1) + "\n"))
    if csv is not None:
        written.append((csv, as_csv(difference_rows(changes))))
    if page is not None:
        written.append((page, difference_page(f"{path_a.name} and {path_b.name}", changes, map_a, map_b)))
    for file, text in written:
        write_whole(file, text)
        print(f"{file}")


def merge(
    paths: Annotated[list[Path], typer.Argument(metavar="MAP...", help="maps that overlap, in any format and frame")],
    out: Annotated[Path, typer.Option(metavar="MAP", help="the map to write; a folder that does not exist yet")],
    apart: Annotated[
        float, typer.Option(min=0.0, metavar="M", help="accept maps that stay so many metres apart (median)")
    ] = 0.1,
) -> None:
    """Merge overlapping maps into one, in the frame of the first: registered, adjusted together, one point per voxel.

    mapvote merge north.laz south.laz --out town
    """
    from mapvote.compare.merge import merge_maps
    from mapvote.formats import read_map, write_map

    if out.exists():
        raise typer.BadParameter(f"{out} exists; name a new folder", param_hint="--out")
    with waiting("reading"):
        maps = [read_map(path) for path in paths]
    with waiting("registering and merging"):
        merged = merge_maps(maps, most_apart_m=apart)
    for (i, j), far in merged.apart_m.items():
        print(f"{paths[i]} and {paths[j]}: {far:.3f} m apart after adjustment (median)")
    with waiting(f"writing {out}"):
        write_map(named_after(out, merged.point_map), out)
    print(f"{out}: {merged.point_map.n_points} points")


def _print_sums(changes: Sequence[CloudChange]) -> None:
    for kind in ("gone", "new", "not seen"):
        areas_m2 = [one.area_m2 for one in changes if one.kind == kind]
        print(f"{kind}: {len(areas_m2)} things, {sum(areas_m2):.1f} m2")
