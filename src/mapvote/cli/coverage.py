"""Where the fleet should drive next."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from mapvote.cli.door import api_at
from mapvote.cli.options import SERVER, KeyFile
from mapvote.cli.terminal import print_table


def register(app: typer.Typer) -> None:
    """Add coverage."""
    app.command(rich_help_panel=SERVER)(coverage)


def coverage(
    name: Annotated[
        str, typer.Argument(metavar="STORE|URL", help="a STORE (file, database URL or -), or its server's URL")
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="also write all stretches of road as GeoJSON")
    ] = None,
    most: Annotated[int, typer.Option(metavar="N", min=1, help="largest number of rows")] = 20,
    key_file: KeyFile = None,
) -> None:
    """List the roads where one more pass would decide cells, by tile and direction, most cells first.

    A cell counts if one more vehicle with the same vote as an earlier one would decide it.

    mapvote coverage fleet.db --out drive_next.geojson
    """
    from mapvote.formats.atomic import whole_file

    with api_at(name, key_file) as server:
        found = server.ask_json("GET", "/v1/coverage/passes")
    rows = []
    for feature in found["features"][:most]:
        about, line = feature["properties"], feature["geometry"]["coordinates"]
        ends = [f"({x:.0f}, {y:.0f})" for x, y in (line[0], line[-1])]
        counts = (str(about[what]) for what in ("cells", "built", "gone"))
        rows.append((f"{about['row']},{about['col']}", f"{about['heading_deg']}°", *ends, *counts))
    if rows:
        print_table(("tile", "heading", "from (x, y), m", "to", "cells", "built", "gone"), rows, "One more pass")
    else:
        print("no cell waits for one more pass")
    if out is not None:
        with whole_file(out) as partial:
            partial.write_text(json.dumps(found) + "\n")
        print(f"{out}: {len(found['features'])} stretches of road")
