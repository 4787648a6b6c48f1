"""The verbs for files: info, doctor, import, export, update."""

from __future__ import annotations

from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mapvote.cli.door import (
    api_at,
    check_ending,
    is_store,
    is_url,
    key_in,
    look_at_points,
    map_at,
    named_after,
    numbers_in,
    sound_map,
    stores,
)
from mapvote.cli.options import Config, KeyFile, Projector, Rate, Topic, with_drive_options
from mapvote.cli.terminal import print_table, stages_that_vanish, waiting
from mapvote.core.times import utc
from mapvote.core.types import MapvoteError

if TYPE_CHECKING:
    from mapvote.client import MapClient
    from mapvote.core.grid import Lattice, TileIndex
    from mapvote.core.point_map import PointMap
    from mapvote.doctor import Finding
    from mapvote.doctor.diagnosis import Diagnosis
    from mapvote.formats.maps.autoware import Change
    from mapvote.fusion.fuse import Decision


def info(
    path: Annotated[
        str,
        typer.Argument(metavar="PATH|STORE|URL", help="a map, a drive or a ballot in any format; a store; a server"),
    ],
    vehicles: Annotated[
        bool, typer.Option("--vehicles", help="for a store: list the vehicles that contradict the others, and where")
    ] = False,
    rate_hz: Rate = None,
    topic: Topic = None,
    key_file: KeyFile = None,
) -> None:
    """Describe a file, a folder, a store or a server's store.

    mapvote info my_map

    mapvote info fleet.db --vehicles
    """
    from rich.console import Console
    from rich.text import Text

    from mapvote.formats.describe import describe

    in_store = is_url(path) or is_store(path)
    if vehicles and not in_store:
        raise MapvoteError(f"info: {path} is no STORE or URL; --vehicles needs one")
    if in_store:
        with api_at(path, key_file) as server, waiting(f"reading {path}"):
            answer = server.ask_json("GET", "/v1/vehicles" if vehicles else "/v1/info")
        if vehicles:
            _print_standings(answer["vehicles"])
            return
        answer["published"] = utc(answer.pop("published_ns"))
        shown = [(key, f"{value:,}" if isinstance(value, int) else value) for key, value in answer.items()]
        title = "store"
        rows = [(key.replace("_", " "), value) for key, value in shown]
    else:
        with waiting(f"reading {path}"):
            title, rows = describe(Path(path), rate_hz=rate_hz, topic=topic)
    Console(highlight=False).print(Text(f"{path}: {title}", style="bold"), soft_wrap=True)
    print_table(("", ""), [(Text(name, "cyan"), value) for name, value in rows])


def _print_standings(standings: list[dict[str, Any]]) -> None:
    rows = []
    for s in standings:
        places = "; ".join(f"{e['says']} at {e['x']:.1f}, {e['y']:.1f} ({e['cells']} cells)" for e in s["evidence"][:3])
        counts = str(s["cells"]), str(s["objects"]), str(s["others_objects"]), f"{s['p_value']:.2g}"
        rows.append((s["vehicle"], s["verdict"], *counts, places))
    print_table(("vehicle", "verdict", "cells compared", "contradictions", "of the others", "p", "the largest"), rows)
    print(
        "Compared where others agree both before and after a vehicle passed; the first and the last cannot be judged."
    )


@with_drive_options
def doctor(
    path: Annotated[
        str, typer.Argument(metavar="DRIVE|MAP|BALLOT|STORE", help="a drive, a map or a ballot in any format; a store")
    ],
    map_source: Annotated[
        str | None,
        typer.Option(
            "--map",
            metavar="MAP|STORE|URL",
            help="also compare the drive or cloud with this map, and report where it is bent",
        ),
    ] = None,
    key_file: KeyFile = None,
    png: Annotated[
        Path | None,
        typer.Option("--png", metavar="FILE", help="write a picture of a drive's scans, as read and as corrected"),
    ] = None,
    *,
    drive_options: dict[str, Any],
) -> None:
    """Find what is wrong with a drive, a map, a ballot or a store, and how to mend it. Exit code 1 if it is unusable.

    mapvote doctor MY_DRIVE --map my_map
    """
    from mapvote.doctor import any_error
    from mapvote.doctor.diagnosis import Diagnosis, diagnose
    from mapvote.formats import read_map

    check_ending(png, "--png", ".png", ".svg", ".pdf")
    if is_url(path):
        raise MapvoteError(f"doctor: {path} is a server: mapvote check {path} looks at its store")
    with ExitStack() as open_map:
        point_map = None
        if map_source is not None:
            with waiting(f"reading {map_source}"):
                served = is_url(map_source) or is_store(map_source)
                # Faults of a map in files are reported beside the faults of the drive.
                point_map = open_map.enter_context(map_at(map_source, key_file)) if served else read_map(map_source)
        if is_store(path):
            with waiting("reading every byte"):
                diagnosis = Diagnosis(stores().findings_of(path))
        else:
            with stages_that_vanish() as tell:
                diagnosis = diagnose(Path(path), drive_options, point_map, tell)
        if png is not None:
            from mapvote.plots import draw_diagnosis

            draw_diagnosis(diagnosis, point_map, png)
    _tell_findings(path, diagnosis)
    if png is not None:
        print(f"{png}: the scans as read, and as mended")
    if any_error(diagnosis.findings):
        raise typer.Exit(1)


def _tell_findings(path: str, diagnosis: Diagnosis) -> None:
    from rich.console import Console

    console = Console(soft_wrap=True, highlight=False)
    for finding in diagnosis.findings:
        for line in _lines(finding):
            console.print(line)
    errors = sum(f.severity == "error" for f in diagnosis.findings)
    warnings = sum(f.severity == "warning" for f in diagnosis.findings)
    print(f"{path}: {errors} errors, {warnings} warnings" if errors or warnings else f"{path}: sound")


def _lines(finding: Finding) -> list[str]:
    from rich.markup import escape

    colour = {"error": "bold red", "warning": "yellow", "note": "dim"}[finding.severity]
    first = f"[{colour}]{finding.severity}[/] {escape(finding.what)}"
    return [first, f"      [green]mend[/] {escape(finding.mend)}"] if finding.mend else [first]


def import_map(
    source: Annotated[Path, typer.Argument(metavar="FILE", help="a point cloud in any format")],
    out: Annotated[Path, typer.Argument(metavar="MAP", help="the mapvote map to write, a folder")],
    crs: Annotated[
        str | None,
        typer.Option(
            metavar="CRS",
            help="project to this system: EPSG:32654 or WKT; or, if the file names none, the system of the file",
        ),
    ] = None,
    projector: Projector = None,
    from_crs: Annotated[
        str | None,
        typer.Option(
            metavar="CRS", help="system of the file, if the file names none or a wrong one: EPSG:n, WKT, local"
        ),
    ] = None,
    clean: Annotated[bool, typer.Option("--clean", help="drop points above the ground that touch no other")] = False,
    drop: Annotated[
        str,
        typer.Option(
            metavar="MARKS",
            help="points to leave out: withheld, noise, synthetic, key_point, overlap; or none",
        ),
    ] = "withheld,noise",
    unchecked: Annotated[
        bool, typer.Option("--unchecked", help="import points that a check refuses; the map says so to other verbs")
    ] = False,
) -> None:
    """Make a mapvote map of a point cloud: in metres, cut into tiles, ground measured. Reports what it drops.

    mapvote import city.pcd my_map
    """
    from mapvote.formats import import_cloud, write_map
    from mapvote.formats.atomic import folder_beside
    from mapvote.formats.geo.frame import frame_wanted
    from mapvote.formats.maps.marked_points import marks_in

    with waiting(f"reading {source}"):
        wanted = frame_wanted(crs, projector)
        look = look_at_points(str(source), unchecked=unchecked)
        beside = folder_beside(out)
        point_map, lines = import_cloud(source, wanted, from_crs, beside, look, marks_in(drop), unchecked=unchecked)
    if clean:
        from mapvote.survey.clean_map import without_lone_points

        point_map, lone = without_lone_points(point_map)
        lines = [*lines, f"{lone} points above the ground dropped: they touch no other"]
    point_map = named_after(out, point_map)
    with waiting(f"writing {out}"):
        write_map(point_map, out)
    print(f"{out}: {point_map.n_points} points in {len(point_map.tiles)} tiles, map {point_map.map_id}")
    for line in lines:
        print(line)
    print("known-free columns: none yet; each published version adds those that the fleet's drives saw")


def export(
    source: Annotated[str, typer.Argument(metavar="MAP|STORE|URL", help="a map, a store, or a server's newest map")],
    out: Annotated[
        Path,
        typer.Argument(metavar="FILE", help=".pcd, .las, .laz, .copc.laz, .ply, or a folder for Autoware tiles"),
    ],
    offset: Annotated[
        str, typer.Option(metavar="X,Y,Z", help="metres to subtract from every point, for float32 formats")
    ] = "0,0,0",
    crs: Annotated[str | None, typer.Option(metavar="CRS", help="coordinate system to write: EPSG:n or WKT")] = None,
    projector: Projector = None,
    version: Annotated[
        int | None, typer.Option(metavar="N", help="version of a store or server; default: the newest")
    ] = None,
    since: Annotated[
        int | None, typer.Option(metavar="N", help="write only Autoware tiles that differ from this version")
    ] = None,
    follow: Annotated[
        bool, typer.Option("--follow", help="keep a folder of Autoware tiles at the newest version of the server")
    ] = False,
    keep: Annotated[
        int, typer.Option(min=0, metavar="N", help="with --follow: number of older versions whose tiles stay")
    ] = 3,
    every: Annotated[
        float, typer.Option(min=0.1, metavar="SECONDS", help="with --follow: seconds between two requests")
    ] = 30.0,
    once: Annotated[bool, typer.Option("--once", help="with --follow: write the newest version once and end")] = False,
    stac: Annotated[
        bool,
        typer.Option("--stac", help="write a STAC catalogue: a folder of all versions as COPC, with changes"),
    ] = False,
    key_file: KeyFile = None,
) -> None:
    """Write a map's points in another format, in its own coordinate system or another. Reports what it drops.

    Autoware tiles of a store or a server are named after their content, because a running Autoware reads each path only
    once.

        mapvote export my_map city.pcd

        mapvote export https://maps.example.org map --follow --key-file key

        mapvote export fleet.db catalogue --stac
    """
    from mapvote.core.extras import require_for

    if stac:
        from mapvote.cli.catalogue import export_stac

        export_stac(source, out, key_file, version)
        return
    if follow:
        if not is_url(source) or out.suffix:
            raise MapvoteError("export: --follow takes the URL of a server and a folder")
        _follow(source, out, projector, key_file, keep=keep, every=None if once else every)
        return
    require_for(out, str(out))
    x, y, z = numbers_in(offset, "--offset", "three numbers, for example 367000,3951000,0", 3)
    live = not out.suffix and (is_url(source) or is_store(source))
    if since is not None and not live:
        raise MapvoteError("export: --since writes Autoware tiles of a store or a server: give a folder, not a file")
    with ExitStack() as open_maps:
        with waiting(f"reading {source}"):
            point_map = open_maps.enter_context(map_at(source, key_file, version, origins=not live))
            older = None if since is None else open_maps.enter_context(map_at(source, key_file, since))
        if live:
            _lay(point_map, out, older, projector)
        else:
            _export(point_map, out, (x, y, z), crs, projector)


def _export(
    point_map: PointMap, out: Path, offset: tuple[float, float, float], crs: str | None, projector: str | None
) -> None:
    from mapvote.formats import export_map

    with waiting(f"writing {out}"):
        kind, frame = export_map(point_map, out, offset, crs=crs, projector=projector)
    print(f"{out}: {point_map.n_points} points as {kind}")
    print(f"coordinates: {frame.told()}")
    dropped = ["ground heights (measured again on import)"]
    if any(t.free is not None for t in point_map.tiles.values()):
        dropped.append("known-free columns")
    if not frame.is_local and out.suffix.lower() in (".pcd", ".ply"):
        dropped.append(f"the name of the coordinate system ({out.suffix} has no place for it)")
    print(f"dropped: {', '.join(dropped)}")


def _lay(point_map: PointMap, out: Path, older: PointMap | None, projector: str | None) -> None:
    from mapvote.formats import autoware_pieces
    from mapvote.formats.maps.autoware import lay_version, names_of

    cloud = autoware_pieces(point_map, out, projector)
    present = (
        frozenset(names_of(str(out), autoware_pieces(older, out, projector))) if older is not None else frozenset()
    )
    with waiting(f"writing {out}"):
        change = lay_version(out, cloud, point_map.version or 0, present=present)
    print(f"{out}: version {change.version}, {change.tiles} Autoware tiles, {change.written} written")
    if older is not None:
        print(
            f"tiles of version {older.version} that are as they were are named, not written: copy this folder over it"
        )


def _follow(
    url: str, folder: Path, projector: str | None, key_file: Path | None, *, keep: int, every: float | None
) -> None:
    """Keep ``folder`` at the newest version, asking ``every`` so many seconds; None: ask once."""
    import time

    from mapvote.client import MapClient, Unreachable

    with MapClient(url, key=key_in(key_file), home=folder / ".mapvote_cache") as client:
        while True:
            try:
                change = follow_once(client, folder, projector, keep)
                if change is not None:
                    tiles = f"{change.tiles} tiles, {change.written} new, {change.deleted} old ones deleted"
                    print(f"{folder}: version {change.version}, {tiles}", flush=True)
            except Unreachable as error:
                if every is None:
                    raise
                print(f"{error}; the folder stays as it is", flush=True)
            if every is None:
                return
            time.sleep(every)


def follow_once(client: MapClient, folder: Path, projector: str | None, keep: int) -> Change | None:
    """Write the server's newest version into ``folder``; None if it is there already.

    The frame is chosen once, with the first version, unless ``projector`` names one: a map that grows does not move.
    MapvoteError if the folder holds another map.
    """
    from mapvote.formats import autoware_pieces
    from mapvote.formats.maps.autoware import check_followed, laid_version, lay_version

    manifest = client.manifest()
    check_followed(folder, manifest.map_id)
    if laid_version(folder) == manifest.version:
        return None
    cloud = autoware_pieces(client.fetch(), folder, projector)
    assert client.version is not None
    return lay_version(folder, cloud, client.version, keep=keep, map_id=manifest.map_id)


def update(
    map_path: Annotated[Path, typer.Argument(metavar="MAP", help="a map, in any format")],
    ballot_files: Annotated[list[Path], typer.Argument(metavar="BALLOT...", help="ballots of one round")],
    out: Annotated[Path | None, typer.Option(metavar="MAP", help="the updated map to write, a folder")] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="decide and report, but write no map")] = False,
    cells: Annotated[Path | None, typer.Option(metavar="NPZ", help="also write the decided states of cells")] = None,
    min_votes: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="vehicles that a change needs; default: the settings")
    ] = None,
    false_deletions: Annotated[
        float | None,
        typer.Option(
            metavar="P",
            help="keep the points of a cell if the probability of a false deletion is higher than this, e.g. 0.01",
        ),
    ] = None,
    config: Config = None,
) -> None:
    """Fuse ballots offline and edit the map: add, delete, keep.

    A change needs a majority of the vehicles that determined the cell, and at least --min-votes of them. The default is
    that of the settings, or 1 for ballots of the paper's rule. With --false-deletions P a cell keeps its points, and is
    listed, while the probability that emptying it deletes something that stands is above P.

        mapvote update my_map car_1.ballot car_2.ballot --out my_map_updated
    """
    import numpy as np

    from mapvote.codec.ballot import decode
    from mapvote.config import load_with_sources
    from mapvote.core.grid import CELL_SIZE
    from mapvote.core.rule import rule_named
    from mapvote.formats import write_map
    from mapvote.formats.atomic import whole_file
    from mapvote.fusion.fuse import states_over, update_map

    check_ending(cells, "--cells", ".npz")
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
    own_quorum = rule_named(ballots[0].method).min_votes if ballots and "fuse.min_votes" not in sources else None
    settings = settings.model_copy(
        update={
            "min_votes": min_votes or own_quorum or settings.min_votes,
            "false_deletions": settings.false_deletions if false_deletions is None else false_deletions,
        }
    )
    with waiting(f"reading {map_path}"):
        before = sound_map(map_path)
    with waiting("deciding"):
        after, decisions = update_map(before, ballots, settings)
    if cells is not None:
        states, grid = states_over(before.lattice, decisions)
        with whole_file(cells) as part, part.open("wb") as npz:
            np.savez_compressed(npz, states=states, x0=grid.x0, y0=grid.y0, cell_size=CELL_SIZE)
    if out is not None and not dry_run:
        with waiting(f"writing {out}"):
            write_map(after, out)
    _report(decisions, len({ballot.vehicle for ballot in ballots}), settings.min_votes)
    _report_pending(decisions, before.lattice, settings.false_deletions)
    print(f"updated map: {out}" if out is not None and not dry_run else "dry run: no map written")


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
    added = sum(d.added for d in decisions.values())
    deleted = sum(d.deleted for d in decisions.values())
    print(f"{vehicles} vehicles, {len(decisions)} tiles: {added} points added, {deleted} deleted")
    copies = Counter((copy.vehicle, copy.heard_vehicle) for d in decisions.values() for copy in d.copies)
    for (vehicle, heard), tiles in sorted(copies.items()):
        tiles_of = f"{tiles} tile{'s' if tiles > 1 else ''}"
        print(f"{vehicle} sent a copy of {heard}'s ballot, on {tiles_of}: the two count as one vehicle there")
    if vehicles < min_votes:
        print(f"A change needs {min_votes} vehicles and {vehicles} voted, so nothing can change: --min-votes 1")


def _report_pending(decisions: dict[TileIndex, Decision], lattice: Lattice, budget: float) -> None:
    """Deletions that wait, the largest first, and the places where a vehicle should drive by."""
    from mapvote.fusion.loss_budget import waypoints

    waiting = waypoints({index: d.pending for index, d in decisions.items()}, lattice)
    if not waiting:
        return
    cells = sum(point.cells for point in waiting)
    keep = "1 cell keeps its" if cells == 1 else f"{cells} cells keep their"
    print(f"{keep} points: that something there still stands is likelier than {budget:g}. Drive by:")
    rows = [(f"{p.x:.1f}, {p.y:.1f}", str(p.cells), f"{p.probability:.2g}") for p in waiting[:10]]
    print_table(("x, y (map metres)", "cells", "likeliest"), rows)
    if len(waiting) > 10:
        print(f"and {len(waiting) - 10} smaller ones")
