"""The verbs of whole clouds: diff and merge, and how a cloud votes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapvote.cli.terminal import print_table, waiting

if TYPE_CHECKING:
    from mapvote.codec.ballot import Ballot
    from mapvote.config import Settings
    from mapvote.core.point_map import PointMap


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

    from mapvote.comparison.cloud_changes import (
        compare_cells,
        difference_geojson,
        difference_page,
        difference_rows,
        differences,
    )
    from mapvote.comparison.register import brought_into
    from mapvote.formats import read_map
    from mapvote.formats.atomic import whole_file
    from mapvote.server.views.geojson import as_csv

    with waiting(f"reading {path_a} and {path_b}"):
        map_a, map_b = read_map(path_a), read_map(path_b)
    with waiting("registering B to A"):
        map_b, registered = brought_into(map_a, map_b, unbend=unbend)
    with waiting("comparing"):
        compared = compare_cells(map_a, map_b, registered)
        found = differences(compared, min_area)
    told = registered.told()
    by_free = bool(compared.a.free.any() or compared.b.free.any())
    told.append(
        "gone and new are decided by free space and by ground that the other one shows"
        if by_free
        else "neither has free space: gone and new are decided by geometry alone (the other has ground there, and "
        "nothing that stands within two cells)"
    )
    for line in told:
        print(line)
    listed = [one for one in found if show_not_seen or one.kind != "not seen"]
    rows = difference_rows(listed)
    shown = ("id", "kind", "x", "y", "area_m2", "height_m", "points", "confidence")
    print_table(shown, [tuple(str(row[name]) for name in shown) for row in rows])
    for kind in ("gone", "new", "not seen"):
        some = [one for one in found if one.kind == kind]
        print(f"{kind}: {len(some)} things, {sum(one.area_m2 for one in some):.1f} m2")
    left_out = float(compared.left_out.sum()) * 0.09
    if left_out:
        print(f"left out in bent parts: {left_out:.1f} m2 of cells")
    written = []
    if out is not None:
        collection = difference_geojson(found, map_a.lattice, map_a.georeference, told)
        written.append((out, json.dumps(collection, indent=1) + "\n"))
    if csv is not None:
        written.append((csv, as_csv(difference_rows(found))))
    if page is not None:
        written.append((page, difference_page(f"{path_a.name} and {path_b.name}", found, map_a, map_b)))
    for file, text in written:
        with whole_file(file) as part:
            part.write_text(text)
        print(f"{file}")


def merge(
    paths: Annotated[list[Path], typer.Argument(metavar="MAP...", help="maps that overlap, in any format and frame")],
    out: Annotated[Path, typer.Option(metavar="MAP", help="the map to write; a folder that does not exist yet")],
) -> None:
    """Merge overlapping maps into one, in the frame of the first: registered, adjusted together, one point per voxel.

    mapvote merge north.laz south.laz --out town
    """
    from mapvote.comparison.merge import merge_maps
    from mapvote.formats import read_map, write_map

    if out.exists():
        raise typer.BadParameter(f"{out} exists; name a new folder", param_hint="--out")
    with waiting("reading"):
        maps = [read_map(path) for path in paths]
    with waiting("registering and merging"):
        merged = merge_maps(maps)
    for (i, j), far in merged.apart_m.items():
        print(f"{paths[i]} and {paths[j]}: {far:.3f} m apart after adjustment (median)")
    with waiting(f"writing {out}"):
        write_map(merged.point_map, out)
    print(f"{out}: {merged.point_map.n_points} points")


def ballot_of_cloud(
    path: Path, point_map: PointMap, settings: Settings, vehicle: str | None, trajectory: Path | None
) -> Ballot:
    """The ballot of a session's cloud; prints its registration and where it does not vote. It ended when the file
    was last changed."""
    from mapvote.comparison.session_votes import vote_of_session
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
        print("what is bent does not vote")
    if not said.by_trajectory:
        print("no trajectory: gone and new by the ground that the cloud shows, and no free space is learned")
    for kind in ("gone", "new", "not seen"):
        some = [one for one in said.changes if one.kind == kind]
        print(f"{kind}: {len(some)} things, {sum(one.area_m2 for one in some):.1f} m2")
    return said.ballot
