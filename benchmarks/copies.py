"""Copies of recorded ballots: how much honest drives share, and which copies are found.

    python benchmarks/copies.py FOLDER ..

Each FOLDER holds the ballots (``*.ballot``) of honest vehicles that drove one street. First, of every two of them on
every tile: the smallest difference of outlines and the largest shares of points and patterns of free words in common
(fusion/copies.py), beside the bounds, and how many were taken for copies. Then each ballot is copied under another
name in every way that is listed. A copy is found on a tile if the two do not count as two vehicles there. Tiles on
which nothing of the original can be compared are left out.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mapvote.codec.ballot import decode, unpack_planes
from mapvote.codec.planes import Words
from mapvote.config import FuseSettings
from mapvote.core.grid import CELL_SIZE, CELLS, TILE_CELLS, TileIndex
from mapvote.core.types import NO_VOTE, Bool, CellState
from mapvote.fusion import copies
from mapvote.fusion.copies import RULE, free_marks, masks_of, originals, point_marks, smoothed
from mapvote.fusion.tile_vote import Vote

Votes = Mapping[TileIndex, Vote]
RNG = np.random.default_rng(0)


def votes_in(folder: Path) -> dict[str, Votes]:
    """The votes of each ballot of a folder, by tile."""
    found = {}
    for i, file in enumerate(sorted(folder.glob("*.ballot"))):
        ballot = decode(file.read_bytes())
        found[file.stem] = {
            tile.tile: Vote(file.stem, i, f"{i:064}").with_planes(unpack_planes(tile)) for tile in ballot.tiles
        }
    return found


def kept(vote: Vote, cells: Bool) -> Vote:
    """The vote in some cells (256, 256) only."""
    assert vote.states is not None
    points = vote.new_points
    if points is not None:
        at = np.floor(points[:, :2] / np.float32(CELL_SIZE)).astype(int).clip(0, TILE_CELLS - 1)
        points = points[cells[at[:, 1], at[:, 0]]]
    states = np.where(cells, vote.states, np.uint8(NO_VOTE))
    free = None if vote.free is None else vote.free.within(cells)
    return replace(vote, states=states, new_points=points, free=free, fields={}, odds=None)


def salted(share: float) -> Callable[[Vote], Vote]:
    """Cells set to undetermined at random; what lies in them is left out."""

    def copy(vote: Vote) -> Vote:
        assert vote.states is not None
        hit = RNG.random(vote.states.shape) < share
        return replace(kept(vote, ~hit), states=np.where(hit, np.uint8(CellState.UNDETERMINED), vote.states))

    return copy


def thinned(vote: Vote) -> Vote:
    """Blocks of ten by ten cells left out, half of them."""
    blocks = RNG.random((TILE_CELLS // 10 + 1,) * 2) < 0.5
    return kept(vote, np.kron(blocks, np.ones((10, 10), dtype=np.bool_))[:TILE_CELLS, :TILE_CELLS].astype(np.bool_))


def cut(vote: Vote) -> Vote:
    """The western half of what it determined."""
    assert vote.states is not None
    cols = np.flatnonzero((vote.states < CellState.UNDETERMINED).any(axis=0))
    return kept(vote, np.arange(TILE_CELLS)[None, :] < np.median(cols) + np.zeros((TILE_CELLS, 1)))


def shifted(vote: Vote) -> Vote:
    """Moved by a cell to the north."""
    assert vote.states is not None
    states = np.full_like(vote.states, NO_VOTE)
    states[1:] = vote.states[:-1]
    points, free = vote.new_points, vote.free
    if points is not None:
        points = points + np.array([0.0, CELL_SIZE, 0.0], dtype=np.float32)
        points = points[points[:, 1] < TILE_CELLS * CELL_SIZE]
    if free is not None:
        free = free.at(free.cells + TILE_CELLS < CELLS)
        free = Words(free.cells + TILE_CELLS, free.words)
    return replace(vote, states=states, new_points=points, free=free, fields={}, odds=None)


def merged_with(own: Votes) -> Callable[[Vote, TileIndex], Vote]:
    """Every other block of ten by ten cells from a drive of the copier's own."""

    def copy(vote: Vote, index: TileIndex) -> Vote:
        if index not in own:
            return vote
        blocks = RNG.random((TILE_CELLS // 10 + 1,) * 2) < 0.5
        mine = np.kron(blocks, np.ones((10, 10)))[:TILE_CELLS, :TILE_CELLS] > 0
        a, b = kept(vote, ~mine), kept(own[index], mine)
        assert a.states is not None
        assert b.states is not None
        points = [part for part in (a.new_points, b.new_points) if part is not None]
        free = np.zeros(CELLS, dtype=np.uint64)
        for part in (a.free, b.free):
            if part is not None:
                free[part.cells] = part.words
        return replace(
            vote,
            states=np.where(mine, b.states, a.states),
            new_points=np.concatenate(points) if points else None,
            free=Words.of(free.reshape(TILE_CELLS, TILE_CELLS)),
            fields={},
            odds=None,
        )

    return copy


def outline(a: Vote, b: Vote) -> float | None:
    """The difference of two outlines as a share of what a shift makes; None where it is not compared."""
    assert a.states is not None
    assert b.states is not None
    moved, looked = copies._look(smoothed(masks_of([a.states, b.states])))
    if moved.min() < RULE.least_moved:
        return None
    return float(copies._differing(looked[0], looked[1], copies._RIM, CELLS)) / float(moved.min())


def in_common(marks: Callable[[Vote, int], np.ndarray], a: Vote, b: Vote) -> float | None:
    """The share of the smaller one's marks that both have; None where they are not compared."""
    ours, theirs = (marks(vote, RULE.least_shared) for vote in (a, b))
    smaller = min(len(ours), len(theirs))
    return None if smaller == 0 else len(np.intersect1d(ours, theirs)) / smaller


def comparable(vote: Vote) -> bool:
    """Whether a drive and itself would be found alike."""
    return any(judge(vote, vote) is not None for judge in JUDGES.values())


JUDGES: dict[str, Callable[[Vote, Vote], float | None]] = {
    "outline": outline,
    "points": lambda a, b: in_common(point_marks, a, b),
    "free": lambda a, b: in_common(free_marks, a, b),
}


def honest(fleet: Mapping[str, Votes]) -> str:
    """A row: pairs compared, the extremes among them, pairs taken for copies."""
    pairs = [
        (a[index], b[index]) for a, b in itertools.combinations(fleet.values(), 2) for index in sorted(a.keys() & b)
    ]
    told = []
    for name, judge in JUDGES.items():
        found = [value for a, b in pairs if (value := judge(a, b)) is not None]
        extreme = (min if name == "outline" else max)(found, default=float("nan"))
        told.append(f"{extreme:.3f} ({len(found)})")
    wrong = sum(bool(originals(pair, FuseSettings())[1]) for pair in pairs)
    return f"{' | '.join(told)} | {wrong} of {len(pairs)}"


def found_copies(fleet: Mapping[str, Votes]) -> str:
    """A row: for every way to copy, on how many tiles the copy is found of those where something can be compared."""
    told = []
    for way in ("as it is", "salt .5 %", "salt 5 %", "a cell north", "thinned", "cut", "merged"):
        caught = asked = 0
        for name, votes in fleet.items():
            own = next(other for theirs, other in fleet.items() if theirs != name)
            merge = merged_with(own)
            for index, vote in votes.items():
                if not comparable(vote):
                    continue
                copy = {"as it is": lambda v: v, "salt .5 %": salted(0.005), "salt 5 %": salted(0.05)}.get(way)
                copy = copy or {"a cell north": shifted, "thinned": thinned, "cut": cut}.get(way)
                made = merge(vote, index) if copy is None else copy(vote)
                asked += 1
                caught += bool(originals([vote, replace(made, vehicle="copier", digest="f" * 64)], FuseSettings())[1])
        told.append(f"{caught} of {asked}")
    return " | ".join(told)


def main(folders: Sequence[Path]) -> None:
    """Two tables."""
    fleets = {folder.name: votes_in(folder) for folder in folders}
    print("| ballots | outline, least | points, most | free words, most | taken for copies |\n|---|---|---|---|---|")
    for name, fleet in fleets.items():
        print(f"| {name} | {honest(fleet)} |", flush=True)
    print("\n| ballots | as it is | salt .5 % | salt 5 % | a cell north | thinned | cut | merged |")
    print("|---|---|---|---|---|---|---|---|")
    for name, fleet in fleets.items():
        print(f"| {name} | {found_copies(fleet)} |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", metavar="FOLDER")
    main(parser.parse_args().folders)
