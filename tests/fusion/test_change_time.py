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

UO, UE, CO, CE, UN = (int(state) for state in CellState)
CELL = (10, 10)
SIX, TWICE = [UO] * 6, ["a", "b", "c", "d", "e", "f", "a", "b"]


def decided(
    said: list[int], min_votes: int = 2, ends_s: list[int] | None = None, whose: list[str] | None = None,
    rule: Rule = "columns",
) -> int:  # fmt: skip
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
    shuffled = [votes[i] for i in np.random.default_rng(len(said)).permutation(len(votes))]
    settings = FuseSettings(min_votes=min_votes, latest_vehicles=99)
    return int(fuse_tile(two_walls().tiles[0, 0], shuffled, rule, settings)[0].states[CELL])


@pytest.mark.parametrize(
    ("why", "said", "how", "state"),
    [
        ("a quorum alone does not outvote six", [*SIX, CE, CE], {}, UO),
        ("three in turn say that the house is gone", [*SIX, CE, CE, CE], {}, CE),
        ("however many saw it stand", [*[UO] * 50, CE, CE, CE], {}, CE),
        ("likewise of what is new", [*[UE] * 6, CO, CO, CO], {}, CO),
        ("one more than the quorum must say so", [*SIX, CE, CE, CE], {"min_votes": 3}, UO),
        ("one more than the quorum says so", [*SIX, CE, CE, CE, CE], {"min_votes": 3}, CE),
        ("by the paper's rule the majority decides, whoever came last", [*SIX, CE, CE, CE], {"rule": "paper"}, UO),
        ("who is not sure breaks nothing", [*SIX, CE, UN, CE, UN, CE], {}, CE),
        ("at the same moment there is no before", [*[UO] * 4, CE, CE, CE], {"ends_s": [1, 1, 1, 5, 5, 5, 5]}, UO),
        ("two vehicles, three drives", [*SIX, CE, CE, CE], {"whose": [*TWICE, "b"]}, UO),
        ("of a vehicle the last word counts", [*SIX, CE, CE, CE], {"whose": [*TWICE, "c"]}, CE),
        ("one contradicts before", [UO, UO, CE, UO, UO, UO, CE, CE, CE], {}, UO),
        ("one contradicts between", [*SIX, CE, UO, CE, CE], {}, UO),
        ("the last contradicts", [*SIX, CE, CE, CE, UO], {}, UO),
        ("one saw something else", [*SIX, CO, CE, CE, CE], {}, UO),
    ],
)
def test_a_change_is_decided_once_more_than_a_quorum_say_so_one_after_the_other_and_nobody_contradicts(
    why: str, said: list[int], how: dict[str, int], state: int
) -> None:
    assert decided(said, **how) == state, why  # type: ignore[arg-type]


def test_a_vehicle_that_never_spoke_of_a_cell_does_not_stand_for_another() -> None:
    said = np.array([[CE], [UO], [NO_VOTE], [CE]], dtype=np.uint8)
    ends_ns, whose = np.arange(4, dtype=np.int64), np.array([2, 0, 1, 0], dtype=np.int64)
    assert _turn(said, ends_ns, whose, UO, CE).all(), "both that spoke say so in the end"


@pytest.mark.parametrize(
    ("first", "second", "ends_ns"),
    [(CE, UO, [0, 1]), (UO, CE, [5, 5]), (CO, CE, [0, 1])],
    ids=["after", "tie", "other"],
)
def test_the_first_drive_counts_as_any_other(first: int, second: int, ends_ns: list[int]) -> None:
    said, whose = np.array([[first], [second]], dtype=np.uint8), np.arange(2, dtype=np.int64)
    assert not _turn(said, np.array(ends_ns, dtype=np.int64), whose, UO, CE).any()
