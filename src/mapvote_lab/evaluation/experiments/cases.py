"""What is compared: the paper's five cases (paper V), the same under other rules of sight, and ``surfaces``.

All of them are settings of the one rule. A vehicle casts a ballot by each; the server's rule then decides, and the
decided cells are scored.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mapvote.codec.ballot import Ballot, unpack_states, unpack_tally
from mapvote.config import CASES, FuseSettings, PaperSettings, Settings, VotingSettings
from mapvote.core.grid import Grid
from mapvote.core.point_map import PointMap
from mapvote.core.types import NO_VOTE, U8, MapvoteError
from mapvote.core.voting import plurality
from mapvote.fusion.fuse import states_over
from mapvote.fusion.offline import update_map
from mapvote_lab.evaluation.scoring.jury import CaseOutcome
from mapvote_lab.evaluation.scoring.scene_truth import lay_on

OCCLUSIONS: Mapping[str, Mapping[str, str]] = {
    "": {},
    " farthest_return": {"line_of_sight": "farthest"},
    " column": {"line_of_sight": "column"},
}
"""Readings of sight that stand beside the one that is set, by what they add to a case's name."""


AS_BEFORE = PaperSettings()
"""The paper as it has been read from the start."""


@dataclass(frozen=True, slots=True)
class Case:
    """One line of the tables: a vote and how it is fused."""

    name: str
    voting: VotingSettings
    min_votes: int
    paper: PaperSettings = AS_BEFORE
    """How the paper is read; only method "paper" uses it."""


def paper_cases(settings: Settings) -> dict[str, Case]:
    """Cases 1 to 5 as ``[paper]`` reads them, named "1".., and under the other rules of sight, named "1 column".. ."""
    cases = {}
    for added, differently in OCCLUSIONS.items():
        paper = settings.paper.model_copy(update=differently)
        for number, booleans in CASES.items():
            voting = settings.voting.model_copy(update={"method": "paper", **booleans})
            cases[number + added] = Case(number + added, voting, 1, paper)
    return cases


def own_cases(settings: Settings) -> dict[str, Case]:
    """The default method, "surfaces"."""
    voting = settings.voting.model_copy(update={"method": "surfaces"})
    return {"surfaces": Case("surfaces", voting, settings.fuse.min_votes)}


YARDSTICKS = ("nearest", "evidence")


def choose_cases(settings: Settings, wanted: str) -> tuple[list[Case], bool]:
    """Cases by comma-separated names (1 to 5, "1 column" and its like, surfaces, yardsticks, or "all"
    that there is), and whether the yardsticks are wanted.

    MapvoteError names one that there is not, or says that no vote is left.
    """
    every = {**paper_cases(settings), **own_cases(settings)}
    names = [*every, "yardsticks"] if wanted == "all" else [name.strip() for name in wanted.split(",")]
    for name in names:
        if name not in every and name not in ("yardsticks", *YARDSTICKS):
            raise MapvoteError(f"no case {name!r}: choose from all, yardsticks, {', '.join(every)}")
    chosen = [every[name] for name in names if name in every]
    if not chosen:
        raise MapvoteError("the yardsticks are measured beside a vote: name a case too, as in --case 1,yardsticks")
    return chosen, len(chosen) < len(names)


def fuse_case(
    point_map: PointMap, ballots: Sequence[Ballot], min_votes: int, fuse: FuseSettings, window: Grid
) -> CaseOutcome:
    """The server's side of one case (paper IV): decide every cell, edit the map."""
    start = time.perf_counter()
    settings = fuse.model_copy(update={"min_votes": min_votes})
    updated, decisions = update_map(point_map, ballots, settings)
    seconds = time.perf_counter() - start
    states, grid = states_over(point_map.lattice, decisions)
    own = [lay_on(*ballot_states(ballot, point_map), window) for ballot in ballots]
    return CaseOutcome(updated, lay_on(states, grid, window), own, decisions, seconds)


def ballot_states(ballot: Ballot, point_map: PointMap) -> tuple[U8, Grid]:
    """What the vehicle itself decided, (rows, cols) over the window of its tiles, two-stage or one-stage."""
    tiles = {tile.tile: tile for tile in ballot.tiles}
    grids = [point_map.lattice.tile(index) for index in tiles]
    window = grids[0]
    for grid in grids[1:]:
        window = window.union(grid)
    out = np.full(window.shape, NO_VOTE, dtype=np.uint8)
    for grid, states in zip(grids, _decided(tiles.values()), strict=True):
        out[grid.slices_in(window)] = states
    return out, window


def _decided(tiles: Any) -> Iterator[U8]:
    for tile in tiles:
        yield (
            unpack_states(tile.states)
            if tile.states is not None
            else plurality(unpack_tally(tile.tally).astype(np.int32))
        )
