"""What a vehicle needs of the server: the newest map, and a way to send a ballot that loses nothing.

client = MapClient("https://maps.example.org", key=..., home=Path("~/.cache/mapvote").expanduser())
point_map = client.fetch()
client.send(ballot)                # kept in the spool and sent later if the server cannot be reached
"""

from __future__ import annotations

import hashlib
import os
import random
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import httpx2
import msgspec
import numpy as np

from mapvote.codec.ballot import Ballot, decode, encode
from mapvote.core.grid import Grid, Lattice, TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.tile import Tile
from mapvote.core.types import MapvoteError
from mapvote.formats.atomic import whole_file

Sent = Literal["created", "replaced", "repeated", "spooled"]
_PASSING = {429, 500, 502, 503, 504}
"""Answers that may be better next time."""


class _Plane(msgspec.Struct):
    points: str
    ground: str
    free: str | None = None


class _Lattice(msgspec.Struct):
    x0: float
    y0: float


class _Manifest(msgspec.Struct):
    map_id: str
    version: int
    lattice: _Lattice
    tiles: dict[str, _Plane]
    georeference: dict[str, str] = {}


class Unreachable(MapvoteError):
    """The server did not answer, or not now."""


class MapClient:
    """One vehicle's line to one server. ``home`` holds planes of tiles by hash, and the spool of unsent ballots."""

    def __init__(
        self,
        url: str,
        *,
        home: Path,
        key: str | None = None,
        attempts: int = 4,
        timeout_s: float = 30.0,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        headers = {"Accept-Encoding": "identity"} | ({"Authorization": f"Bearer {key}"} if key else {})
        self._http = httpx2.Client(base_url=url.rstrip("/"), headers=headers, timeout=timeout_s)
        self._url = url
        self._planes, self._spool = home / "planes", home / "spool"
        self._attempts = attempts
        self._sleep = sleep
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
        self._http.close()

    def fetch(self, version: int | None = None) -> PointMap:
        """The newest map, or one version; only planes that ``home`` lacks are downloaded.

        Unreachable if the server does not answer; MapvoteError if it refuses or what comes is damaged.
        """
        path = "/v1/map" if version is None else f"/v1/map/versions/{version}"
        try:
            manifest = msgspec.json.decode(self._ask("GET", path).content, type=_Manifest)
        except msgspec.DecodeError as error:
            raise MapvoteError(f"{self._url}: is no mapvote server ({error})") from error
        lattice = Lattice(manifest.lattice.x0, manifest.lattice.y0)
        tiles = {_index(key): self._tile(lattice.tile(_index(key)), planes) for key, planes in manifest.tiles.items()}
        self.version = manifest.version
        return PointMap(manifest.map_id, lattice, tiles, manifest.georeference, version=manifest.version)

    def newest(self) -> int:
        """The number of the newest version; nothing of it is downloaded. Raises as :meth:`fetch`."""
        try:
            return msgspec.json.decode(self._ask("GET", "/v1/map").content, type=_Manifest).version
        except msgspec.DecodeError as error:
            raise MapvoteError(f"{self._url}: is no mapvote server ({error})") from error

    def send(self, ballot: Ballot | bytes) -> Sent:
        """Send a ballot; "spooled" if the server cannot be reached now. MapvoteError if it refuses the ballot."""
        data = ballot if isinstance(ballot, bytes) else encode(ballot)
        about = ballot if isinstance(ballot, Ballot) else decode(ballot)
        waiting = self._spool / f"{about.vehicle}~{about.drive}.ballot"
        with whole_file(waiting, private=True) as part:
            part.write_bytes(data)
        return self._send_spooled(waiting)

    def flush(self) -> dict[str, Sent | MapvoteError]:
        """Try again to send what is in the spool: what came of each, by "vehicle~drive". A refused one is set aside."""
        results: dict[str, Sent | MapvoteError] = {}
        for waiting in sorted(self._spool.glob("*.ballot")):
            try:
                results[waiting.stem] = self._send_spooled(waiting)
            except MapvoteError as error:
                results[waiting.stem] = error
            if results[waiting.stem] == "spooled":
                break
        return results

    def _send_spooled(self, waiting: Path) -> Sent:
        vehicle, _, drive = waiting.stem.partition("~")
        try:
            answer = self._ask("PUT", f"/v1/ballots/{vehicle}/{drive}", content=waiting.read_bytes())
        except Unreachable:
            return "spooled"
        except MapvoteError:
            os.replace(waiting, waiting.with_suffix(".refused"))
            raise
        waiting.unlink(missing_ok=True)
        result: Sent = answer.json()["result"]
        return result

    def _tile(self, window: Grid, planes: _Plane) -> Tile:
        points = np.frombuffer(self._plane(planes.points), dtype="<f4").reshape(-1, 3)
        ground_z = np.frombuffer(self._plane(planes.ground), dtype="<f4").reshape(window.shape)
        free = (
            None if planes.free is None else np.frombuffer(self._plane(planes.free), dtype="<u8").reshape(window.shape)
        )
        return Tile(window, points, ground_z, free)

    def _plane(self, digest: str) -> bytes:
        kept = self._planes / digest
        if kept.exists():
            raw = kept.read_bytes()
            if hashlib.sha256(raw).hexdigest() == digest:
                return raw
        raw = self._ask("GET", f"/v1/tiles/{digest}").content
        if hashlib.sha256(raw).hexdigest() != digest:
            raise MapvoteError(f"{self._url}: tile plane {digest[:12]} came damaged; fetch again")
        with whole_file(kept, private=True) as part:
            part.write_bytes(raw)
        return raw

    def _ask(self, method: str, path: str, content: bytes | None = None) -> httpx2.Response:
        """One request, repeated with growing, scattered pauses while the trouble may pass."""
        trouble = ""
        for attempt in range(self._attempts):
            if attempt:
                self._sleep(0.25 * 2**attempt * random.uniform(0.5, 1.5))
            try:
                answer = self._http.request(method, path, content=content)
            except httpx2.TransportError as error:
                trouble = str(error) or type(error).__name__
                continue
            except (httpx2.InvalidURL, httpx2.UnsupportedProtocol) as error:
                raise MapvoteError(f"{self._url}: is no address of a server ({error})") from error
            if answer.status_code in _PASSING:
                trouble = _detail(answer)
                continue
            if answer.status_code >= 400:
                raise MapvoteError(f"{self._url}: refused ({answer.status_code}): {_detail(answer)}")
            return answer
        raise Unreachable(f"{self._url}: no answer after {self._attempts} attempts ({trouble}); try again later")


def _index(key: str) -> TileIndex:
    row, _, col = key.partition(",")
    return int(row), int(col)


def _detail(answer: httpx2.Response) -> str:
    try:
        found: Any = answer.json()["detail"]
    except (ValueError, KeyError, TypeError):
        return f"status {answer.status_code}"
    return str(found)
