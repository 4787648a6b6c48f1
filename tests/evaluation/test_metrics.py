"""The metric is the paper's: Table IV follows from Tables II and III; counts and shares by hand."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from msgspec.structs import asdict

from hand_made import make_map, make_tile
from hand_made import wall as tile_wall
from mapvote.core.grid import Grid, Lattice
from mapvote.core.types import NO_VOTE, CellState
from mapvote.core.voting import VOTE_UNIT
from mapvote.fusion.fuse import Decision
from mapvote_lab.evaluation.scores import (
    PAPER_F1,
    PAPER_SCORES,
    MapJudge,
    ObjectRests,
    determined_share,
    map_obstacles,
    reliability,
    same_rows,
    score_cells,
    score_objects,
    to_json,
)
from mapvote_lab.simulation.truth import Label


@pytest.mark.parametrize("case", ["1", "2", "3", "4", "5"])
def test_table_iv_follows_from_tables_ii_and_iii(case: str) -> None:
    """Kim's F1 is another number: 2 x .7963 x .9203 / (.7963 + .9203) for case 5."""
    assert PAPER_SCORES[case].macro_f1 == pytest.approx(PAPER_F1[case], abs=0.001)
    assert PAPER_SCORES["5"].kim_f1 == pytest.approx(0.8539, abs=0.0001)


def test_counts_by_hand() -> None:
    truth = np.array([[1, 1, 2, 2, 0, 0, Label.UNSCORED]], dtype=np.uint8)
    states = np.array([[2, 4, 3, 2, 3, 255, 3]], dtype=np.uint8)
    scores = score_cells(states, truth)
    assert tuple(scores.precision) == (0.5, 0.5, 0.5)
    assert tuple(scores.recall) == (0.5, 0.5, 0.5)
    assert scores.macro_f1 == scores.kim_f1 == 0.5


grids = arrays(np.uint8, (6, 7), elements=st.sampled_from([0, 1, 2, 3, 4, 255]))
truths = arrays(np.uint8, (6, 7), elements=st.sampled_from([0, 1, 2, 255]))


@given(grids, truths)
def test_scores_are_shares_and_never_nan(states: np.ndarray, truth: np.ndarray) -> None:
    scores = score_cells(states, truth)
    text = to_json(scores)
    numbers = [*scores.precision, *scores.recall, *scores.f1, scores.macro_f1, scores.kim_f1]
    assert all(0.0 <= x <= 1.0 and math.isfinite(x) for x in numbers)
    assert json.loads(text)["macro_f1"] == scores.macro_f1


@given(truths)
def test_a_perfect_answer_scores_one_in_every_class_that_exists(truth: np.ndarray) -> None:
    states = np.choose(np.where(truth == Label.UNSCORED, 0, truth), [0, 2, 3]).astype(np.uint8)
    scores = score_cells(states, truth)
    for k in range(3):
        assert tuple(scores.f1)[k] == (1.0 if (truth == k).any() else 0.0)


def test_coverage_is_of_any_vehicle_over_scored_cells() -> None:
    truth = np.array([[0, 1, 2, 0, Label.UNSCORED]], dtype=np.uint8)
    one = np.array([[0, 4, 255, 255, 0]], dtype=np.uint8)
    two = np.array([[255, 2, 4, 255, 0]], dtype=np.uint8)
    assert determined_share([one, two], truth) == 0.5
    assert determined_share([], truth) == 0.0


def wall(x: float) -> np.ndarray:
    return np.array([[x, y, z] for y in np.arange(0, 3, 0.3) for z in np.arange(0.3, 3, 0.3)])


def test_map_scores_of_a_perfect_update_of_none_of_damage_and_of_nothing() -> None:
    kept, added, removed = wall(0.0), wall(5.0), wall(10.0)
    old, new = np.vstack([kept, removed]), np.vstack([kept, added])
    judge = MapJudge(old, kept, added, removed)
    perfect = judge.score(new)
    assert (perfect.stale_deleted, perfect.valid_deleted, perfect.new_added, perfect.added_false) == (1, 0, 1, 0)
    nothing = judge.score(old)
    assert (nothing.stale_deleted, nothing.valid_deleted, nothing.new_added, nothing.added_false) == (0, 0, 0, 0)
    assert nothing.stale_points == len(removed)
    assert nothing.valid_points == len(kept)
    broken = judge.score(np.vstack([kept[:50], removed, wall(20.0)]))
    assert (broken.valid_deleted, broken.added_false) == (0.5, 1.0)
    empty = np.zeros((0, 3))
    assert set(asdict(MapJudge(empty, empty, empty, empty).score(empty)).values()) == {0}, "0, not NaN"


def test_the_rest_of_each_object_is_measured_and_a_visible_one_counted() -> None:
    """Two demolished houses of 100 points, and a built one of ten samples."""
    gone = np.column_stack([np.arange(200) * 1.0, np.zeros(200), np.ones(200)])
    added = np.column_stack([np.arange(10) * 1.0, np.full(10, 50.0), np.ones(10)])
    judge = MapJudge(gone, np.zeros((0, 3)), added, gone)
    objects = [
        ("demolished", lambda points: points[:, 0] < 100),
        ("demolished", lambda points: points[:, 0] >= 100),
        ("built", lambda points: points[:, 1] > 40),
        ("demolished", lambda points: np.zeros(len(points), dtype=np.bool_)),
    ]
    rests = judge.rests(np.concatenate([gone[:21], gone[100:120], added[:7]]), objects)
    assert rests == ObjectRests(left=(0.21, 0.2), added=(0.7,), visible=1), "20 points are not more than 20"
    assert judge.rests(gone[:3], objects).visible == 0, "3 % are not more than 5"


def test_an_object_is_found_by_half_of_its_cells_and_inventions_are_measured() -> None:
    truth = np.zeros((40, 40), np.uint8)
    truth[5:9, 5:15] = 1
    truth[20:24, 5:15] = 2
    states = np.zeros((40, 40), np.uint8)
    states[5:9, 5:10] = CellState.CHANGED_OCCUPIED  # half
    states[20:24, 5:9] = CellState.CHANGED_EMPTY  # two fifths
    states[30:34, 30:34] = CellState.CHANGED_EMPTY  # 25 cells = 2.25 m2 of nothing, joined at a corner
    states[34:37, 34:37] = CellState.CHANGED_EMPTY
    states[10:15, 31:35] = CellState.CHANGED_OCCUPIED  # 1.8 m2
    states[0:3, 38:40] = CellState.CHANGED_OCCUPIED  # .54 m2: below the smallest object
    objects = [
        {"kind": "built", "cells": truth == 1},
        {"kind": "demolished", "cells": truth == 2},
        {"kind": "built", "cells": np.zeros_like(truth, dtype=bool)},
    ]
    scores = score_objects(states, truth, objects)
    assert scores.found == (True, False)
    assert scores.recall == (0.5, 0.4)
    assert scores.false_m2 == (2.25, 1.8), "largest first"


@pytest.mark.parametrize(
    ("gap", "beside", "false"), [(2, 1, ()), (3, 1, (1.8,)), (2, 2, (1.8,)), (2, Label.UNSCORED, ())]
)
def test_an_invention_is_three_cells_off_the_truth_of_its_kind_and_of_what_is_not_scored(
    gap: int, beside: int, false: tuple[float, ...]
) -> None:
    truth, states = np.zeros((30, 30), np.uint8), np.ones((30, 30), np.uint8)
    truth[5:10, 5:10] = beside
    states[5:10, 9 + gap : 13 + gap] = CellState.CHANGED_OCCUPIED
    assert score_objects(states, truth, []).false_m2 == false


def test_a_point_nearer_than_the_removed_object_is_not_stale() -> None:
    """A removed sample within reach makes a point stale, unless something that stands is as near."""
    samples = {"kept": [[0.0, 0, 0]], "added": [[10.0, 0, 0]], "removed": [[0.2, 0, 0], [10.2, 0, 0], [20.0, 0, 0]]}
    kept, added, removed = (np.array(samples[name]) for name in ("kept", "added", "removed"))
    x = [0.05, 0.1, 0.15, 10.05, 10.15, 20.0, 20.5, 20.51, 30.0]
    old = np.array([[value, 0.0, 0.0] for value in x])
    judge = MapJudge(old, kept, added, removed, reach_m=0.5)
    assert np.flatnonzero(judge.stale).tolist() == [2, 4, 5, 6], "just within reach is within reach"
    assert np.flatnonzero(judge.valid).tolist() == [0, 1]
    usual = MapJudge(old, kept, added, removed)
    assert np.flatnonzero(usual.stale).tolist() == [2, 4, 5]


def test_added_points_are_counted_and_judged_by_what_stands_now() -> None:
    kept, added = np.array([[0.0, 0, 0]]), np.array([[5.0, 0, 0], [6.0, 0, 0]])
    new = np.array([[0.0, 0, 0], [5.29, 0, 0], [0.2, 0, 0], [5.6, 0, 0], [9.0, 0, 0]])
    scores = MapJudge(kept, kept, added, np.zeros((0, 3)), lambda points: points[:, 0] < 7).score(new)
    assert (scores.added_points, scores.new_samples) == (4, 2)
    assert scores.new_added == 0.5, "one sample has a point within reach, the other not"
    assert scores.added_false == 0.5, "two of four lie on nothing"
    assert scores.added_false_scored == 0.25, "one of them in a cell that the truth scores"


def test_an_old_point_survives_only_bit_for_bit() -> None:
    old = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    new = np.array([[np.nextafter(1.0, 2.0), 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]])
    survived, fresh = same_rows(old, new)
    assert survived.tolist() == [False, True]
    assert fresh.tolist() == [new[0].tolist(), [7.0, 8.0, 9.0]]


def test_the_obstacles_of_a_map_are_its_points_above_the_ground_tile_by_tile() -> None:
    a = make_tile(tile_wall([(3, 3)], [0.1, 0.75]), index=(0, 1))
    b = make_tile(tile_wall([(3, 3)], [0.1, 1.05]), index=(0, 0))
    points = map_obstacles(make_map({(0, 1): a, (0, 0): b}))
    np.testing.assert_allclose(points, [[1.05, 1.05, 1.05], [77.85, 1.05, 0.75]], atol=1e-5)
    assert map_obstacles(make_map({})).shape == (0, 3)


def test_only_cells_that_are_scored_count_wherever_their_tile_lies() -> None:
    lattice = Lattice()
    states = np.full((256, 256), NO_VOTE, dtype=np.uint8)
    states[2, 3:7] = CellState.CHANGED_EMPTY
    tally = np.zeros((256, 256, 5), dtype=np.int32)
    tally[..., CellState.CHANGED_EMPTY] = 3 * VOTE_UNIT
    decision = Decision(states, tally, states, 1)
    window = Grid(lattice, 256 + 1, 0, 4, 6)  # of a tile to the north, without the last changed cell
    truth = np.zeros((4, 6), dtype=np.uint8)
    truth[1, 3], truth[1, 4] = 2, 255
    found = reliability({(1, 0): decision}, lattice, truth, window, CellState.CHANGED_EMPTY)
    assert found.cells.sum() == 2
    assert found.true[found.cells > 0].tolist() == [1.0, 0.0]
    right, wrong = found.predicted[found.cells > 0]
    assert found.calibration_error == pytest.approx((1.0 - right + wrong) / 2)
    assert found.brier == pytest.approx(((1.0 - right) ** 2 + wrong**2) / 2)
