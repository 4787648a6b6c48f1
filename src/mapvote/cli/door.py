"""How a verb reaches drives, and a map: a file, a STORE (a database), or the URL of a server.

A STORE is opened in this process behind the same HTTP API as a server: a verb is written once. Drives and maps of files
are checked by the doctor's cheap checks: an error stops the verb, warnings go to stderr.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from mapvote.cli.terminal import complain, progress
from mapvote.core.types import MapvoteError

if TYPE_CHECKING:
    from mapvote.client import MapClient
    from mapvote.client.connection import Connection
    from mapvote.client.map_client import Region
    from mapvote.config import Settings
    from mapvote.core.point_map import PointMap
    from mapvote.core.types import Drive
    from mapvote.doctor import Finding
    from mapvote.doctor.scans import Looking
    from mapvote.formats.maps.tiling import Look
    from mapvote.server.store.store import Store

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


def key_in(key_file: Path | None) -> str | None:
    """The key in a file, or in $MAPVOTE_KEY: everybody on the machine can read a command line."""
    if key_file is None:
        return os.environ.get("MAPVOTE_KEY") or None
    try:
        return key_file.read_text().strip() or None
    except (OSError, UnicodeDecodeError) as error:
        raise MapvoteError(f"{key_file}: holds no key that can be read ({error})") from error


@contextmanager
def api_at(
    name: str, key_file: Path | None = None, settings: Settings | None = None, executor: Executor | None = None
) -> Iterator[Connection]:
    """The HTTP API of a server, or of a STORE within this process.

    ``settings`` and ``executor`` are those of a STORE's fusion. A Ctrl-C ends the process at once: the API works in
    other threads, and a transaction that is not finished leaves nothing behind, as after a kill -9.
    """
    from mapvote.client.connection import Connection

    if is_url(name):
        with closing(Connection(name, key=key_in(key_file), timeout_s=600.0)) as server:
            yield server
        return
    from mapvote.server.http.app import URL, in_process
    from mapvote.server.views.localisation_gate import gate_by

    gate = None if settings is None else gate_by(settings.ndt)
    with (
        opened_store(name) as store,
        _errors_only(),
        in_process(store, settings, owner=who(), gate=gate, executor=executor) as transport,
    ):
        try:
            yield Connection(URL, name=name, attempts=1, timeout_s=None, transport=transport)
        except KeyboardInterrupt:
            complain("interrupted; what was not finished was not written")
            os._exit(130)


@contextmanager
def _errors_only() -> Iterator[None]:
    """The API logs every request, to stdout; a verb's stdout is its answer."""
    import logging

    import structlog

    before = structlog.get_config()
    structlog.configure(
        wrapper_class=structlog.make_filtering_bound_logger(logging.ERROR),
        logger_factory=structlog.PrintLoggerFactory(sys.stderr),
    )
    try:
        yield
    finally:
        structlog.configure(**before)


def client_of(url: str, key: str | None) -> MapClient:
    """A vehicle's connection to a server; its files are in the user's cache."""
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
    """The newest map of a store or a server, or one version of it; or a map in any file format.

    Tiles of a map larger than memory are read while this is open. ``region``: only the tiles of a server's map that
    touch it. ``or_kept``: if the server does not answer, the map that was fetched last, with a warning.
    """
    from mapvote.client import Unreachable

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
    """X0,Y0,X1,Y1 in map metres; MapvoteError if it is none."""
    try:
        x0, y0, x1, y1 = map(float, text.split(","))
    except ValueError:
        raise MapvoteError(f"--region {text}: give X0,Y0,X1,Y1 in map metres, lower left and upper right") from None
    if not (x0 < x1 and y0 < y1):
        raise MapvoteError(f"--region {text}: is empty; give the lower left corner first, then the upper right")
    return x0, y0, x1, y1


def store_url(name: str) -> str:
    """The database URL of STORE on the command line. MapvoteError if it shows a password."""
    from sqlalchemy.engine import make_url
    from sqlalchemy.exc import ArgumentError

    from mapvote.server.store.store import url_of

    given = os.environ.get("MAPVOTE_STORE", "") if name == "-" else name
    if not given:
        raise MapvoteError("STORE is -, but MAPVOTE_STORE is not set")
    if is_url(given):
        raise MapvoteError(f"{given}: this is a server. Name the STORE (a file or a database) on the server's machine")
    try:
        password = make_url(url_of(given)).password
    except ArgumentError:
        raise MapvoteError("STORE is no database URL: postgresql+psycopg://USER@HOST/NAME") from None
    if password is not None and name != "-":
        mend = "set MAPVOTE_STORE to the URL and give - as STORE, or keep the password in ~/.pgpass"
        raise MapvoteError(f"everybody on this machine can read a password on the command line: {mend}")
    return url_of(given)


def opened_store(name: str) -> closing[Store]:
    """An existing store, closed at the end."""
    from mapvote.server.store.store import Store

    return closing(Store.open(store_url(name)))


def who() -> str:
    """The login name of the user of this machine, for a store's log."""
    import getpass

    try:
        return getpass.getuser()
    except (KeyError, OSError):  # no name for this number
        return "operator"


def when(stamp_ns: int) -> str:
    """A time stamp as text, UTC."""
    from datetime import UTC, datetime

    return datetime.fromtimestamp(stamp_ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%SZ")


@contextmanager
def usable_drives(drives: Sequence[Drive]) -> Iterator[list[Drive]]:
    """The drives, checked while they are read; nothing may be written before this ends.

    MapvoteError for one that cannot be used so: at once if some of its scans show it, else at the end. Whatever else
    stops the work, what is wrong with a drive is told rather than what came of it.
    """
    from mapvote.doctor.scans import looked_at

    watching = []
    for drive in drives:
        with progress(f"looking at {drive.path}") as tell:
            watching.append(looked_at(drive, tell))
    try:
        yield [one.drive for one in watching]
    except MapvoteError:
        _warnings_of(watching)
        raise
    for path, found in _warnings_of(watching):
        _warn(path, found)


def _warnings_of(watching: list[Looking]) -> list[tuple[str, list[Finding]]]:
    found = []
    for one in watching:
        with progress(f"looking at {one.drive.path}") as tell:
            found.append((str(one.drive.path), one.warnings(tell)))
    return found


def sound_map(path: Path | str) -> PointMap:
    """A map in any file format; MapvoteError for one that cannot be used so."""
    from mapvote.formats import read_map

    return read_map(path, look_at_points(str(path)))


def look_at_points(path: str) -> Look:
    """The check of a map's points before the ground is computed: MapvoteError if they cannot be used."""
    from mapvote.doctor import usable
    from mapvote.doctor.maps import check_cloud

    return lambda pieces: _warn(path, usable(path, check_cloud(pieces)))


def _warn(path: str, found: list[Finding]) -> None:
    for finding in found:
        print(f"warning: {path}: {finding.what}", file=sys.stderr)
