"""A STORE, or the URL of a server that keeps one: verbs that take either ask here which it is."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from mapvote.cli.looks import sound_map
from mapvote.cli.options import key_in
from mapvote.cli.store import opened_store, when

if TYPE_CHECKING:
    from mapvote.client import MapClient
    from mapvote.client.connection import Connection
    from mapvote.client.map_client import Region
    from mapvote.core.point_map import PointMap

_SQLITE = b"SQLite format 3\0"


def is_url(name: str) -> bool:
    """Whether this is a server's address."""
    return name.startswith(("http://", "https://"))


def is_store(name: str) -> bool:
    """Whether this is a database's address, or an SQLite file."""
    if name == "-" or ("://" in name and not is_url(name)):
        return True
    try:
        with Path(name).open("rb") as file:
            return file.read(len(_SQLITE)) == _SQLITE
    except OSError:
        return False


@contextmanager
def server_at(url: str, key_file: Path | None) -> Iterator[Connection]:
    """A line to a server, for those who look at it and run it."""
    from mapvote.client.connection import Connection

    server = Connection(url, key=key_in(key_file), timeout_s=600.0)
    try:
        yield server
    finally:
        server.close()


def client_of(url: str, key: str | None) -> MapClient:
    """A vehicle's line to a server; what it keeps lies in the user's cache."""
    from mapvote.client import MapClient
    from mapvote.config import cache_folder

    return MapClient(url, key=key, home=cache_folder())


@contextmanager
def map_at(
    name: str,
    key_file: Path | None,
    version: int | None = None,
    region: Region | None = None,
    *,
    or_kept: bool = False,
) -> Iterator[PointMap]:
    """The newest map of a store or a server, or one version of it; or a map in any file format. Of a map larger than
    memory tiles are read as long as this is open. ``region``: only the tiles of a server's map that touch it.
    ``or_kept``: if the server is away, the map that was fetched last, and a warning."""
    from mapvote.client import Unreachable
    from mapvote.core.types import MapvoteError

    if is_url(name):
        with client_of(name, key_in(key_file)) as client:
            try:
                point_map = client.fetch(version, region=region)
            except Unreachable as error:
                if not or_kept:
                    raise
                point_map = client.fetch_kept(region)
                print(f"warning: {error}. Version {point_map.version} is kept here and used", file=sys.stderr)
            yield point_map
        return
    if region is not None:
        raise MapvoteError(f"{name}: only a server sends a part of its map; leave out --region")
    if is_store(name):
        with opened_store(name) as store:
            yield store.point_map(version)
        return
    if version is not None:
        raise MapvoteError(f"{name}: only a store or a server has versions")
    yield sound_map(name)


def region_in(text: str) -> Region:
    """X0,Y0,X1,Y1; MapvoteError if it is none."""
    from mapvote.core.types import MapvoteError

    try:
        x0, y0, x1, y1 = map(float, text.split(","))
    except ValueError:
        raise MapvoteError(f"--region {text}: give X0,Y0,X1,Y1 in map metres, lower left and upper right") from None
    if not (x0 < x1 and y0 < y1):
        raise MapvoteError(f"--region {text}: holds nothing; give the lower left corner first, then the upper right")
    return x0, y0, x1, y1


def overview_of(name: str, key_file: Path | None) -> list[tuple[str, str]] | None:
    """What is in a store or behind a server, as rows; None if this is neither."""
    if is_url(name):
        with server_at(name, key_file) as server:
            found = server.ask_json("GET", "/v1/info")
    elif is_store(name):
        from mapvote.server.views.overview import overview

        with opened_store(name) as store:
            found = overview(store)
    else:
        return None
    published = when(found.pop("published_ns"))
    rows = [(key.replace("_", " "), f"{value:,}" if isinstance(value, int) else value) for key, value in found.items()]
    return [*rows, ("published", published)]
