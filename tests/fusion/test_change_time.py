"""When the world changed: the last vehicles all say so, and those before them all saw it as it was."""

from __future__ import annotations

import numpy as np
import pytest

from hand_made import states_plane, two_walls
from mapvote.config import FuseSettings
from mapvote.core.types import NO_VOTE, CellState
from mapvote.fusion.change_time import _turn
from mapvote.fusion.fuse import Rule, fuse_tile
from mapvote.fusion.tile_vote import TileVote

UO, UE, CO, CE, UN = (int(state) for state in list(CellState)[:5])
CELL = (10, 10)


def decided(
    *said: int,
    min_votes: int = 2,
    ends_s: list[int] | None = None,
    whose: list[str] | None = None,
    rule: Rule = "columns",
) -> int:
    """What is decided of a cell if the vehicles pass one after the other and say this."""
    votes = [
        TileVote(
            vehicle=f"v{i}" if whose is None else whose[i],
            end_ns=(i if ends_s is None else ends_s[i]) * 10**9,
            digest=f"{i:02}",
            states=states_plane({CELL: state}),
        )
        for i, state in enumerate(said)
    ]
    rng = np.random.default_rng(len(said))
    tile = two_walls().tiles[0, 0]
    shuffled = [votes[i] for i in rng.permutation(len(votes))]
    settings = FuseSettings(min_votes=min_votes, latest_vehicles=99)
    return int(fuse_tile(tile, shuffled, rule, settings)[0].states[CELL])


def test_a_house_that_many_saw_standing_is_gone_once_three_in_turn_say_so() -> None:
    assert decided(*[UO] * 6, CE, CE) == UO, "a quorum alone does not outvote six"
    assert decided(*[UO] * 6, CE, CE, CE) == CE
    assert decided(*[UO] * 50, CE, CE, CE) == CE
    assert decided(*[UE] * 6, CO, CO, CO) == CO


def test_by_the_papers_rule_the_majority_decides_whoever_came_last() -> None:
    assert decided(*[UO] * 6, CE, CE, CE, rule="paper") == UO


def test_one_more_than_the_quorum_must_say_so() -> None:
    assert decided(*[UO] * 6, CE, CE, CE, min_votes=3) == UO
    assert decided(*[UO] * 6, CE, CE, CE, CE, min_votes=3) == CE


@pytest.mark.parametrize("said", [[UO, UO, CE, UO, UO, UO, CE, CE, CE], [*[UO] * 6, CE, UO, CE, CE],
                                  [*[UO] * 6, CE, CE, CE, UO], [*[UO] * 6, CO, CE, CE, CE]])  # fmt: skip
def test_where_they_contradict_each_other_the_majority_decides(said: list[int]) -> None:
    assert decided(*said) != CE


def test_who_is_not_sure_breaks_nothing() -> None:
    assert decided(*[UO] * 6, CE, UN, CE, UN, CE) == CE


def test_at_the_same_moment_there_is_no_before() -> None:
    assert decided(*[UO] * 4, CE, CE, CE, ends_s=[1, 1, 1, 5, 5, 5, 5]) == UO


def test_of_a_vehicle_the_last_word_counts_once() -> None:
    whose = ["a", "b", "c", "d", "e", "f", "a", "b", "b"]
    assert decided(*[UO] * 6, CE, CE, CE, whose=whose) == UO, "two vehicles, three drives"
    assert decided(*[UO] * 6, CE, CE, CE, whose=[*whose[:8], "c"]) == CE


def test_a_vehicle_that_never_spoke_of_a_cell_does_not_stand_for_another() -> None:
    said = np.array([[CE], [UO], [NO_VOTE], [CE]], dtype=np.uint8)
    ends_ns, whose = np.arange(4, dtype=np.int64), np.array([2, 0, 1, 0], dtype=np.int64)
    assert _turn(said, ends_ns, whose, UO, CE).all(), "both that spoke say so in the end"
