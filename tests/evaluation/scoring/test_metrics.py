"""The metric is the paper's: Table IV follows from Tables II and III; counts and shares by hand."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from msgspec import to_builtins
from msgspec.structs import asdict

from mapvote.core.types import NO_VOTE, CellState
from mapvote.evaluation.results import to_json
from mapvote.evaluation.scoring import paper_tables
from mapvote.evaluation.scoring.cells import UNSCORED, ByClass, Scores, classes_of, confusion, coverage, score_cells
from mapvote.evaluation.scoring.map_points import MapJudge
from mapvote.evaluation.scoring.objects import score_objects


@pytest.mark.parametrize("case", ["1", "2", "3", "4", "5"])
def test_table_iv_follows_from_tables_ii_and_iii(case: str) -> None:
    assert paper_tables.SCORES[case].macro_f1 == pytest.approx(paper_tables.F1[case], abs=0.001)


def test_the_f1_of_kim_is_another_number() -> None:
    # 2 x .7963 x .9203 / (.7963 + .9203)
    assert paper_tables.SCORES["5"].kim_f1 == pytest.approx(0.8539, abs=0.0001)
    assert paper_tables.SCORES["5"].kim_f1 != pytest.approx(paper_tables.SCORES["5"].macro_f1, abs=0.001)


def test_undetermined_and_never_seen_count_as_unchanged() -> None:
    states = np.array([*CellState, NO_VOTE], dtype=np.uint8)
    assert classes_of(states).tolist() == [0, 0, 1, 2, 0, 0]


def test_counts_by_hand() -> None:
    truth = np.array([[1, 1, 2, 2, 0, 0, UNSCORED]], dtype=np.uint8)
    states = np.array([[2, 4, 3, 2, 3, 255, 3]], dtype=np.uint8)
    assert confusion(states, truth).tolist() == [[1, 0, 1], [1, 1, 0], [0, 1, 1]]
    scores = score_cells(states, truth)
    assert tuple(scores.precision) == (0.5, 0.5, 0.5)
    assert tuple(scores.recall) == (0.5, 0.5, 0.5)
    assert scores.macro_f1 == scores.kim_f1 == 0.5


def test_different_windows_are_refused() -> None:
    with pytest.raises(ValueError, match="not the same window"):
        score_cells(np.zeros((2, 3), np.uint8), np.zeros((3, 2), np.uint8))


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
    states = np.choose(np.where(truth == UNSCORED, 0, truth), [0, 2, 3]).astype(np.uint8)
    scores = score_cells(states, truth)
    for k in range(3):
        assert tuple(scores.f1)[k] == (1.0 if (truth == k).any() else 0.0)


@given(grids, truths)
def test_mirroring_the_street_changes_no_score(states: np.ndarray, truth: np.ndarray) -> None:
    assert score_cells(states[:, ::-1], truth[:, ::-1]) == score_cells(states, truth)


def test_coverage_is_of_any_vehicle_over_scored_cells() -> None:
    truth = np.array([[0, 1, 2, 0, UNSCORED]], dtype=np.uint8)
    one = np.array([[0, 4, 255, 255, 0]], dtype=np.uint8)
    two = np.array([[255, 2, 4, 255, 0]], dtype=np.uint8)
    assert coverage([one, two], truth) == 0.5
    assert coverage([], truth) == 0.0


def wall(x: float) -> np.ndarray:
    return np.array([[x, y, z] for y in np.arange(0, 3, 0.3) for z in np.arange(0.3, 3, 0.3)])


def test_map_scores_of_a_perfect_update_and_of_none() -> None:
    kept, added, removed = wall(0.0), wall(5.0), wall(10.0)
    old, new = np.vstack([kept, removed]), np.vstack([kept, added])
    judge = MapJudge(old, kept, added, removed)
    perfect = judge.score(new)
    assert (perfect.stale_deleted, perfect.valid_deleted, perfect.new_added, perfect.added_false) == (1, 0, 1, 0)
    nothing = judge.score(old)
    assert (nothing.stale_deleted, nothing.valid_deleted, nothing.new_added, nothing.added_false) == (0, 0, 0, 0)
    assert nothing.stale_points == len(removed)
    assert nothing.valid_points == len(kept)


def test_map_scores_count_damage_and_inventions() -> None:
    kept, added, removed = wall(0.0), wall(5.0), wall(10.0)
    old = np.vstack([kept, removed])
    broken = np.vstack([kept[:50], removed, wall(20.0)])
    scores = MapJudge(old, kept, added, removed).score(broken)
    assert scores.valid_deleted == 0.5
    assert scores.added_false == 1.0


def test_map_scores_of_empty_maps_are_zero_not_nan() -> None:
    empty = np.zeros((0, 3))
    scores = MapJudge(empty, empty, empty, empty).score(empty)
    assert set(asdict(scores).values()) == {0}


def test_an_object_is_found_by_half_of_its_cells_and_inventions_are_measured() -> None:
    truth = np.zeros((40, 40), np.uint8)
    truth[5:9, 5:15] = 1
    truth[20:24, 5:15] = 2
    states = np.zeros((40, 40), np.uint8)
    states[5:9, 5:10] = CellState.CHANGED_OCCUPIED  # half
    states[20:24, 5:9] = CellState.CHANGED_EMPTY  # two fifths
    states[30:35, 30:35] = CellState.CHANGED_EMPTY  # 25 cells = 2.25 m2 of nothing
    states[0:3, 38:40] = CellState.CHANGED_OCCUPIED  # .54 m2: below the smallest object
    objects = [
        {"kind": "built", "cells": truth == 1},
        {"kind": "demolished", "cells": truth == 2},
        {"kind": "built", "cells": np.zeros_like(truth, dtype=bool)},
    ]
    scores = score_objects(states, truth, objects, 0.3)
    assert scores.found == (True, False)
    assert scores.met == (True, True), "1.8 and 1.4 m2 in one piece"
    assert scores.recall == (0.5, 0.4)
    assert scores.false_m2 == (2.25,)


def test_an_object_is_met_by_one_connected_change_and_not_by_scattered_cells() -> None:
    truth = np.zeros((40, 40), np.uint8)
    truth[5:25, 5:25] = 1
    objects = [{"kind": "built", "cells": truth == 1}]
    scattered = np.where((np.indices(truth.shape) % 3 == 0).all(axis=0), CellState.CHANGED_OCCUPIED, 1).astype(np.uint8)
    assert score_objects(scattered, truth, objects, 0.3).met == (False,)
    scattered[10:14, 10:13] = CellState.CHANGED_OCCUPIED
    assert json.dumps(to_builtins(score_objects(scattered, truth, objects, 0.3))["met"]) == "[true]"


def test_scores_are_values() -> None:
    assert Scores.of(ByClass(1, 1, 1), ByClass(1, 1, 1)).macro_f1 == 1.0
