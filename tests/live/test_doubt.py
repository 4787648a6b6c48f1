"""Clouds around doubtful changes: kept within a bound, in files that can be read again, and told by the ballot."""

from __future__ import annotations

import sys
import threading
from pathlib import Path

import msgspec
import numpy as np
import pytest

from mapvote.codec.ballot import Ballot, BallotTile, in_steps, pack_odds
from mapvote.codec.planes import pack_plane
from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.grid import Lattice
from mapvote.core.types import F32, NO_VOTE, CellState, MapvoteError
from mapvote.formats import open_drive
from mapvote.formats.drives.bag import Bag
from mapvote.live.doubt import DoubtKeeper, DoubtRule, doubtful_place
from mapvote.live.doubt_file import FileWriter, Job, PlacedCloud, write_file

pytest.importorskip("rosbags")
START = 1_700_000_000 * 10**9
POINTS: F32 = np.random.default_rng(0).uniform(-60, 60, (3000, 3)).astype(np.float32)


def voted(probability: float, cells: int = 12, tile: tuple[int, int] = (0, 0)) -> BallotTile:
    """A tile with one change of so many cells in its row 100, from column 50 on."""
    states = np.full((256, 256), NO_VOTE, np.uint8)
    states[100, 50 : 50 + cells] = CellState.CHANGED_EMPTY
    odds = np.full(cells, np.log(probability / (1.0 - probability)))
    return BallotTile(tile=tile, states=pack_plane(states), odds=pack_odds(in_steps(odds)))


def ballot_of(*tiles: BallotTile) -> Ballot:
    names = {f"{t.tile[0]},{t.tile[1]}": "" for t in tiles}
    return Ballot(
        map_id="m", base=names, version=1, vehicle="car", drive="d-001", start_ns=START, end_ns=START + 1,
        method="surfaces", settings_hash="", scans=1, scans_localised=1, median_sigma_m=0.01, tiles=list(tiles),
    )  # fmt: skip


class InThread(FileWriter):
    """Writes without a process, which takes a second to begin."""

    def __init__(self, most_bytes: int, free: threading.Event | None = None) -> None:
        super().__init__(most_bytes)
        self._bound = most_bytes
        self._free = free

    def write(self, job: Job) -> str:
        if self._free is not None:
            self._free.wait(30.0)
            return ""
        try:
            write_file(job, self._bound)
        except MapvoteError as error:
            return str(error)
        return ""


def driven(keeper: DoubtKeeper, scans: int = 40, first: int = 0) -> None:
    """Scans each 0.25 s along x, at the change; every fifth has no place."""
    for k in range(first, first + scans):
        stamp_ns = START + k * 250_000_000
        keeper.add(stamp_ns, POINTS)
        keeper.placed(stamp_ns, None if k % 5 == 4 else from_xyz_rpy(10.0 + 0.5 * k, 30.0, 1.9, yaw=0.3))


@pytest.mark.parametrize(
    ("probability", "cells", "is_doubtful"),
    [(0.5, 12, True), (0.25, 8, True), (0.9, 12, False), (0.05, 12, False), (0.5, 7, False)],
)
def test_a_change_of_some_cells_that_is_neither_sure_nor_improbable_is_doubtful(
    probability: float, cells: int, is_doubtful: bool
) -> None:
    place = doubtful_place(voted(probability, cells), Lattice())
    assert (place is not None) == is_doubtful
    if place is not None:
        np.testing.assert_allclose(place, [0.3 * (50 + 0.5 * cells), 0.3 * 100.5])
    assert doubtful_place(BallotTile(tile=(0, 0)), Lattice()) is None, "it does not say how sure it is"


def test_the_last_ten_seconds_near_the_change_are_a_recording_that_can_be_read_again(tmp_path: Path) -> None:
    keeper = DoubtKeeper(tmp_path / "kept", 0, writer=InThread(10**8))
    driven(keeper, 60)
    marked = keeper.marked("d-001", ballot_of(voted(0.5), voted(0.99, tile=(0, 1))), Lattice())
    assert [tile.clouds for tile in marked.tiles] == [True, False]
    assert [tile.clouds for tile in keeper.flagging("d-001", lambda: marked)().tiles] == [True, False]
    keeper.close()
    (file,) = (tmp_path / "kept").iterdir()
    assert file.name == "d-001_0_0.mcap"
    drive = open_drive(file, sensor="hdl32e", prior="none")
    assert len(drive) == 33, "of 41 scans in ten seconds, those with a place"
    assert drive.stamps_ns[-1] == START + 58 * 250_000_000
    points = drive.read_scan(0).points
    assert 0 < len(points) < len(POINTS)
    ways = [t for _, m in Bag(file).messages("/tf") for t in m.transforms]
    assert {(t.header.frame_id, t.child_frame_id) for t in ways} == {("map", "lidar")}


@pytest.mark.slow
def test_a_process_that_cannot_write_says_why_and_writes_the_next_file_after_it_was_killed(tmp_path: Path) -> None:
    writer = FileWriter(10**6)
    cloud = PlacedCloud(START, POINTS, np.eye(4))
    assert "more than --keep-doubt-mb" in writer.write(Job(tmp_path / "a.mcap", np.zeros(2), [cloud] * 90))
    assert writer._process is not None
    writer._process.kill()
    writer._process.wait()
    assert writer.write(Job(tmp_path / "b.mcap", np.zeros(2), [cloud])) == ""
    writer.close()
    assert [file.name for file in tmp_path.iterdir()] == ["b.mcap"]


def test_the_oldest_files_go_first_and_the_bound_holds(tmp_path: Path) -> None:
    size = 0
    for most_bytes in (10**8, 0):
        folder = tmp_path / str(most_bytes)
        keeper = DoubtKeeper(folder, 0, DoubtRule(jobs=9), InThread(most_bytes or round(2.5 * size)))
        driven(keeper)
        for row in range(5):
            keeper.marked("d-001", ballot_of(voted(0.5, tile=(row, 0))), Lattice(0.0, -76.8 * row))
        keeper.close()
        files = sorted(file.name for file in folder.iterdir())
        if most_bytes:
            size = max(file.stat().st_size for file in folder.iterdir())
            assert len(files) == 5
    assert files == ["d-001_3_0.mcap", "d-001_4_0.mcap"]


def test_a_disk_that_is_slow_or_full_costs_clouds_and_never_the_vehicle(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    stuck = threading.Event()
    keeper = DoubtKeeper(tmp_path / "slow", 10**8, DoubtRule(jobs=1), InThread(10**8, stuck))
    driven(keeper)
    marks = [
        keeper.marked("d", ballot_of(voted(0.5, tile=(row, 0))), Lattice(0.0, -76.8 * row)).tiles[0].clouds
        for row in range(6)
    ]
    assert marks.count(True) <= 2, "one that is written, one that waits"
    assert "the disk is slow" in caplog.text
    stuck.set()
    keeper.close()
    small = DoubtKeeper(tmp_path / "small", 1000, writer=InThread(1000))
    driven(small)
    small.marked("d", ballot_of(voted(0.5)), Lattice())
    small.close()
    assert not small.flagging("d", lambda: ballot_of(voted(0.5)))().tiles[0].clouds, "what was not kept is not told"
    assert "more than --keep-doubt-mb allows" in caplog.text
    assert list((tmp_path / "small").iterdir()) == []


def test_files_that_a_crash_left_half_written_are_deleted_and_a_jump_of_the_clock_keeps_nothing(tmp_path: Path) -> None:
    (tmp_path / ".mcap-left").mkdir()
    (tmp_path / ".mcap-left" / "bag").write_bytes(bytes(100))
    (tmp_path / ".mcap-raw").write_bytes(bytes(100))
    keeper = DoubtKeeper(tmp_path, 10**8)
    driven(keeper)
    keeper.forget()
    assert not keeper.marked("d", ballot_of(voted(0.5)), Lattice()).tiles[0].clouds
    keeper.close()
    assert list(tmp_path.iterdir()) == []


def test_the_package_that_writes_is_asked_for_before_the_drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    with pytest.raises(MapvoteError, match=r"--keep-doubt: .*mapvote\[ros\]"):
        DoubtKeeper(tmp_path, 10**8)


def test_a_ballot_of_before_says_nothing_of_clouds() -> None:
    old = msgspec.msgpack.encode({k: v for k, v in msgspec.structs.asdict(voted(0.5)).items() if k != "clouds"})
    assert not msgspec.msgpack.decode(old, type=BallotTile).clouds
