"""Where a vehicle can have been, by what it says."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from hand_made import Say, make_ballot, states_plane, two_walls
from mapvote.codec.ballot import encode
from mapvote.core.grid import TileIndex
from mapvote.core.types import CellState
from mapvote.server.store.admission import Votes, examine, refuse_out_of_reach

MAP = {(0, 0), (0, 1)}


def votes_on(*tiles: TileIndex, cell: tuple[int, int] | None = None) -> Sequence[Votes]:
    fill = CellState.UNCHANGED_EMPTY
    plane = states_plane(fill=fill) if cell is None else states_plane({cell: fill})
    return examine(encode(make_ballot(two_walls(), dict.fromkeys(tiles, Say(plane))))).votes


def test_votes_on_the_map_and_beside_it_are_heard() -> None:
    assert refuse_out_of_reach(votes_on((0, 0), (0, 1), (0, 2), (1, 2), (-1, 0)), MAP) is None


@pytest.mark.parametrize("tile", [(0, 5), (-5, 0), (4000, 4000), (0, -5)])
def test_a_vote_at_the_other_end_of_the_world_is_not(tile: TileIndex) -> None:
    refused = refuse_out_of_reach(votes_on((0, 0), tile), MAP)
    assert refused is not None
    assert "more than 200 m from the map" in str(refused)


def test_it_is_the_cell_that_counts_not_its_tile() -> None:
    """Tile 0,4 begins 153.6 m from the map and ends 230.4 m from it: the limit is in its column 154."""
    assert refuse_out_of_reach(votes_on((0, 1), (0, 3), (0, 4), cell=(0, 153)), MAP) is None
    assert refuse_out_of_reach(votes_on((0, 1), (0, 3), (0, 4), cell=(0, 155)), MAP) is not None


def test_one_drive_is_one_way() -> None:
    long_map = {(0, col) for col in range(40)}
    assert refuse_out_of_reach(votes_on(*[(0, col) for col in range(0, 40, 3)]), long_map) is None
    refused = refuse_out_of_reach(votes_on((0, 0), (0, 1), (0, 5), (0, 6)), long_map)
    assert refused is not None
    assert "send each part as a drive of its own" in str(refused)
    assert "0,5" in str(refused)


def test_a_drive_of_one_tile_is_one_way() -> None:
    assert refuse_out_of_reach(votes_on((0, 1)), MAP) is None
