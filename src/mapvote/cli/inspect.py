"""Verbs that look into a STORE: what happened, who voted strangely, what changed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from mapvote.cli.options import SERVER, KeyFile, StoreOrUrl
from mapvote.cli.remote import is_url, server_at
from mapvote.cli.store import opened_store, when
from mapvote.cli.terminal import print_table, waiting


def register(app: typer.Typer) -> None:
    """Add these verbs to ``app``."""
    for verb in (log, explain, vehicles, changes):
        app.command(rich_help_panel=SERVER)(verb)


def log(
    store: StoreOrUrl,
    events: Annotated[int, typer.Option(min=0, metavar="N", help="also the last so many events")] = 0,
    key_file: KeyFile = None,
) -> None:
    """Versions of a store, and what happened in it.

    mapvote log fleet.db --events 20
    """
    from mapvote.server.views.overview import log_of

    if is_url(store):
        with server_at(store, key_file) as server:
            told = server.ask_json("GET", f"/v1/log?events={events}")
    else:
        with opened_store(store) as opened:
            told = log_of(opened, events)
    rows = []
    for v in told["versions"]:
        origin = v["target"] if v["target"] is not None else v["parent"]
        made = v["kind"], str(origin or ""), when(v["created_ns"]), v["published_by"], v["reason"]
        rows.append((str(v["number"]), *made))
    print_table(("version", "kind", "from", "when", "by", "reason"), rows)
    for event in told["events"]:
        print(f"{event['seq']} {when(event['at_ns'])} {event['kind']} {event['actor']} {event['detail']}")


def explain(
    store: StoreOrUrl,
    x: Annotated[float, typer.Argument(metavar="X", help="map metres; after -- if one is negative")],
    y: Annotated[float, typer.Argument(metavar="Y", help="map metres")],
    key_file: KeyFile = None,
) -> None:
    """Why a cell of the map is as it is: every vote on it, which version counted it, or why it does not count.

    mapvote explain fleet.db 12.5 -- -3.0
    """
    from mapvote.server.views.explain import explain_cell, story_as_json

    if is_url(store):
        with server_at(store, key_file) as server:
            told = server.ask_json("GET", f"/v1/cells?x={x}&y={y}")
    else:
        with opened_store(store) as opened:
            told = story_as_json(explain_cell(opened, x, y))
    print(f"cell {told['row']}, {told['col']}: {told['thing'] or 'empty'}")
    for decision in told["decisions"]:
        print(f"version {decision['version']} decided {decision['state']}")
    if told.get("probability") is not None:
        print(f"the last of them is right with a probability of {told['probability']:.2f}")
    rows = []
    for v in told["votes"]:
        counted = ", ".join(str(number) for number in v["counted_in"])
        counts = "counts" if v["counts"] else v["why"]
        ended = v["end"][:19].replace("T", " ") + "Z" if "end" in v else when(v["end_ns"])
        sure = "" if v.get("sure") is None else f"{100 * v['sure']:.0f} %"
        rows.append((v["vehicle"], v["drive"], ended, str(v["version"]), v["state"], sure, counted, counts))
    print_table(("vehicle", "drive", "ended", "drove with", "says", "sure", "counted in", "now"), rows)


def vehicles(store: StoreOrUrl, key_file: KeyFile = None) -> None:
    """Which vehicles contradict the others far more than chance, and where.

    mapvote vehicles fleet.db
    """
    from dataclasses import asdict

    from mapvote.server.views.history import vehicle_standings

    if is_url(store):
        with server_at(store, key_file) as server, waiting("comparing votes"):
            found = server.ask_json("GET", "/v1/vehicles")["vehicles"]
    else:
        with opened_store(store) as opened, waiting("comparing votes"):
            found = [asdict(standing) for standing in vehicle_standings(opened)]
    rows = []
    for s in found:
        places = "; ".join(f"{e['says']} at {e['x']:.1f}, {e['y']:.1f} ({e['cells']} cells)" for e in s["evidence"][:3])
        counts = str(s["cells"]), str(s["objects"]), str(s["others_objects"]), f"{s['p_value']:.2g}"
        rows.append((s["vehicle"], s["verdict"], *counts, places))
    print_table(("vehicle", "verdict", "cells compared", "contradictions", "of the others", "p", "the largest"), rows)
    print(
        "Compared where others agree both before and after a vehicle passed; the first and the last cannot be judged."
    )


def changes(
    store: StoreOrUrl,
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
    key_file: KeyFile = None,
) -> None:
    """What was built and demolished between two versions: GeoJSON in longitude and latitude, or a GeoPackage.

    A GeoPackage is in the map's own coordinate system. A map in local metres gives metres, and says so.

    mapvote changes fleet.db --out changes.geojson
    """
    from mapvote.formats.atomic import whole_file
    from mapvote.server.views.history import changes_between, page_between

    package = out is not None and out.suffix.lower() == ".gpkg"
    if is_url(store):
        asked = f"from={old}&min_cells={min_cells}" + ("" if new is None else f"&to={new}")
        with server_at(store, key_file) as server, waiting("comparing versions"):
            found = server.ask_json("GET", f"/v1/changes?{asked}&lonlat={str(not (metres or package)).lower()}")
            text = server.ask("GET", f"/v1/changes/page?{asked}").text if page is not None else ""
    else:
        with opened_store(store) as opened, waiting("comparing versions"):
            newest = opened.current() if new is None else new
            found = changes_between(opened, old, newest, min_cells, lonlat=not (metres or package))
            text = page_between(opened, old, newest, found) if page is not None else ""
    if page is not None:
        with whole_file(page) as part:
            part.write_text(text)
        print(f"the largest of {len(found['features'])} changes in {page}")
        if out is None:
            return
    _write_changes(found, out)


def _write_changes(found: dict[str, Any], out: Path | None) -> None:
    import json

    from mapvote.formats.atomic import whole_file
    from mapvote.formats.geo.geopackage import write_geopackage
    from mapvote.formats.geo.projector import frame_of

    if found.get("damaged"):
        left_out = "; ".join(found["damaged"])
        typer.echo(f"left out: tiles {left_out} are damaged (mapvote check tells more)", err=True)
    if out is None:
        print(json.dumps(found, indent=1))
        return
    if out.suffix.lower() == ".gpkg":
        write_geopackage(out, found["features"], frame_of(found["georeference"]))
    else:
        with whole_file(out) as part:
            part.write_text(json.dumps(found, indent=1) + "\n")
    print(f"{len(found['features'])} objects in {out}")
