"""The verb that tells editors of HD maps what lies near changes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mapvote.cli.door import check_ending
from mapvote.cli.options import Projector
from mapvote.cli.terminal import print_table


def affected(
    changes: Annotated[
        Path, typer.Argument(metavar="CHANGES", help="GeoJSON of changes: `diff --out`, `log --geojson`, /v1/changes")
    ],
    lanelets: Annotated[Path, typer.Argument(metavar="OSM", help="a lanelet2 file, such as lanelet2_map.osm")],
    within: Annotated[float, typer.Option(min=0.0, metavar="M", help="list what lies so near to a change")] = 2.0,
    projector: Projector = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="also write the list as GeoJSON")] = None,
    csv: Annotated[Path | None, typer.Option(metavar="FILE", help="also write the table as CSV")] = None,
    osm: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="also write a copy of OSM with a tag mapvote:changes on what is listed"),
    ] = None,
) -> None:
    """List the lanelets, stop lines, signs and areas of a lanelet2 map that lie near changes.

    Positions are compared by latitude and longitude where the changes, --projector or the map_projector_info.yaml
    beside OSM name the frame; else by the tags local_x and local_y of the nodes.

    mapvote affected changes.geojson lanelet2_map.osm --osm to_check.osm
    """
    import json

    from mapvote.formats.atomic import write_whole
    from mapvote.formats.geo.frame import PROJECTOR, read_projector
    from mapvote.formats.geo.lanelet2 import read_lanelets
    from mapvote.shapes.affected import (
        affected_geojson,
        affected_parts,
        affected_rows,
        marked_osm,
        read_changes,
        summary,
    )
    from mapvote.shapes.geojson import as_csv

    check_ending(out, "--out", ".geojson", ".json")
    check_ending(csv, "--csv", ".csv")
    check_ending(osm, "--osm", ".osm")
    beside = lanelets.parent / PROJECTOR
    projector = str(beside) if projector is None and beside.is_file() else projector
    places = read_changes(changes, None if projector is None else read_projector(projector))
    lanelet_map = read_lanelets(lanelets, places.frame)
    listed = affected_parts(lanelet_map.parts, places, within)
    rows = affected_rows(listed, places)
    print_table(
        ("kind", "subtype", "id", "distance", "changes"),
        [(r["kind"], r["subtype"], r["id"], f"{r['distance_m']:.2f} m", ", ".join(r["changes"])) for r in rows],
    )
    named = f": {summary(listed)}" if listed else ""
    print(
        f"{len(listed)} of {len(lanelet_map.parts)} parts lie within {within:g} m of {len(places.ids)} changes{named}"
    )
    written = []
    if out is not None:
        written.append((out, json.dumps(affected_geojson(listed, places), indent=1) + "\n"))
    if csv is not None:
        written.append((csv, as_csv(rows)))
    if osm is not None:
        written.append((osm, marked_osm(lanelet_map.tree, listed, places)))
    for file, text in written:
        write_whole(file, text)
        print(f"{file}")
