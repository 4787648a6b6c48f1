"""follow: a folder that is always the server's newest map, for a stack that reads files."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapvote.cli.options import SERVER, KeyFile, Projector, key_in

if TYPE_CHECKING:
    from mapvote.client import MapClient
    from mapvote.formats.maps.autoware import Change


def register(app: typer.Typer) -> None:
    """Add the verb to ``app``."""
    app.command(rich_help_panel=SERVER)(follow)


def follow(
    url: Annotated[str, typer.Argument(metavar="URL", help="the server")],
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="kept as the server's newest map")],
    autoware: Annotated[bool, typer.Option("--autoware", help="as Autoware's tiles (the only layout so far)")] = False,
    projector: Projector = None,
    keep: Annotated[int, typer.Option(min=0, metavar="N", help="older versions whose tiles stay")] = 3,
    every: Annotated[float, typer.Option(min=0.1, metavar="SECONDS", help="how often to ask")] = 30.0,
    once: Annotated[bool, typer.Option("--once", help="ask once and end")] = False,
    key_file: KeyFile = None,
) -> None:
    """Keep a folder current for a running Autoware: tiles whose names change with their content.

    mapvote follow https://maps.example.org map --autoware --key-file key
    """
    from mapvote.client import MapClient, Unreachable
    from mapvote.core.types import MapvoteError

    if not autoware:
        raise MapvoteError("follow: say --autoware; other layouts are written by mapvote export")
    home = folder / ".mapvote_cache"
    with MapClient(url, key=key_in(key_file), home=home) as client:
        while True:
            try:
                change = follow_once(client, folder, projector, keep)
                if change is not None:
                    print(
                        f"{folder}: version {change.version}, {change.tiles} tiles, {change.written} new, "
                        f"{change.deleted} old ones deleted",
                        flush=True,
                    )
            except Unreachable as error:
                if once:
                    raise
                print(f"{error}; the folder stays as it is", flush=True)
            if once:
                return
            time.sleep(every)


def follow_once(client: MapClient, folder: Path, projector: str | None, keep: int) -> Change | None:
    """Lay the server's newest version into ``folder``; None if it is there already.

    The frame is chosen once, with the first version, unless ``projector`` names one: a map that grows does not move.
    """
    from mapvote.formats.maps.autoware import laid_version, lay_version
    from mapvote.formats.maps.exporting import autoware_pieces

    if laid_version(folder) == client.newest():
        return None
    cloud = autoware_pieces(client.fetch(), folder, projector)
    assert client.version is not None
    return lay_version(folder, cloud, client.version, keep=keep)
