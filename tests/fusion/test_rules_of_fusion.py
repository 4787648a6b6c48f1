"""Fusion does what its rules say in plain words (``plain_rules.py``): random passes over a street of a few cells."""

from __future__ import annotations

import random
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from hand_made import make_tile, states_plane, wall, words_plane
from histories import held_by, say
from mapvote.codec.planes import Words
from mapvote.config import FuseSettings
from mapvote.core.rule import SURFACES
from mapvote.fusion.change_time import history_days
from mapvote.fusion.fuse import fuse_tile, unspent
from mapvote.fusion.tile_vote import DAY_NS, Vote, newest_votes
from plain_rules import DAY_S, Cast, Cell, CellMap, Version, fuse

WALL: list[Cell] = [(r, c) for r in (10, 11, 12) for c in (10, 11)]
LAWN: list[Cell] = [(20, 20), (20, 21), (30, 30)]
HEIGHTS = (0.05, 0.45, 0.75, 1.05, 1.65)
START_S = 1_700_000_000


def as_vote(cast: Cast, masks: bool) -> Vote:
    points = [wall([cell], list(spoken.heights)) for cell, spoken in cast.says.items()]
    gone, free = (words_plane({c: getattr(s, name) or 0 for c, s in cast.says.items()}) for name in ("gone", "free"))
    return Vote(
        cast.vehicle,
        cast.end_s * 10**9,
        cast.drive,
        states=states_plane({cell: spoken.state for cell, spoken in cast.says.items()}),
        gone=Words.of(gone) if masks else None,
        new_points=np.concatenate(points),
        free=Words.of(free) if cast.has_free else None,
        version=cast.version,
    )


@pytest.mark.parametrize("seed", range(24))
def test_every_cell_of_every_version_is_as_the_rules_have_it(seed: int) -> None:
    rng = random.Random(seed)
    more = {
        "latest_vehicles": rng.choice([3, 10]),
        "max_age_days": rng.choice([5, 28]),
        "stay_days": rng.choice([3, 30]),
    }
    settings = FuseSettings.model_validate({"min_votes": rng.choice([1, 2, 2, 3]), **more})
    tile = make_tile(wall(WALL, list(HEIGHTS)))
    first = {cell: CellMap(HEIGHTS) for cell in WALL} | {cell: CellMap() for cell in LAWN}
    versions = {1: Version("import", first, False, 0, 0.0, settings)}
    there, now_s = dict.fromkeys(WALL, True) | dict.fromkeys(LAWN, False), START_S
    casts, votes = list[Cast](), list[Vote]()
    for _ in range(9):
        for cell in rng.sample(WALL + LAWN, 2):
            there[cell] = not there[cell]
        newest = max(versions)
        for vehicle in rng.sample("abcde", rng.randint(1, 4)):
            now_s += rng.choice([60, 3_600, DAY_S])
            version, masks, has_free = rng.randint(max(1, newest - 2), newest), rng.random() < 0.7, rng.random() < 0.7
            seen = [cell for cell in WALL + LAWN if rng.random() < 0.8]
            says = {c: say(rng, there[c], versions[version].cells[c], masks, has_free) for c in seen}
            cast = Cast(vehicle, f"d{len(casts):03}", now_s, version, says, has_free, now_s, len(casts))
            casts.append(cast)
            votes.append(as_vote(cast, masks))
        oldest = votes[-1].end_ns - history_days(settings) * DAY_NS
        lately = [unspent(vote, tile) for vote in votes if vote.end_ns >= oldest]
        drives = [unspent(vote, tile) for vote in newest_votes(votes, settings)]
        rng.shuffle(drives)
        tile = fuse_tile(tile, drives, SURFACES, settings, newest + 1, partial(list, lately))[1]
        before = versions[newest]
        cells, knows = fuse(before, casts, settings, now_s, newest + 1, lambda *_: True, lambda *_: True)
        assert {cell: held_by(tile, cell) for cell in cells} == cells
        assert (tile.free is not None) == knows
        if knows != before.knows_free or any(not cells[c].same_as(before.cells[c]) for c in cells):
            versions[newest + 1] = replace(before, cells=cells, knows_free=knows)
    assert len(versions) > 2, "the street changed"
