"""The vehicle's side of a server: it fetches the newest map, and sends ballots without losing one.

client = MapClient("https://maps.example.org", key=..., home=Path("~/.cache/mapvote").expanduser())
point_map = client.fetch()
client.send(ballot)                # kept in the spool and sent later if the server cannot be reached
"""

from __future__ import annotations

import hashlib
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Literal

import msgspec

from mapvote.client.connection import Connection, Refused, Unreachable
from mapvote.codec.ballot import Ballot, decode, encode, tile_index
from mapvote.codec.manifest import Manifest, TileHashes
from mapvote.codec.planes import FRAME_HEAD, compress
from mapvote.codec.tile_planes import check_plane, points_in_plane, unpack_tile
from mapvote.core.grid import CELL_SIZE, Grid
from mapvote.core.point_map import MAP_SIZES, PointMap, made_in_turn
from mapvote.core.tile import Tile
from mapvote.core.types import MapvoteError
from mapvote.formats.atomic import write_whole
from mapvote.formats.reading import first_bytes, read_whole

Sent = Literal["created", "replaced", "repeated", "spooled"]
Region = tuple[float, float, float, float]
"""x and y of the lower left corner, x and y of the upper right one, map metres."""


_DECODER = msgspec.json.Decoder(Manifest)  # made when the module is loaded: see codec/ballot.py


class MapClient:
    """One vehicle's line to one server.

    ``home`` holds planes of tiles by hash, of all servers (``cache_bytes`` at most, beside what the map last fetched
    needs), and for each server the newest manifest and the spool of unsent ballots. ``kept_points``: points of the
    largest map that is held in memory whole.
    """

    def __init__(
        self,
        url: str,
        *,
        home: Path,
        key: str | None = None,
        attempts: int = 4,
        timeout_s: float = 30.0,
        cache_bytes: int = 4_000_000_000,
        kept_points: int = MAP_SIZES.kept_points,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        self._server = Connection(url, key=key, attempts=attempts, timeout_s=timeout_s, sleep=sleep)
        self._url = url
        self._planes = home / "planes"
        self._spool = _Spool(home, url)
        self._kept_manifest = _server_folder(home, url) / "manifest.json"
        self._cache_bytes = cache_bytes
        self._kept_points = kept_points
        self.version: int | None = None
        """Version of the map last fetched."""

    def __enter__(self) -> MapClient:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._server.close()

    def fetch(self, version: int | None = None, *, region: Region | None = None) -> PointMap:
        """The newest map, or one version; only planes that ``home`` lacks are downloaded, and of the list of tiles only
        what changed.

        ``region``: only tiles that touch it. A ballot may name no tile outside: leave 100 m around where you drive.
        Unreachable if the server does not answer; MapvoteError if it refuses or what comes is damaged.
        """
        manifest = self.manifest() if version is None else self._manifest(f"/v1/map/versions/{version}")
        return self._as_map(manifest, region)

    def _as_map(self, manifest: Manifest, region: Region | None) -> PointMap:
        lattice = manifest.lattice
        wanted = {tile_index(key): planes for key, planes in manifest.tiles.items()}
        if region is not None:
            wanted = {index: planes for index, planes in wanted.items() if _meets(lattice.tile(index), region)}
        tiles = made_in_turn(lambda index: self.tile(lattice.tile(index), wanted[index]), wanted, self._kept_points)
        self._bound_cache({digest for planes in wanted.values() for digest in planes.planes().values()})
        self.version = manifest.version
        return PointMap(manifest.map_id, lattice, tiles, manifest.georeference, version=manifest.version)

    def fetch_kept(self, region: Region | None = None) -> PointMap:
        """The map that was fetched last, without a request. Unreachable if nothing, or not all of it, is kept."""
        manifest = self.kept_manifest()
        if manifest is None:
            raise Unreachable(f"{self._url}: does not answer, and no version of its map is kept here")
        return self._as_map(manifest, region)

    def has(self, planes: TileHashes) -> bool:
        """Whether a tile can be read without a request."""
        return all((self._planes / digest).is_file() for digest in planes.planes().values())

    def points_of(self, planes: TileHashes) -> int:
        """How many points a tile has that :meth:`has` been downloaded."""
        return points_in_plane(first_bytes(self._planes / planes.points, FRAME_HEAD), planes.points)

    def download(self, planes: TileHashes) -> None:
        """Have the planes of a tile that ``home`` lacks. Raises as :meth:`fetch`."""
        for digest in planes.planes().values():
            if not (self._planes / digest).is_file():
                self._plane(digest)

    def forget(self, needed: Iterable[TileHashes]) -> None:
        """Keep the cache of planes within its bound; none of ``needed`` leaves it."""
        self._bound_cache({digest for planes in needed for digest in planes.planes().values()})

    def versions(self) -> Iterator[int | None]:
        """The number of the newest version, whenever something happens at the server (server-sent events), and None at
        the start and while nothing happens; for as long as the connection holds. Unreachable if there is none."""
        for line in self._server.lines("/v1/events"):
            if line.startswith(":"):
                yield None
            elif line.startswith("data:"):
                yield int(msgspec.json.decode(line[5:])["version"])

    def send(self, ballot: Ballot | bytes) -> Sent:
        """Send a ballot; "spooled" if the server cannot be reached now. Refused if it refuses, saying where the ballot
        is kept and what to do."""
        data = ballot if isinstance(ballot, bytes) else encode(ballot)
        about = ballot if isinstance(ballot, Ballot) else decode(ballot)
        return self._send_spooled(self._spool.put(about.vehicle, about.drive, data))

    def keep(self, data: bytes) -> None:
        """Put an encoded ballot into the spool; :meth:`flush` sends it. MapvoteError if the disk does not take it."""
        about = decode(data)
        self._spool.put(about.vehicle, about.drive, data)

    def waiting(self, vehicle: str | None = None) -> int:
        """How many ballots the spool holds (of one vehicle)."""
        return sum(1 for _ in self._spool.waiting(vehicle))

    def flush(self, vehicle: str | None = None) -> dict[str, Sent | MapvoteError]:
        """Try again to send what waits for this server (of one vehicle): what came of each, by "vehicle~drive"."""
        results: dict[str, Sent | MapvoteError] = {}
        for waiting in self._spool.waiting(vehicle):
            name = f"{waiting.parent.name}~{waiting.stem}"
            try:
                results[name] = self._send_spooled(waiting)
            except MapvoteError as error:
                results[name] = error
            if results[name] == "spooled":
                break
        return results

    def _send_spooled(self, waiting: Path) -> Sent:
        try:
            path = f"/v1/ballots/{waiting.parent.name}/{waiting.stem}"
            answer = self._server.ask("PUT", path, content=waiting.read_bytes())
        except Unreachable:
            return "spooled"
        except Refused as error:
            if error.of_key:
                mend = f"the ballot waits in {waiting}: it is sent with the next one, by a key that may"
                raise Refused(f"{error}; {mend}", error.status) from error
            kept = self._spool.set_aside(waiting)
            mend = ": fetch the map and vote again with that drive" if error.status == 409 else ""
            raise Refused(f"{error}; the ballot is kept in {kept}{mend}", error.status) from error
        self._spool.sent(waiting)
        result: Sent = answer.json()["result"]
        return result

    def manifest(self) -> Manifest:
        """The newest version's, of which only what changed since the last is downloaded. Raises as :meth:`fetch`."""
        kept = self.kept_manifest()
        if kept is not None:
            try:
                answer = self._server.ask(
                    "GET", f"/v1/map?since={kept.version}", headers={"If-None-Match": kept.tag(since=kept.version)}
                )
            except Refused as error:
                if error.status != 404:
                    raise
                kept = None  # the server is not the one it was: it never had that version
            else:
                if answer.status_code == 304:
                    return kept
                since = self._decoded(answer.content)
                followed = kept.followed_by(since)
                if since.map_id == kept.map_id and followed.is_whole():
                    return self._keep(followed)
        return self._keep(self._manifest("/v1/map"))

    def _manifest(self, path: str) -> Manifest:
        return self._decoded(self._server.ask("GET", path).content)

    def _decoded(self, content: bytes) -> Manifest:
        try:
            return _DECODER.decode(content)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise MapvoteError(f"{self._url}: is no mapvote server ({error})") from error

    def kept_manifest(self) -> Manifest | None:
        """The manifest that :meth:`manifest` returned last, without a request; None if none is kept."""
        try:
            return _DECODER.decode(read_whole(self._kept_manifest))
        except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return None

    def _keep(self, manifest: Manifest) -> Manifest:
        write_whole(self._kept_manifest, msgspec.json.encode(manifest), private=True)
        return manifest

    def tile(self, window: Grid, planes: TileHashes) -> Tile:
        """A tile over ``window``; what ``home`` lacks of it is downloaded. Raises as :meth:`fetch`."""
        return unpack_tile(window, planes, {name: self._plane(digest) for name, digest in planes.planes().items()})

    def _plane(self, digest: str) -> bytes:
        """The zstd frame of a plane."""
        kept = self._planes / digest
        if kept.is_file():
            frame = read_whole(kept)
            with suppress(MapvoteError):  # damaged on this disk: fetched again
                check_plane(frame, digest)
                os.utime(kept)
                return frame
        raw = self._server.ask("GET", f"/v1/tiles/{digest}").content
        if hashlib.sha256(raw).hexdigest() != digest:
            raise MapvoteError(f"{self._url}: tile plane {digest[:12]} arrived damaged; fetch it again")
        frame = compress(raw, 1)
        write_whole(kept, frame, private=True)
        return frame

    def _bound_cache(self, needed: Iterable[str]) -> None:
        """Forget the planes that were used longest ago, beyond ``cache_bytes``; never those of the map just fetched."""
        if not self._planes.is_dir():
            return
        others = {file.name: file.stat() for file in os.scandir(self._planes)}
        for digest in needed:
            others.pop(digest, None)
        size = sum(about.st_size for about in others.values())
        for name in sorted(others, key=lambda name: others[name].st_mtime_ns):
            if size <= self._cache_bytes:
                return
            (self._planes / name).unlink(missing_ok=True)
            size -= others[name].st_size


def _meets(window: Grid, region: Region) -> bool:
    x0, y0, x1, y1 = region
    rows, cols = window.shape
    return x0 < window.x0 + cols * CELL_SIZE and window.x0 < x1 and y0 < window.y0 + rows * CELL_SIZE and window.y0 < y1


_WAITING, _REFUSED = ".ballot", ".refused"


def _server_folder(home: Path, url: str) -> Path:
    """Folder of the files of one server: its name to read, and a hash of its address."""
    name = re.sub(r"[^A-Za-z0-9.]+", "_", url.partition("://")[2].strip("/"))[:60]
    return home / "servers" / f"{name}-{hashlib.sha256(url.rstrip('/').encode()).hexdigest()[:8]}"


class _Spool:
    """Ballots that wait for one server. Files are their owner's alone, and appear whole."""

    def __init__(self, home: Path, url: str) -> None:
        self._folder = _server_folder(home, url) / "spool"

    def put(self, vehicle: str, drive: str, data: bytes) -> Path:
        """Keep a ballot until :meth:`sent`; one of the same drive is replaced."""
        waiting = self._folder / vehicle / f"{drive}{_WAITING}"
        write_whole(waiting, data, private=True)
        return waiting

    def waiting(self, vehicle: str | None = None) -> Iterator[Path]:
        """Ballots that are to be sent, of one vehicle or of all."""
        yield from sorted(self._folder.glob(f"{vehicle or '*'}/*{_WAITING}"))

    def sent(self, waiting: Path) -> None:
        """The server has it."""
        waiting.unlink(missing_ok=True)

    def set_aside(self, waiting: Path) -> Path:
        """The server will never take it as it is: keep it, and send it no more."""
        kept = waiting.with_suffix(_REFUSED)
        os.replace(waiting, kept)
        return kept
