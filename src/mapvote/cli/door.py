"""How a verb reaches drives, and a map: a file, a STORE (a database), or the URL of a server.

A STORE is opened in this process behind the same HTTP API as a server: a verb is written once. Drives and maps of files
are checked by the doctor's cheap checks: an error stops the verb, warnings go to stderr.
"""

from __future__ import annotations

import math
import os
import re
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import replace
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

from mapvote.cli.terminal import progress, waiting
from mapvote.core.types import MapvoteError

if TYPE_CHECKING:
    from mapvote.client import MapClient
    from mapvote.client.connection import Connection
    from mapvote.client.map_client import Region
    from mapvote.config import Settings
    from mapvote.core.point_map import PointMap
    from mapvote.core.types import Drive
    from mapvote.doctor import Finding
    from mapvote.doctor.localised import LocalisedDrive
    from mapvote.doctor.scans import Looking
    from mapvote.formats.maps.tiling import Look, Pieces
    from mapvote.perception.frontend import DriveReport


def is_url(name: str) -> bool:
    """Whether this is a server's address."""
    return name.startswith(("http://", "https://"))


def is_store(name: str) -> bool:
    """Whether this is a database's address, or an SQLite file."""
    if name == "-" or ("://" in name and not is_url(name)):
        return True
    magic = b"SQLite format 3\0"
    try:
        with Path(name).open("rb") as file:
            return file.read(len(magic)) == magic
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
    with ExitStack() as opened:
        with waiting(f"opening {name}"):
            connection = opened.enter_context(stores().api_of(name, settings, executor))
        yield connection


def stores() -> Stores:
    """The package that opens stores; the entry point group ``mapvote.stores`` names it. MapvoteError if none is
    installed."""
    for entry in entry_points(group="mapvote.stores"):
        return cast("Stores", entry.load())
    raise MapvoteError("no installed package opens a STORE: pip install 'mapvote[server]', or name a server's URL")


class Stores(Protocol):
    """The functions of :mod:`mapvote_server.stores` that verbs use; this package does not know of it."""

    def api_of(
        self, name: str, settings: Settings | None, executor: Executor | None
    ) -> AbstractContextManager[Connection]:
        """The HTTP API of a STORE within this process."""

    def map_of_store(self, name: str, version: int | None, *, origins: bool) -> AbstractContextManager[PointMap]:
        """The newest map of a STORE, or one version of it; its tiles are read while this is open. ``origins``: with the
        version and the votes behind each point."""

    def findings_of(self, name: str) -> list[Finding]:
        """Everything that is wrong with a STORE."""


def client_of(url: str, key: str | None) -> MapClient:
    """A vehicle's connection to a server; its files are in the user's cache."""
    from mapvote.client import MapClient
    from mapvote.config import cache_folder

    return MapClient(url, key=key, home=cache_folder())


def all_changes(server: Connection, query: str) -> dict[str, Any]:
    """The list of changes that a query of ``/v1/changes`` asks for, part by part."""
    whole = server.ask_json("GET", f"/v1/changes?{query}&limit=10000")
    part = whole
    while part["features"] and len(whole["features"]) < whole["numberMatched"]:
        versions = f"{query}&to={whole['to_version']}"
        part = server.ask_json("GET", f"/v1/changes?{versions}&limit=10000&offset={len(whole['features'])}")
        whole["features"] += part["features"]
    return {name: value for name, value in whole.items() if name not in ("numberMatched", "numberReturned")}


@contextmanager
def map_at(
    name: str,
    key_file: Path | None,
    version: int | None = None,
    region: Region | None = None,
    *,
    or_kept: bool = False,
    origins: bool = False,
) -> Iterator[PointMap]:
    """The newest map of a store or a server, or one version of it; or a map in any file format.

    Tiles of a map larger than memory are read while this is open. ``region``: only the tiles of a server's map that
    touch it. ``or_kept``: if the server does not answer, the map that was fetched last, with a warning. ``origins``: a
    store's points have the version and the votes behind them as fields.
    """
    if is_url(name):
        from mapvote.client import Unreachable

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
        with stores().map_of_store(name, version, origins=origins) as newest:
            yield newest
        return
    if version is not None:
        raise MapvoteError(f"{name}: only a store or a server has versions")
    yield sound_map(name)


def numbers_in(text: str, option: str, wanted: str, count: int) -> tuple[float, ...]:
    """``count`` finite numbers separated by commas. MapvoteError says what ``option`` wants: ``wanted``."""
    try:
        numbers = tuple(float(number) for number in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise MapvoteError(f"{option} {text}: give {wanted}")
    return numbers


def check_ending(file: Path | None, option: str, *endings: str) -> None:
    """MapvoteError if a file to write has none of the ``endings``, which say the format, or if its format needs a
    package that is not installed."""
    from mapvote.core.extras import require_for

    if file is None:
        return
    if file.suffix.lower() not in endings:
        raise MapvoteError(f"{option} {file}: its format is {' or '.join(endings)}; give the file that ending")
    require_for(file, f"{option} {file}")


def named_after(folder: Path, point_map: PointMap) -> PointMap:
    """The map with a name that people can read: that of its folder, and eight digits of its content's hash, which
    tell maps of one name apart."""
    name = re.sub(r"[^A-Za-z0-9._-]+", "_", folder.name)[:40]
    return replace(point_map, map_id=f"{name}-{point_map.map_id[:8]}")


def region_in(text: str) -> Region:
    """X0,Y0,X1,Y1 in map metres; MapvoteError if it is none."""
    wanted = "X0,Y0,X1,Y1 in map metres, lower left and upper right"
    x0, y0, x1, y1 = numbers_in(text, "--region", wanted, 4)
    if not (x0 < x1 and y0 < y1):
        raise MapvoteError(f"--region {text}: is empty; give the lower left corner first, then the upper right")
    return x0, y0, x1, y1


@contextmanager
def usable_drives(drives: Sequence[Drive], *, unchecked: bool = False) -> Iterator[list[Drive]]:
    """The drives, checked while they are read; nothing may be written before this ends.

    MapvoteError for one that cannot be used so: at once if some of its scans show it, else at the end. Whatever else
    stops the work, what is wrong with a drive is told rather than what came of it. ``unchecked``: an error is told as a
    warning.
    """
    from mapvote.doctor.scans import Looking, looked_at

    watching = []
    for drive in drives:
        with progress(f"looking at {drive.path}") as tell:
            watching.append(Looking(drive) if unchecked else looked_at(drive, tell))
    try:
        yield [one.drive for one in watching]
    except MapvoteError:
        if not unchecked:
            _warnings_of(watching, unchecked)
        raise
    for path, findings in _warnings_of(watching, unchecked):
        _warn(path, findings)


def _warnings_of(watching: list[Looking], unchecked: bool) -> list[tuple[str, list[Finding]]]:
    findings = []
    for one in watching:
        with progress(f"looking at {one.drive.path}") as tell:
            findings.append((str(one.drive.path), one.warnings(tell, unchecked=unchecked)))
    return findings


def require_straight(drive: Drive, report: DriveReport, point_map: PointMap, *, unchecked: bool = False) -> None:
    """MapvoteError for a drive whose scans fit the map better with other times of points, or whose points lie off the
    map's surfaces: no ballot comes of it. ``unchecked``: a warning."""
    from mapvote.doctor.off_surfaces import check_points

    for finding in check_points(drive, report.T_map_lidar, point_map):
        if finding.severity == "error" and not unchecked:
            raise MapvoteError(f"{drive.path}: {finding.what}. {finding.mend}; nothing was written")
        _warn(str(drive.path), [finding])


def require_localised(localised: LocalisedDrive, drive: Drive, point_map: PointMap | None, unchecked: bool) -> None:
    """MapvoteError for a drive that did not know where it was: no ballot and no map comes of it. ``unchecked``: a
    warning."""
    from mapvote.doctor.localised import check_localised

    for finding in check_localised(localised, point_map):
        if not unchecked:
            raise MapvoteError(
                f"{drive.path}: {finding.what}. {finding.mend} Nothing was written (--unchecked writes all the same)"
            )
        _warn(str(drive.path), [finding])


def sound_map(path: Path | str) -> PointMap:
    """A map in any file format; MapvoteError for one that cannot be used so."""
    from mapvote.formats import read_map

    return read_map(path, look_at_points(str(path)))


def look_at_points(path: str, *, unchecked: bool = False) -> Look:
    """The check of a map's points before the ground is computed: MapvoteError, with the way past, if they cannot be
    used; ``unchecked``: findings are only printed."""
    from mapvote.doctor import usable
    from mapvote.doctor.map_points import check_cloud

    def look(pieces: Pieces, ground: Pieces) -> None:
        findings = check_cloud(pieces, ground)
        try:
            _warn(path, findings if unchecked else usable(path, findings))
        except MapvoteError as error:
            way = f"if they are right as they are: mapvote import '{path}' MAP --unchecked"
            raise MapvoteError(f"{error}; {way}") from None

    return look


def _warn(path: str, findings: list[Finding]) -> None:
    for finding in findings:
        print(f"warning: {path}: {finding.what}", file=sys.stderr)
