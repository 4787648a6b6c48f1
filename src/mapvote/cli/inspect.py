"""Verbs that look into a STORE: what happened, who voted strangely, what changed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mapvote.cli.options import SERVER, StoreName
from mapvote.cli.store import opened_store, when
from mapvote.cli.terminal import print_table, waiting


def register(app: typer.Typer) -> None:
    """Add these verbs to ``app``."""
    for verb in (log, vehicles, changes):
        app.command(rich_help_panel=SERVER)(verb)


def log(
    store: StoreName,
    events: Annotated[int, typer.Option(min=0, metavar="N", help="also the last so many events")] = 0,
) -> None:
    """Versions of a store, and what happened in it.

    mapvote log fleet.db --events 20
    """
    from mapvote.server.insight.history import events as last_events

    with opened_store(store) as opened:
        versions, happened = opened.versions(), last_events(opened, events) if events else []
    rows = []
    for v in versions:
        origin = v.target if v.target is not None else v.parent
        rows.append((str(v.number), v.kind, str(origin or ""), when(v.created_ns), v.published_by, v.reason))
    print_table(("version", "kind", "from", "when", "by", "reason"), rows)
    for event in happened:
        print(f"{event['seq']} {when(event['at_ns'])} {event['kind']} {event['actor']} {event['detail']}")


def vehicles(store: StoreName) -> None:
    """Which vehicles contradict the others far more than chance, and where.

    mapvote vehicles fleet.db
    """
    from mapvote.server.insight.history import vehicle_standings

    with opened_store(store) as opened, waiting("comparing votes"):
        found = vehicle_standings(opened)
    rows = []
    for s in found:
        places = "; ".join(f"{e.says} at {e.x:.1f}, {e.y:.1f} ({e.cells} cells)" for e in s.evidence[:3])
        counts = str(s.cells), str(s.objects), str(s.others_objects), f"{s.p_value:.2g}"
        rows.append((s.vehicle, s.verdict, *counts, places))
    print_table(("vehicle", "verdict", "cells compared", "contradictions", "of the others", "p", "the largest"), rows)
    print(
        "Compared where others agree both before and after a vehicle passed; the first and the last cannot be judged."
    )


def changes(
    store: StoreName,
    old: Annotated[int, typer.Option("--from", metavar="VERSION", help="the older version")] = 1,
    new: Annotated[int | None, typer.Option("--to", metavar="VERSION", help="the newer; else the newest")] = None,
    min_cells: Annotated[int, typer.Option(min=1, metavar="N", help="leave out smaller objects")] = 1,
    metres: Annotated[bool, typer.Option("--metres", help="map metres, even if the map knows where it lies")] = False,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help=".geojson, or .gpkg (GeoPackage); else it is printed")
    ] = None,
    page: Annotated[
        Path | None,
        typer.Option("--html", metavar="FILE", help="one page with the clouds of the largest, before and after"),
    ] = None,
) -> None:
    """What was built and demolished between two versions: GeoJSON in longitude and latitude, or a GeoPackage.

    A GeoPackage is in the map's own coordinate system. A map in local metres gives metres, and says so.

    mapvote changes fleet.db --out changes.geojson
    """
    import json

    from mapvote.formats.atomic import whole_file
    from mapvote.formats.geo.frame import frame_of
    from mapvote.formats.geo.geopackage import write_geopackage
    from mapvote.server.insight.cutout import whole_page
    from mapvote.server.insight.history import changes_between, cutouts_between

    package = out is not None and out.suffix.lower() == ".gpkg"
    with opened_store(store) as opened, waiting("comparing versions"):
        newest = opened.current() if new is None else new
        found = changes_between(opened, old, newest, min_cells, lonlat=not (metres or package))
        cutouts = cutouts_between(opened, old, newest, found) if page is not None else []
    if page is not None:
        with whole_file(page) as part:
            part.write_text(whole_page(f"{found['map_id']}: version {old} to {newest}", cutouts))
        print(f"{len(cutouts)} of {len(found['features'])} changes in {page}")
        if out is None:
            return
    text = json.dumps(found, indent=1)
    if out is None:
        print(text)
        return
    if package:
        write_geopackage(out, found["features"], frame_of(found["georeference"]))
    else:
        with whole_file(out) as part:
            part.write_text(text + "\n")
    print(f"{len(found['features'])} objects in {out}")
