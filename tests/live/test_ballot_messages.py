"""A ballot in RViz and Foxglove: points that come and go stand where they are in the map, the grid says the rest."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from hand_made import make_map, make_tile, states_plane, wall
from mapvote.codec.ballot import Ballot, BallotTile, pack_path, pack_points
from mapvote.codec.planes import Words, pack_plane, pack_words
from mapvote.core.grid import CELL_SIZE, Lattice
from mapvote.core.types import F32, CellState, MapvoteError
from mapvote.formats.drives.bag import Bag
from mapvote.formats.drives.point_fields import point_cloud_table
from mapvote.live.ballot_messages import (
    BallotView,
    changes_cloud,
    map_cloud,
    messages_of_ballot,
    path_message,
    states_grid,
)
from mapvote.live.mcap import write_mcap
from mapvote.live.rerun_file import write_rrd

GONE_WALL = [(10, c) for c in range(20, 30)]
STANDS = [(40, c) for c in range(20, 30)]
HEIGHTS = [0.45, 0.75, 1.05]
NEW = wall([(60, 7)], [0.75, 1.05])
STREET = make_map({(0, 0): make_tile(np.concatenate([wall(GONE_WALL, HEIGHTS), wall(STANDS, HEIGHTS)]))})
STATES = states_plane(
    dict.fromkeys(GONE_WALL, CellState.CHANGED_EMPTY)
    | dict.fromkeys(STANDS, CellState.UNCHANGED_OCCUPIED)
    | {(60, 7): CellState.CHANGED_OCCUPIED, (61, 7): CellState.UNDETERMINED, (62, 7): CellState.UNCHANGED_EMPTY}
)


def ballot(gone: bool = True, one_stage: bool = False) -> Ballot:
    words = np.zeros((256, 256), dtype=np.uint64)
    base = STREET.tiles[0, 0].base
    for r, c in GONE_WALL:
        words[r, c] = np.uint64(1) << np.uint64(int(1.05 // CELL_SIZE) - int(base[r, c]))  # the topmost voxel
    tally = np.zeros((5, 256, 256), dtype=np.uint16)
    for state in range(5):
        tally[state][state == STATES] = 3
    tile = BallotTile(
        tile=(0, 0),
        states=None if one_stage else pack_plane(STATES),
        tally=pack_plane(tally) if one_stage else None,
        gone=pack_words(Words.of(words)) if gone else None,
        new_points=pack_points(NEW),
    )
    path = pack_path([np.array([1.0, 2.0]), np.array([30.0, 2.0])], Lattice())
    return Ballot(
        map_id="test-map",
        base={"0,0": ""},
        version=1,
        vehicle="car",
        drive="day",
        start_ns=10**9,
        end_ns=2 * 10**9,
        method="surfaces",
        settings_hash="0",
        scans=2,
        scans_localised=2,
        median_sigma_m=0.01,
        path=path,
        tiles=[tile],
    )


def in_order(points: F32) -> F32:
    """(n, 3) in the order of their coordinates to the centimetre."""
    keys = np.round(points, 2)
    return points[np.lexsort((keys[:, 2], keys[:, 1], keys[:, 0]))]


@pytest.mark.parametrize("one_stage", [False, True])
@pytest.mark.parametrize("gone", [False, True])
def test_points_that_come_and_go_are_those_of_the_ballot_and_the_map(gone: bool, one_stage: bool) -> None:
    table = point_cloud_table("changes", changes_cloud(ballot(gone, one_stage), STREET))
    xyz = np.column_stack([table["x"], table["y"], table["z"]])
    assert np.allclose(in_order(xyz[table["change"] == 1]), in_order(NEW), atol=0.01)
    wanted = wall(GONE_WALL, [1.05] if gone else HEIGHTS)
    assert np.allclose(in_order(xyz[table["change"] == 2]), in_order(wanted), atol=0.01)
    assert set(table["rgb"].view(np.uint32).tolist()) == {0xE03C31, 0x2F6FDE}


def test_the_grid_tells_the_state_of_each_cell_and_where_it_lies() -> None:
    grid = states_grid(ballot(), STREET)
    values = np.asarray(grid.data).reshape(grid.info.height, grid.info.width)
    assert values.shape == (256, 256)
    assert grid.info.resolution == pytest.approx(0.3)
    assert (values[10, 20], values[40, 20], values[60, 7], values[61, 7], values[62, 7], values[0, 0]) == (
        25,
        100,
        75,
        50,
        0,
        -1,
    )


def test_a_wide_ballot_is_shown_in_larger_cells_of_which_a_change_counts_most() -> None:
    grid = states_grid(ballot(), STREET, view=BallotView(most_cells=5000))
    values = np.asarray(grid.data).reshape(grid.info.height, grid.info.width)
    assert values.shape == (64, 64)
    assert grid.info.resolution == pytest.approx(1.2)
    assert (values[60 // 4, 7 // 4], values[10 // 4, 20 // 4], values[40 // 4, 20 // 4]) == (75, 25, 100)


def test_the_path_lies_on_the_ground() -> None:
    poses = path_message(ballot(), STREET).poses
    places = {(pose.pose.position.x, pose.pose.position.y, pose.pose.position.z) for pose in poses}
    assert np.allclose(sorted(places), [(1.0, 2.0, 0.0), (30.0, 2.0, 0.0)], atol=CELL_SIZE)


def test_an_mcap_file_holds_every_message_and_is_read_again(tmp_path: Path) -> None:
    messages = [map_cloud(ballot(), STREET), *messages_of_ballot(ballot(), STREET)]
    write_mcap(tmp_path / "ballot.mcap", [message.recorded for message in messages])
    assert [file.name for file in tmp_path.iterdir()] == ["ballot.mcap"]
    bag = Bag(tmp_path / "ballot.mcap")
    assert {topic: t.msgcount for topic, t in bag.reader.topics.items()} == dict.fromkeys(
        ["/mapvote/map", "/mapvote/changes", "/mapvote/states", "/mapvote/path"], 1
    )
    (_, message), *_ = bag.messages("/mapvote/map")
    assert message.width == STREET.n_points
    assert message.header.frame_id == "map"


def test_a_recording_for_rerun_is_written_or_the_extra_is_named(tmp_path: Path) -> None:
    messages = [map_cloud(ballot(), STREET), *messages_of_ballot(ballot(), STREET)]
    file = tmp_path / "ballot.rrd"
    if importlib.util.find_spec("rerun") is None:
        with pytest.raises(MapvoteError, match=r"pip install 'mapvote\[rerun\]'"):
            write_rrd(file, messages)
        return
    write_rrd(file, messages)
    data = file.read_bytes()
    assert data.startswith(b"RRF2")
    assert all(f"mapvote/{name}".encode() in data for name in ("map", "changes", "path"))
    with pytest.raises(MapvoteError, match="cannot be written"):
        write_rrd(tmp_path / "nowhere" / "x.rrd", messages)
