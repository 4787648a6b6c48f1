"""COPC by HTTP: what a viewer reads by ranges of bytes is the version, and the parts are those of RFC 9110."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from fastapi.testclient import TestClient
from hypothesis import given
from hypothesis import strategies as st

from hand_made import make_map, make_tile, two_walls
from mapvote.core.grid import Lattice
from mapvote.core.types import MapvoteError
from mapvote_server.api.app import create_app
from mapvote_server.api.ranges import asked_bytes
from mapvote_server.errors import NotInFile
from mapvote_server.questions.cloud_files import CLOUD_FILE_SIZES, CloudFiles
from mapvote_server.store.publish import publish
from mapvote_server.store.store import Store
from stores import NewStore, vote_gone

GEOREFERENCE = {"crs": "EPSG:32654", "offset": "380000,3940000,0"}


class RangeFile(io.RawIOBase):
    """A file on a server, read by ranges of bytes as a viewer does."""

    def __init__(self, client: TestClient, path: str) -> None:
        self._client = client
        self._path = path
        self._at = 0
        self.size = int(client.head(path).headers["Content-Length"])
        self.n = 0
        """Bytes read so far."""

    def seekable(self) -> bool:
        return True

    def readable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self.size}[whence]
        return self._at

    def readinto(self, buffer: Any) -> int:
        wanted = min(len(buffer), self.size - self._at)
        if wanted <= 0:
            return 0
        answer = self._client.get(self._path, headers={"Range": f"bytes={self._at}-{self._at + wanted - 1}"})
        assert answer.status_code == 206
        buffer[:wanted] = answer.content
        self._at += wanted
        self.n += wanted
        return wanted


def path_of(version: int) -> str:
    return f"/v1/map/versions/{version}/cloud.copc.laz"


@pytest.fixture
def client(new_store: NewStore) -> Iterator[TestClient]:
    """Two walls, one of which three vehicles saw gone."""
    store = new_store(replace(two_walls(), georeference=GEOREFERENCE))
    vote_gone(store, "abc")
    publish(store, override=True)
    with TestClient(create_app(store, opened=True), base_url="http://localhost") as found:
        yield found


def test_a_second_library_reads_a_version_by_ranges(client: TestClient) -> None:
    for version, n in ((1, 24), (2, 15)):
        with laspy.CopcReader(RangeFile(client, path_of(version))) as reader:
            assert reader.header.parse_crs().to_epsg() == 32654
            points = reader.query()
        assert len(points) == n
        assert set(points.source_version) == {1}
        assert {int(y) // 76 for y in points.x - 380_000} == {0, 1}
        assert set(points.classification) <= {1, 2}


def test_parts_of_the_file_are_those_of_the_standard(client: TestClient) -> None:
    whole = client.get(path_of(1))
    tag = whole.headers["ETag"]
    size = len(whole.content)
    assert (whole.status_code, whole.headers["Accept-Ranges"], whole.content[:4]) == (200, "bytes", b"LASF")
    head = client.head(path_of(1))
    assert (head.status_code, head.content, head.headers["Content-Length"]) == (200, b"", str(size))

    def part(text: str, **more: str) -> Any:
        return client.get(path_of(1), headers={"Range": text} | more)

    assert (part("bytes=0-3").status_code, part("bytes=0-3").content) == (206, b"LASF")
    assert part("bytes=0-3").headers["Content-Range"] == f"bytes 0-3/{size}"
    assert part("bytes=-5").content == whole.content[-5:]
    assert part(f"bytes=5-{size + 9}").content == whole.content[5:]
    assert part("bytes=0-3", **{"If-Range": tag}).status_code == 206
    assert part("bytes=0-3", **{"If-Range": '"other"'}).content == whole.content
    assert part("bytes=0-1,4-5").content == whole.content, "a server may ignore what it does not serve"
    assert part("bytes=0-3", **{"If-None-Match": tag}).status_code == 304
    beyond = part(f"bytes={size}-")
    assert (beyond.status_code, beyond.headers["Content-Range"]) == (416, f"bytes */{size}")
    assert str(size) in beyond.json()["detail"]
    assert client.get(path_of(9)).status_code == 404


@given(size=st.integers(1, 50), first=st.integers(0, 60), last=st.integers(0, 60))
def test_any_range_is_what_python_slices(size: int, first: int, last: int) -> None:
    content = bytes(range(size))
    for text, wanted in (
        (f"bytes={first}-{last}", content[first : last + 1] if first <= last else content),
        (f"bytes={first}-", content[first:]),
        (f"bytes=-{last}", content[max(0, size - last) :] if last else b""),
    ):
        try:
            part = asked_bytes(text, size)
        except NotInFile:
            assert wanted == b""
        else:
            assert (content if part is None else content[part.start : part.stop]) == wanted != b""


def test_files_that_have_no_room_go_and_who_reads_one_reads_it_to_the_end(tmp_path: Path) -> None:
    store = Store.create(f"sqlite:///{tmp_path / 's.db'}", two_walls())
    vote_gone(store, "ab")
    publish(store, override=True)
    files = CloudFiles(store, replace(CLOUD_FILE_SIZES, kept_bytes=1))
    first, reading = files.open(1)
    same, again = files.open(1)
    assert same is first
    second, other = files.open(2)
    assert not first.path.exists()
    assert second.path.exists()
    with reading, again, other:
        assert len(reading.read()) == first.size
    made_again, file = files.open(1)
    file.close()
    assert made_again.digest == first.digest
    files.close()
    assert not second.path.parent.exists()
    with pytest.raises(MapvoteError, match=r"24 points.*mapvote export STORE cloud.copc.laz --version 1"):
        CloudFiles(store, replace(CLOUD_FILE_SIZES, points=20)).open(1)
    store.close()


@pytest.mark.slow
def test_a_view_of_200_m_of_a_map_of_10_km_reads_3_percent_of_the_file(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    n = 23_000  # of each tile, as on a street
    side = rng.integers(0, 3, n)
    y = 38.0 + np.where(side == 0, rng.uniform(-10.0, 10.0, n), np.where(side == 1, -10.0, 10.0))
    z = np.where(side == 0, 0.0, rng.uniform(0.0, 9.0, n)) + rng.normal(0.0, 0.02, n)
    tile = make_tile(np.column_stack([rng.uniform(0.0, 76.7, n), y, z]).astype(np.float32))
    street = make_map({(0, col): tile.but(window=Lattice().tile((0, col))) for col in range(131)})
    store = Store.create(f"sqlite:///{tmp_path / 's.db'}", street)
    with TestClient(create_app(store, opened=True), base_url="http://localhost") as client:
        file = RangeFile(client, path_of(1))
        with laspy.CopcReader(file) as reader:
            view = laspy.copc.Bounds(mins=np.array([4_000.0, 0.0]), maxs=np.array([4_200.0, 76.0]))
            points = reader.query(bounds=view, resolution=0.1)
        assert len(points) > 0.5 * n * 200.0 / 76.8
        assert file.n <= 0.03 * file.size
    store.close()
